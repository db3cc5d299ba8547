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
    }
    call(&format!("{words} -o {} --exposure-jitter 9", text(&root.path().join("none"))))
        .refused("too much", &["--exposure-jitter", "9 stops", "0..=8"]);
}
