//! A policy in another crate works like a built-in one: it conforms, has its manual page, and trains.

use std::path::Path;

use assert_cmd::Command;
use densify_policies::{conformance, registry};
use outside_policy as _;

#[test]
fn policy_conforms() -> Result<(), Box<dyn std::error::Error>> {
    let entry = registry::find("steady")?;
    conformance::check_policy(entry)?;
    conformance::check_manual(entry)?;
    Ok(())
}

/// CONTRIBUTING.md shows the source of this crate; the two must be identical.
#[test]
fn policy_is_the_example_of_the_guide() {
    let read = |path: &str| {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join(path);
        std::fs::read_to_string(&path).unwrap_or_else(|e| panic!("{}: {e}", path.display()))
    };
    let unindented = |text: &str| text.lines().map(str::trim).collect::<Vec<_>>().join("\n");
    let (guide, policy) =
        (unindented(&read("../../CONTRIBUTING.md")), unindented(&read("src/lib.rs")));
    assert!(guide.contains(policy.trim()), "CONTRIBUTING.md no longer shows src/lib.rs");
    assert!(policy.lines().filter(|line| !line.is_empty()).count() < 60, "the example is too long");
}

/// Runs the program with arguments separated by spaces; returns its exit code and all its output.
fn densify(arguments: &str) -> (Option<i32>, String) {
    let mut command = Command::new(env!("CARGO_BIN_EXE_outside-policy"));
    command.args(arguments.split_whitespace()).env_remove("RUST_LOG");
    let output = command.output().expect("the program starts");
    let text = String::from_utf8_lossy(&[output.stdout, output.stderr].concat()).into_owned();
    (output.status.code(), text)
}

#[test]
fn policy_is_listed_and_explained() {
    for (arguments, expected) in [
        ("policies", ["steady", "splits where gradients are large", "outside_policy", "diet"]),
        (
            "policies steady",
            ["steady", "prune the faintest", "steady.grow_every=100", "grow_until"],
        ),
    ] {
        let (code, output) = densify(arguments);
        assert!(code == Some(0) && expected.iter().all(|text| output.contains(text)), "{output}");
    }
}

#[test]
fn policy_trains() {
    let root = tempfile::tempdir().expect("a temporary folder");
    let frame = |i: u8| {
        let picture = image::RgbImage::from_fn(32, 24, |x, y| {
            image::Rgb([(8 * x) as u8, (10 * y) as u8, 60 * i + (4 * (x ^ y)) as u8])
        });
        picture.save(root.path().join(format!("{i}.png"))).expect("the picture is written");
        let camera_x = f64::from(i) - 1.0;
        serde_json::json!({
            "file_path": format!("{i}.png"),
            "transform_matrix": [[1, 0, 0, camera_x], [0, 1, 0, 0.1 * camera_x], [0, 0, 1, 4], [0, 0, 0, 1]],
        })
    };
    let frames: Vec<_> = (0..3).map(frame).collect();
    let scene = serde_json::json!({ "w": 32, "h": 24, "fl_x": 40.0, "frames": frames });
    std::fs::write(root.path().join("transforms.json"), scene.to_string())
        .expect("the scene is written");
    let run = root.path().join("run");
    let (code, output) = densify(&format!(
        "train {} -o {} --policy steady --policy-set steady.grow_every=10 --policy-set \
         steady.grow_until=60 --iterations 60 --init-points 200 --budget 220",
        root.path().display(),
        run.display(),
    ));
    assert_eq!(code, Some(0), "{output}");
    let events = std::fs::read_to_string(run.join("stats/events.jsonl")).expect("a log is written");
    assert_eq!(events.lines().count(), 5, "{events}");
    // Each event splits a twentieth of the rows, ten of 200 at first, until the budget is reached.
    let records: Vec<serde_json::Value> =
        events.lines().map(|line| serde_json::from_str(line).expect("a record")).collect();
    assert_eq!(records[0]["cause"], "steady");
    assert!(records.iter().all(|event| event["after"].as_u64() <= Some(220)), "{events}");
    assert!(records.iter().any(|event| event["denied"].as_u64() > Some(0)), "{events}");
}
