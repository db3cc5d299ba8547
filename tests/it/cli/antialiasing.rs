//! `train --antialias`: models state their antialiasing, and every command keeps it or reports the change.

use densify::core::antialiasing::Antialiasing::{self, Narrow, None, Wide};
use densify::train::output::model_path;
use std::path::Path;

use super::{call, gaussians, read, read_text, resume, scratch, text, train};
use crate::photographs::Photographs;

fn stated(file: &Path) -> Antialiasing {
    gaussians(file).antialiasing
}

#[test]
fn antialiasing_is_carried_through_every_command() {
    let scene = Photographs::colmap_text();
    let (root, run) = scratch();
    let flags = "--budget 300 --eval --quiet --antialias";
    train(scene.path(), &run, 20, &format!("{flags} --checkpoint-every 10")).ok();
    let ply = model_path(&run, 20);
    assert_eq!(stated(&ply), Wide);
    let config = read_text(&run.join("config.toml"));
    assert!(config.contains("antialias = \"0.3\""), "{config}");
    let plain = root.path().join("plain");
    train(scene.path(), &plain, 20, "--budget 300 --eval --quiet").ok();
    assert!(!read_text(&plain.join("config.toml")).contains("antialias"));
    let header = String::from_utf8_lossy(&read(&model_path(&plain, 20))[..200]).into_owned();
    assert!(!header.contains("comment"), "{header}");

    // A resumed run keeps its antialiasing and refuses another.
    let whole = read(&ply);
    for file in ["point_cloud/iteration_20", "checkpoints/iteration_20.safetensors"] {
        let path = run.join(file);
        let removed = if path.is_dir() {
            std::fs::remove_dir_all(&path)
        } else {
            std::fs::remove_file(&path)
        };
        removed.expect("an output of the run");
    }
    resume(scene.path(), &run, "--antialias=0.1").refused("another", &["--antialias"]);
    resume(scene.path(), &run, "").ok();
    assert!(read(&ply) == whole);

    // All formats state the antialiasing. SPZ cannot state the narrow kernel, and `export` says so.
    let export = |from: &Path, name: &str, flags: &str| {
        let to = root.path().join(name);
        let outcome = call(&format!("export {} -o {} {flags}", text(from), text(&to))).ok();
        (stated(&to), outcome)
    };
    for name in ["a.spz", "a.v4.spz", "a.sog", "a.glb", "a.compressed.ply", "a.ply"] {
        assert_eq!(export(&run, name, "").0, Wide, "{name}");
    }
    let (found, outcome) = export(&run, "narrow.ply", "--antialias=0.1");
    assert_eq!(found, Narrow);
    assert!(outcome.stdout.contains("trained with --antialias=0.1"), "{outcome:?}");
    let narrow = root.path().join("narrow.ply");
    let (found, outcome) = export(&narrow, "narrow.spz", "");
    assert_eq!(found, Wide);
    assert!(outcome.stdout.contains("cannot state the kernel"), "{outcome:?}");
    assert_eq!(export(&narrow, "narrow.sog", "").0, Narrow);
    assert_eq!(export(&run, "none.ply", "--antialias=none").0, None);
    let small = root.path().join("small.ply");
    let flags = format!("--to 100 -o {} --iterations 10 --backend cpu", text(&small));
    call(&format!("compress {} {flags}", text(&run))).ok();
    assert_eq!(stated(&small), Wide);

    // Scores depend on the antialiasing.
    let score = |flags: &str| {
        let outcome = call(&format!("eval {} --backend cpu {flags}", text(&run))).ok();
        let mean = outcome.stdout.lines().find(|line| line.starts_with("mean"));
        mean.expect("a mean").to_owned()
    };
    let default_score = score("");
    let results = read_text(&run.join("results.json"));
    assert_ne!(default_score, score("--antialias=none"));
    assert_eq!(
        read_text(&run.join("results.json")),
        results,
        "scores with another antialiasing were saved"
    );

    // A run that starts from a model trains with its antialiasing; the models of --init and --freeze must agree.
    let from = |flags: &str, name: &str| {
        let to = root.path().join(name);
        let flags = format!("--budget 900 --quiet {flags}");
        (train(scene.path(), &to, 4, &flags), to)
    };
    let (outcome, again) = from(&format!("--init {}", text(&ply)), "again");
    outcome.ok();
    assert_eq!(stated(&model_path(&again, 4)), Wide);
    let (outcome, around) = from(&format!("--freeze {}", text(&narrow)), "around");
    outcome.ok();
    assert_eq!(stated(&model_path(&around, 4)), Narrow);
    let both = format!("--init {} --freeze {}", text(&ply), text(&narrow));
    from(&both, "no").0.refused("both", &["--init", "--freeze", "--antialias"]);
    call(&format!("plan {} --budget 900 {both}", text(scene.path())))
        .refused("both", &["--init", "--freeze", "--antialias"]);
    let (outcome, chosen) = from(&format!("{both} --antialias=none"), "chosen");
    outcome.ok();
    assert_eq!(stated(&model_path(&chosen, 4)), None);
    from("--antialias=0.2", "no").0.refused("kernel", &["0.2", "0.3"]);
}
