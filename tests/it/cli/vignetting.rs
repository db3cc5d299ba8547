//! `--vignette`: learned vignettes, messages and files; reproducibility, resuming, and no effect when it is off.

use std::path::Path;

use super::{
    call, config, copy_unfinished, files, json, model, read, resume, scratch, spheres, text, train,
};
use crate::photographs::Photographs;

#[test]
fn vignettes_survive_resuming_and_do_not_depend_on_threads() {
    let (root, whole) = scratch();
    let scene = root.path().join("scene");
    spheres(&scene, "--train 12 --vignette 0.5 --exposure-jitter 0.5");
    let flags = "--vignette on --exposure on --eval --checkpoint-every 30 --policy mcmc --backend cpu --budget 1700";
    let outcome = train(&scene, &whole, 50, &format!("{flags} --threads 1")).ok();
    for words in ["vignette on, from the colours of points", "vignettes learned: 1 camera"] {
        assert!(outcome.stdout.contains(words), "{words}: {}", outcome.stdout);
    }
    let learned = "point_cloud/iteration_50/vignette.json";
    let cameras = json(&whole.join(learned))["cameras"].clone();
    let [camera] = cameras.as_array().expect("cameras").as_slice() else { panic!("{cameras}") };
    assert_eq!(camera["views"].as_array().expect("views").len(), 12, "{camera}");
    // One stop at the corner of a square photograph is 0.81 stops at that of a 4:3 one.
    let stops = camera["corner_stops"].as_f64().expect("a loss");
    assert!((0.6..1.0).contains(&stops), "{stops}");

    let threads = root.path().join("threads");
    train(&scene, &threads, 50, &format!("{flags} --threads 3")).ok();
    let part = root.path().join("part");
    copy_unfinished(&whole, &part, 50);
    let again = resume(&scene, &part, "").ok();
    assert!(again.stdout.contains("from step 30"), "{}", again.stdout);
    for run in [threads, part] {
        assert!(model(&run, 50) == model(&whole, 50), "{}", run.display());
        assert!(read(&run.join(learned)) == read(&whole.join(learned)), "{}", run.display());
    }
    let refused = resume(&scene, &whole, "--vignette off");
    refused.refused("another vignette", &["--vignette", "contradicts"]);
    let ledger = json(&whole.join("stats/summary.json"))["ledger"].to_string();
    assert!(ledger.contains("vignettes of the cameras"), "{ledger}");
    // Compressing the run learns the vignette again.
    let file = root.path().join("small.ply");
    let words = format!("--to 800 -o {} --iterations 5 --backend cpu", text(&file));
    let stdout = call(&format!("compress {} {words}", text(&whole))).ok().stdout;
    assert!(stdout.contains("vignette learned again"), "{stdout}");
}

/// With `auto`, the tracks of a written scene decide whether vignettes are learned, and the output says so. A run that is
/// killed before its first checkpoint decides again.
#[test]
fn auto_detects_vignettes_before_training() {
    let (root, _) = scratch();
    for (strength, word) in [("0.5", "on"), ("0", "off")] {
        let [scene, run, part] =
            ["scene", "run", "part"].map(|name| root.path().join(format!("{name}{strength}")));
        spheres(&scene, &format!("--train 12 --vignette {strength}"));
        let flags = "--eval --backend cpu --budget 2k --checkpoint-every 0";
        let outcome = train(&scene, &run, 3, &format!("{flags} --vignette auto")).ok();
        let decision = format!("vignette {word} (auto): judged by the colours of");
        assert!(outcome.stdout.contains(&decision), "{}", outcome.stdout);
        let report = json(&run.join("stats/requirements.json"));
        assert_eq!(report["vignettes"]["learned"], word == "on", "{report}");
        let left_out = report["left_out"].to_string().contains("a vignette for each camera");
        assert_eq!(left_out, word == "off", "{report}");
        copy_unfinished(&run, &part, 3);
        let again = resume(&scene, &part, "").ok().stdout;
        assert!(again.contains(&decision), "{again}");
        assert!(model(&part, 3) == model(&run, 3), "{strength}");
        let without = root.path().join(format!("without{strength}"));
        train(&scene, &without, 3, flags).ok();
        // If it stays off, the decision needs memory, but the model is the same as without the option.
        assert_eq!(model(&run, 3) == model(&without, 3), word == "off");
        let unused = json(&without.join("stats/requirements.json"));
        assert!(unused.get("vignettes").is_none(), "{unused}");
        let ledger = json(&without.join("stats/summary.json"))["ledger"].to_string();
        assert!(!ledger.contains("vignette") && !ledger.contains("colours of tracks"), "{ledger}");
    }
    call(&format!("scenegen --preset spheres -o {} --vignette 1", text(&root.path().join("none"))))
        .refused("all light", &["--vignette", "1 is not between 0 and 0.99"]);
}

