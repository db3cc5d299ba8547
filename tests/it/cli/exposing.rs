//! `--exposure`: what it learns, says and writes, that it repeats and goes on, and that nothing is done
//! without it.

use std::path::Path;

use super::{
    call, config, copy_unfinished, files, json, model, read, resume, scratch, text, train,
};
use crate::photographs::Photographs;

const ITERATIONS: u32 = 120;

#[test]
fn exposures_survive_a_stop_and_do_not_depend_on_threads() {
    let scene = Photographs::colmap_text();
    let flags = "--exposure on --eval --checkpoint-every 70 --policy mcmc --backend cpu";
    let (root, whole) = scratch();
    let outcome = train(scene.path(), &whole, ITERATIONS, &format!("{flags} --threads 1")).ok();
    for words in ["exposure on, from one for all views", "fitted   PSNR"] {
        assert!(outcome.stdout.contains(words), "{words}: {}", outcome.stdout);
    }
    let learned = format!("point_cloud/iteration_{ITERATIONS}/exposure.json");
    let exposures = json(&whole.join(&learned));
    let views = exposures.as_object().expect("exposures by name");
    assert_eq!(views.len(), 12, "of the training views alone");
    assert!(views.values().any(|rows| rows[1][1] != 1.0 && rows[1][3] != 0.0), "{exposures}");
    assert!(views.values().all(|rows| rows[0][1] == 0.0), "{exposures}");
    let scores = &json(&whole.join("results.json"))["ours_120"];
    let [plain, fitted] = ["PSNR", "PSNR_fitted"].map(|key| scores[key].as_f64().expect(key));
    assert!(fitted > plain, "{scores}");
    let by_view = &json(&whole.join("per_view.json"))["ours_120"];
    assert!(by_view["SSIM_fitted"]["view_00.png"].is_f64(), "{by_view}");

    let threads = root.path().join("threads");
    train(scene.path(), &threads, ITERATIONS, &format!("{flags} --threads 3")).ok();
    let part = root.path().join("part");
    copy_unfinished(&whole, &part, ITERATIONS);
    let again = resume(scene.path(), &part, "").ok();
    assert!(again.stdout.contains("from step 70"), "{}", again.stdout);
    for run in [threads, part] {
        assert!(model(&run, ITERATIONS) == model(&whole, ITERATIONS), "{}", run.display());
        assert!(read(&run.join(&learned)) == read(&whole.join(&learned)), "{}", run.display());
    }
    let refused = resume(scene.path(), &whole, "--exposure off");
    refused.refused("another exposure", &["--exposure", "contradicts"]);
    // The evaluation of such a run fits, too.
    let evaluated = call(&format!("eval {} --backend cpu", text(&whole))).ok();
    assert!(evaluated.stdout.contains("fitted"), "{}", evaluated.stdout);
}

/// What photographs begin with is in checkpoints alone: a run that was killed before its first finds it again.
#[test]
fn a_run_killed_before_its_first_checkpoint_begins_from_the_same_exposures() {
    let (root, whole) = scratch();
    let scene = root.path().join("scene");
    spheres(&scene, "--train 12 --exposure-jitter 1");
    for choice in ["on", "auto"] {
        let flags = format!("--exposure {choice} --backend cpu --budget 1700 --checkpoint-every 0");
        let (whole, part) = (whole.join(choice), root.path().join(format!("part-{choice}")));
        train(&scene, &whole, 20, &flags).ok();
        copy_unfinished(&whole, &part, 20);
        assert!(!files(&part).keys().any(|name| name.ends_with(".safetensors")));
        let again = resume(&scene, &part, "").ok().stdout;
        assert!(again.contains("begins at its start"), "{again}");
        let begun = ["exposure on, from the gains of points", "exposure on (auto)"];
        assert!(begun.iter().any(|begun| again.contains(begun)), "{again}");
        assert!(model(&part, 20) == model(&whole, 20), "--exposure {choice}");
        let learned = "point_cloud/iteration_20/exposure.json";
        assert!(read(&part.join(learned)) == read(&whole.join(learned)), "--exposure {choice}");
    }
}

