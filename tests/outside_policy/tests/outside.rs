//! A policy from outside is as good as one of our own: it conforms, has its manual page, and trains.

use std::path::Path;

use assert_cmd::Command;
use densify_policies::{conformance, registry};
use outside_policy as _;

#[test]
fn it_conforms() -> Result<(), Box<dyn std::error::Error>> {
    let entry = registry::find("steady")?;
    conformance::check_policy(entry)?;
    conformance::check_manual(entry)?;
    Ok(())
}

/// CONTRIBUTING.md shows this crate: what it shows must be what works.
#[test]
fn it_is_the_example_of_the_guide() {
    let read = |path: &str| {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join(path);
        std::fs::read_to_string(&path).unwrap_or_else(|e| panic!("{}: {e}", path.display()))
    };
    let plain = |text: &str| text.lines().map(str::trim).collect::<Vec<_>>().join("\n");
    let (guide, policy) = (plain(&read("../../CONTRIBUTING.md")), plain(&read("src/lib.rs")));
    assert!(guide.contains(policy.trim()), "CONTRIBUTING.md no longer shows src/lib.rs");
    assert!(policy.lines().filter(|line| !line.is_empty()).count() < 60);
}

/// Calls the program with words separated by spaces: its exit code, and all that it said.
fn densify(words: &str) -> (Option<i32>, String) {
    let mut command = Command::new(env!("CARGO_BIN_EXE_outside-policy"));
    command.args(words.split_whitespace()).env_remove("RUST_LOG");
    let output = command.output().expect("it starts");
    let said = String::from_utf8_lossy(&[output.stdout, output.stderr].concat()).into_owned();
    (output.status.code(), said)
}

#[test]
fn it_is_listed_and_explained() {
    for (words, expected) in [
        ("policies", ["steady", "splits where gradients are large", "outside_policy", "diet"]),
        (
            "policies steady",
            ["steady", "prune the faintest", "steady.grow_every=100", "grow_until"],
        ),
    ] {
        let (code, said) = densify(words);
        assert!(code == Some(0) && expected.iter().all(|word| said.contains(word)), "{said}");
    }
}

#[test]
fn it_trains() {
    let root = tempfile::tempdir().expect("a temporary folder");
    let frame = |i: u8| {
        let picture = image::RgbImage::from_fn(32, 24, |x, y| {
            image::Rgb([(8 * x) as u8, (10 * y) as u8, 60 * i + (4 * (x ^ y)) as u8])
        });
        picture.save(root.path().join(format!("{i}.png"))).expect("it is written");
        let x = f64::from(i) - 1.0;
        serde_json::json!({
            "file_path": format!("{i}.png"),
            "transform_matrix": [[1, 0, 0, x], [0, 1, 0, 0.1 * x], [0, 0, 1, 4], [0, 0, 0, 1]],
        })
    };
    let frames: Vec<_> = (0..3).map(frame).collect();
    let scene = serde_json::json!({ "w": 32, "h": 24, "fl_x": 40.0, "frames": frames });
    std::fs::write(root.path().join("transforms.json"), scene.to_string()).expect("it is written");
    let run = root.path().join("run");
    let (code, said) = densify(&format!(
        "train {} -o {} --policy steady --policy-set steady.grow_every=10 --policy-set \
         steady.grow_until=60 --iterations 60 --init-points 200 --budget 220",
        root.path().display(),
        run.display(),
    ));
    assert_eq!(code, Some(0), "{said}");
    let events = std::fs::read_to_string(run.join("stats/events.jsonl")).expect("there is a log");
    assert_eq!(events.lines().count(), 5, "{events}");
    // Ten rows of two hundred are split per event until the budget is reached.
    let added: Vec<serde_json::Value> =
        events.lines().map(|line| serde_json::from_str(line).expect("a record")).collect();
    assert_eq!(added[0]["cause"], "steady");
    assert!(added.iter().all(|event| event["after"].as_u64() <= Some(220)), "{events}");
    assert!(added.iter().any(|event| event["denied"].as_u64() > Some(0)), "{events}");
}
