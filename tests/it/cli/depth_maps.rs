//! `--depth`: messages and files, refusals, reproducibility, resuming, and no effect when it is off.

use std::path::Path;

use super::{
    call, config, copy_unfinished, files, json, model, read_text, resume, scratch, text, train,
};

/// A small room with these errors of its depth.
fn room(folder: &Path, damage: &str) {
    let size = "--train 12 --test 2 --size 48 --samples 1 --points 1500 --overwrite";
    call(&format!("scenegen --preset room -o {} {size} {damage}", text(folder))).ok();
}

const ITERATIONS: u32 = 60;
const FLAGS: &str = "--backend cpu --budget 1600 --checkpoint-every 35";

#[test]
fn runs_with_depth_say_so_and_resume_exactly() {
    let (root, whole) = scratch();
    let scene = root.path().join("scene");
    room(&scene, "--depth-noise 0.03 --depth-holes 0.2 --depth-scale 1.05");
    let flags = format!("{FLAGS} --depth on");
    let outcome = train(&scene, &whole, ITERATIONS, &format!("{flags} --threads 1")).ok();
    for words in
        ["depth    depth maps for 12 of 12 views", "which is corrected", "trained on depth"]
    {
        assert!(outcome.stdout.contains(words), "{words}: {}", outcome.stdout);
    }
    let found = json(&whole.join("stats/requirements.json"))["depth"].clone();
    assert_eq!((&found["term"], &found["weight"]), (&"expected".into(), &"0.05:0.001".into()));
    let scale = found["scale"].as_f64().expect("a ratio");
    assert!((scale - 1.05).abs() < 0.01 && found["is_corrected"] == true, "{found}");
    assert_eq!(config(&whole)["resolved"]["depth"]["views"].as_integer(), Some(12));
    let steps = read_text(&whole.join("stats/train.jsonl"));
    assert!(steps.lines().all(|line| line.contains("\"depth\":")), "{steps}");

    let threads = root.path().join("threads");
    train(&scene, &threads, ITERATIONS, &format!("{flags} --threads 3")).ok();
    let part = root.path().join("part");
    copy_unfinished(&whole, &part, ITERATIONS);
    let again = resume(&scene, &part, "").ok();
    assert!(again.stdout.contains("from step 35"), "{}", again.stdout);
    for run in [threads, part] {
        assert!(model(&run, ITERATIONS) == model(&whole, ITERATIONS), "{}", run.display());
    }
    let refused = resume(&scene, &whole, "--depth-weight 1");
    refused.refused("another weight", &["--depth-weight", "contradicts"]);
}

#[test]
fn without_depth_or_with_depth_by_scenegen_nothing_changes() {
    let (root, off) = scratch();
    let scene = root.path().join("scene");
    room(&scene, "");
    train(&scene, &off, ITERATIONS, &format!("{FLAGS} --depth off")).ok();
    let [auto, on, weightless] = ["auto", "on", "weightless"].map(|name| root.path().join(name));
    let outcome = train(&scene, &auto, ITERATIONS, FLAGS).ok();
    assert!(!outcome.stdout.contains("depth  "), "{}", outcome.stdout);
    train(&scene, &on, ITERATIONS, &format!("{FLAGS} --depth on")).ok();
    train(&scene, &weightless, ITERATIONS, &format!("{FLAGS} --depth on --depth-weight 0")).ok();
    let expected = model(&off, ITERATIONS);
    assert!(model(&auto, ITERATIONS) == expected, "auto trained on the truth");
    assert!(model(&weightless, ITERATIONS) == expected, "a weight of 0 changes the model");
    assert!(model(&on, ITERATIONS) != expected, "depth has no effect");
    // The cached views have three more bytes per pixel.
    let bytes = |run: &Path| {
        let summary = json(&run.join("stats/summary.json"));
        let lines = summary["ledger"]["lines"].as_array().expect("lines");
        let is_cache = |what: &str| what.starts_with("decoded training views");
        let line = lines.iter().find(|line| line["what"].as_str().is_some_and(is_cache));
        line.and_then(|line| line["bytes"].as_u64()).expect("a number")
    };
    assert_eq!(bytes(&on) - bytes(&off), 12 * 48 * 48 * 3);
    assert!(!read_text(&auto.join("stats/train.jsonl")).contains("depth"));
    let config = config(&auto);
    assert!(config.get("depth").is_none() && config["resolved"].get("depth").is_none());
}

#[test]
fn depth_of_another_unit_or_meaning_is_refused_before_anything_is_written() {
    let (root, run) = scratch();
    let scene = root.path().join("scene");
    let refuse = |damage: &str, flags: &str, words: &[&str]| {
        room(&scene, damage);
        let words = [words, &["--depth off"]].concat();
        train(&scene, &run, 20, &format!("{FLAGS} --depth on {flags}")).refused(damage, &words);
        assert!(!run.exists(), "{damage}");
    };
    refuse("--depth-scale 1000", "", &["times that of", "--depth-unit"]);
    refuse("--depth-along-rays", "", &["along rays", "--depth-along ray"]);
    refuse("--depth-shift 3,0", "", &["shifted by (3, 0) px"]);
    refuse("", "--depth-unit 1/5000", &["a unit of 0.001 would fit"]);
    // With the remedies, the same depth is used.
    room(&scene, "--depth-along-rays");
    train(&scene, &run, 20, &format!("{FLAGS} --depth on --depth-along ray")).ok();
    // Depth that densify did not render is left out with a note.
    room(&scene, "--depth-scale 3");
    std::fs::remove_file(scene.join("scene.json")).expect("a description");
    let auto = root.path().join("auto");
    let outcome = train(&scene, &auto, 20, FLAGS).ok();
    let said = format!("{}{}", outcome.stdout, outcome.stderr);
    assert!(
        said.contains("the given depth is not used") && said.contains("--depth-unit"),
        "{said}"
    );
    let none = root.path().join("none");
    std::fs::remove_dir_all(scene.join("depth")).expect("a folder");
    let refused = train(&scene, &none, 20, &format!("{FLAGS} --depth on"));
    refused.refused("no depth", &["no training view has depth", "--depth off"]);
    assert!(files(root.path()).keys().all(|name| !name.starts_with("none")));
}