/// A run's model was learned with exposures, so it is trained on with them; a file says nothing of them.
#[test]
fn a_compressed_run_keeps_its_exposures() {
    let (root, run) = scratch();
    let scene = root.path().join("scene");
    spheres(&scene, "--train 12 --exposure-jitter 1");
    train(&scene, &run, 30, "--exposure on --eval --backend cpu --budget 1700").ok();
    let compressed = |model: &str, name: &str| {
        let file = root.path().join(name);
        let words = format!("--to 800 -o {} --iterations 20 --backend cpu", text(&file));
        (call(&format!("compress {model} {words}")).ok().stdout, read(&file))
    };
    let (said, with) = compressed(text(&run), "with.ply");
    assert!(said.contains("exposure learned again"), "{said}");
    let file = densify::train::output::model_path(&run, 30);
    let model = format!("{} --scene {} --eval", text(&file), text(&scene));
    let (said, without) = compressed(&model, "without.ply");
    assert!(!said.contains("exposure"), "{said}");
    assert!(with != without);
}

/// Seeds 3 and 8 jitter least, by 0.42 to 0.48 stops, and the gains of seed 6 leave most of the difference.
/// `docs/studies/exposure-jitter.tsv` has ten seeds of three scenes.
#[test]
#[ignore = "takes half a minute: run by .ci/run"]
fn jitter_of_a_stop_switches_exposures_on_whatever_the_seed() {
    let (root, _) = scratch();
    let decides = |seed: u32, jitter: &str| {
        let scene = root.path().join(format!("{seed}{jitter}"));
        let size = "--size 128 --train 20 --test 6 --points 3000 --samples 3";
        let words =
            format!("scenegen --preset room {size} --seed {seed} --exposure-jitter {jitter}");
        call(&format!("{words} -o {}", text(&scene))).ok();
        call(&format!("plan {} --eval --exposure auto --backend cpu", text(&scene))).ok().stdout
    };
    for seed in [3, 6, 8] {
        let said = decides(seed, "1");
        assert!(said.contains("exposure on (auto): by the colours"), "{seed}: {said}");
    }
    let said = decides(3, "0");
    assert!(said.contains("exposure off (auto): by the colours"), "{said}");
}

/// What is promised of a disturbed room: half a decibel. Measured: 32.93 dB undisturbed, 32.68 with `auto`, 28.56 off.
#[test]
#[ignore = "takes minutes: run by .ci/run"]
fn a_disturbed_room_is_learned_as_well_as_the_undisturbed_one() {
    let (root, _) = scratch();
    let score = |jitter: &str, flags: &str| {
        let [scene, run] =
            ["scene", "run"].map(|what| root.path().join(format!("{what}{jitter}{}", flags.len())));
        let size = "--size 128 --train 20 --test 6 --points 3000 --samples 3";
        let words = format!("scenegen --preset room {size} --exposure-jitter {jitter}");
        call(&format!("{words} -o {}", text(&scene))).ok();
        let flags = format!("--eval --backend cpu --budget 4k {flags}");
        train(&scene, &run, 1500, &flags).ok();
        call(&format!("eval {} --backend cpu --fit-exposure", text(&run))).ok();
        json(&run.join("results.json"))["ours_1500"]["PSNR_fitted"].as_f64().expect("a score")
    };
    let plain = score("0", "--exposure auto");
    let auto = score("1", "--exposure auto");
    let off = score("1", "--exposure off");
    let all = format!("undisturbed {plain:.2}, auto {auto:.2}, off {off:.2} dB");
    assert!(plain - auto < 0.5, "{all}");
    assert!(plain - off > 1.0, "without exposures nothing is lost: {all}");
}