/// `auto` needs more points with tracks than this scene has, so it must not differ from `off`.
#[test]
fn undecided_auto_equals_off() {
    let scene = Photographs::colmap_text();
    let run = |flags: &str| {
        let (root, run) = scratch();
        let flags = format!("{flags} --eval --policy mcmc --backend cpu");
        let outcome = train(scene.path(), &run, 40, &flags).ok();
        (root, run, outcome.stdout)
    };
    let (_off, off, stdout) = run("");
    assert!(!stdout.contains("vignette"), "{stdout}");
    assert_eq!(config(&off)["vignette"].as_str(), Some("off"));
    let resolved = config(&off)["resolved"].to_string();
    assert!(!resolved.contains("vignette"), "{resolved}");
    let (_auto, auto, stdout) = run("--vignette auto");
    assert!(
        stdout.contains("off (auto): undecided, because no camera sees 500 points"),
        "{stdout}"
    );
    assert!(model(&off, 40) == model(&auto, 40));
    let names = |run: &Path| {
        let found = files(run).into_keys();
        found.filter(|name| !name.contains("tfevents")).collect::<Vec<_>>()
    };
    assert_eq!(names(&off), names(&auto));
}

/// The views of a divided photograph have no radius about its middle.
#[test]
fn divided_photographs_have_no_vignette() {
    let (root, run) = scratch();
    let scene = root.path().join("scene");
    let size = "--size 64 --train 6 --test 2 --points 900 --samples 1";
    call(&format!("scenegen --preset room {size} --fov 118 --lens fisheye:0 -o {}", text(&scene)))
        .ok();
    let flags = "--backend cpu --budget 1k --keep-fov";
    train(&scene, &run, 2, &format!("{flags} --vignette on"))
        .refused("faces", &["--vignette on", "several views", "--vignette off"]);
    let stdout = train(&scene, &run, 2, &format!("{flags} --vignette auto")).ok().stdout;
    assert!(stdout.contains("vignette off (auto)"), "{stdout}");
}

/// A vignette of one stop costs at most 0.3 dB. Measured with three seeds: docs/studies/vignette.tsv.
#[test]
#[ignore = "takes minutes: run by .ci/run"]
fn learned_vignettes_are_not_painted_on_walls() {
    let (root, _) = scratch();
    let score = |strength: &str, flags: &str| {
        let [scene, run] = ["scene", "run"]
            .map(|name| root.path().join(format!("{name}{strength}{}", flags.len())));
        let size = "--size 160 --train 30 --test 8 --samples 2";
        let words = format!("scenegen --preset room {size} --vignette {strength}");
        call(&format!("{words} -o {}", text(&scene))).ok();
        train(&scene, &run, 1500, &format!("--eval --backend cpu --budget 5k {flags}")).ok();
        json(&run.join("results.json"))["ours_1500"]["PSNR"].as_f64().expect("a score")
    };
    let none = score("0", "--vignette auto");
    let auto = score("0.5", "--vignette auto");
    let off = score("0.5", "--vignette off");
    let all = format!("none {none:.2}, auto {auto:.2}, off {off:.2} dB");
    assert!(none - auto < 0.5, "{all}");
    assert!(none - off > 3.0, "the vignette costs too little to test: {all}");
}