/// Too few points are known in enough views to decide anything, so that it is as without the option.
#[test]
fn what_is_not_used_changes_nothing() {
    let scene = Photographs::colmap_text();
    let run = |flags: &str| {
        let (root, run) = scratch();
        let flags = format!("{flags} --eval --policy mcmc --backend cpu");
        let outcome = train(scene.path(), &run, ITERATIONS, &flags).ok();
        (root, run, outcome.stdout)
    };
    let (_off, off, said) = run("");
    assert!(!said.contains("exposure"), "{said}");
    assert_eq!(config(&off)["exposure"].as_str(), Some("off"));
    let (_auto, auto, said) = run("--exposure auto");
    assert!(said.contains("exposure off (auto): fewer than 500 points"), "{said}");
    assert!(model(&off, ITERATIONS) == model(&auto, ITERATIONS));
    assert!(read(&off.join("results.json")) == read(&auto.join("results.json")));
    // The name of the file for TensorBoard has the second in which the run began.
    let names = |run: &Path| {
        let found = files(run).into_keys();
        found.filter(|name| !name.contains("tfevents")).collect::<Vec<_>>()
    };
    assert_eq!(names(&off), names(&auto));
    let ledger = |run| json(&Path::join(run, "stats/summary.json"))["ledger"].clone();
    assert!(!ledger(&off).to_string().contains("exposure"), "{}", ledger(&off));
    let fits = call(&format!("eval {} --backend cpu --fit-exposure", text(&off))).ok();
    assert!(fits.stdout.contains("fitted"), "{}", fits.stdout);
    assert!(json(&off.join("results.json"))["ours_120"]["PSNR_fitted"].is_f64());
}

/// Writes a small scene whose points are known in its views.
fn spheres(folder: &Path, options: &str) {
    let size = "--size 64 --test 2 --points 1500 --samples 1";
    call(&format!("scenegen --preset spheres {size} -o {} {options}", text(folder))).ok();
}

/// A written scene decides by its points whether exposures are learned, and says so.
#[test]
fn exposures_that_differ_are_seen_before_training() {
    let (root, _) = scratch();
    let words = "scenegen --preset spheres --size 64 --train 12 --test 2 --points 1500 --samples 1";
    for (jitter, word) in [("1", "on"), ("0", "off")] {
        let [folder, run] =
            ["scene", "run"].map(|name| root.path().join(format!("{name}{jitter}")));
        call(&format!("{words} -o {} --exposure-jitter {jitter}", text(&folder))).ok();
        let factors = json(&folder.join("scene.json"))["view_exposures"].clone();
        assert_eq!(factors.is_object(), jitter == "1", "{factors}");
        let flags = "--exposure auto --eval --backend cpu --budget 2k";
        let outcome = train(&folder, &run, 3, flags).ok();
        let said = format!("exposure {word} (auto): by the colours of");
        assert!(outcome.stdout.contains(&said), "{}", outcome.stdout);
        let report = json(&run.join("stats/requirements.json"));
        assert_eq!(report["exposures"], word == "on", "{report}");
        let left_out = report["left_out"].to_string().contains("exposure for each photograph");
        assert_eq!(left_out, word == "off", "{report}");
        if word == "off" {
            // Enough is known to decide, and nothing of the model differs. Only deciding takes memory.
            let without = root.path().join("without");
            train(&folder, &without, 3, "--eval --backend cpu --budget 2k").ok();
            assert!(model(&run, 3) == model(&without, 3));
            assert!(read(&run.join("results.json")) == read(&without.join("results.json")));
            let ledger = |run: &Path| json(&run.join("stats/summary.json"))["ledger"].to_string();
            let colours = [&run, &without].map(|run| ledger(run).contains("colours of tracks"));
            assert_eq!(colours, [true, false]);
        }
    }
    call(&format!("{words} -o {} --exposure-jitter 9", text(&root.path().join("none"))))
        .refused("too much", &["--exposure-jitter", "9 stops", "0 to 8"]);
}
