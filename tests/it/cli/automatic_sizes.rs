//! Automatic SH degree and budget, and `requirements.json`, which reports what was left out.

use std::path::Path;

use densify_policies::registry::find;
use serde_json::Value;

use super::{call, copy_unfinished, frequent_edits, json, model, resume, scratch, text};
use crate::photographs::Photographs;

const ITERATIONS: u32 = 400;

/// Trains a scene. `flags` are separated by spaces.
fn train(scene: &Path, run: &Path, flags: &str) -> super::Outcome {
    let fixed = format!("--iterations {ITERATIONS} --backend cpu");
    call(&format!("train {} -o {} {fixed} {flags}", text(scene), text(run)))
}

fn report(run: &Path) -> Value {
    json(&run.join("stats/requirements.json"))
}

fn list<'a>(value: &'a Value, path: &str) -> &'a [Value] {
    value.pointer(path).and_then(Value::as_array).map_or(&[], Vec::as_slice)
}

#[test]
fn automatic_choices_survive_resuming_and_do_not_depend_on_threads() {
    let scene = Photographs::colmap_text();
    let policy = find("mcmc").expect("a registered policy");
    let flags = format!(
        "--sh-degree auto --budget auto --policy mcmc {} --init random --init-points 1k",
        frequent_edits(policy)
    );
    let (root, whole) = scratch();
    let outcome =
        train(scene.path(), &whole, &format!("{flags} --threads 1 --checkpoint-every 250")).ok();
    assert!(outcome.stdout.contains("left out"), "{}", outcome.stdout);
    let found = report(&whole);
    // The scene has too few tracks to decide the degree.
    let line = "colour   degree 3 (auto): undecided, because fewer than";
    assert!(outcome.stdout.contains(line), "{}", outcome.stdout);
    assert_eq!((&found["sh_degree_from"], &found["sh_degree"]), (&"undecided".into(), &3.into()));
    let intervals = list(&found, "/rows/intervals");
    assert!(intervals.len() >= 2 && !list(&found, "/rows/removals").is_empty(), "{found}");
    let rows = |interval: &Value| interval["rows"].as_u64().expect("rows");
    let mut limit = 1_000_f64;
    let stopped = found["rows"]["stopped"].as_u64().unwrap_or(u64::MAX);
    for interval in intervals {
        assert!(rows(interval) as f64 <= limit.round(), "{found}");
        // Only settled intervals raise the limit; in the others, the model still recovers from an edit.
        if interval["settled"] == true && interval["step"].as_u64() < Some(stopped) {
            limit = limit.round() * std::f64::consts::SQRT_2;
        }
        assert!(interval["settled"] == true || interval["gain"].is_null(), "{found}");
    }
    for removal in list(&found, "/rows/removals") {
        let interval = intervals.iter().find(|interval| interval["step"] == removal["step"]);
        assert!(interval.is_some_and(|interval| interval["settled"] == true), "{found}");
    }

    let threads = root.path().join("threads");
    train(scene.path(), &threads, &format!("{flags} --threads 2")).ok();
    let part = root.path().join("part");
    copy_unfinished(&whole, &part, ITERATIONS);
    let again = resume(scene.path(), &part, "").ok();
    assert!(again.stdout.contains("from step 250"), "{}", again.stdout);
    for run in [threads, part] {
        assert!(model(&run, ITERATIONS) == model(&whole, ITERATIONS), "{}", run.display());
        assert_eq!(report(&run), found, "{}", run.display());
    }
}

#[test]
#[ignore = "takes minutes: run by .ci/run"]
fn the_automatic_degree_is_the_same_for_a_built_in_scene_and_its_files() {
    let (_root, folder) = scratch();
    call(&format!("scenegen --preset spheres -o {}", text(&folder))).ok();
    let planned = |flags: &str, start: &str| {
        let outcome = call(&format!("plan --backend cpu --threads 2 {flags}")).ok();
        let line = outcome.stdout.lines().find(|line| line.starts_with(start));
        line.unwrap_or_else(|| panic!("{}", outcome.stdout)).to_owned()
    };
    let line = |scene: &str| planned(&format!("{scene} --sh-degree auto --budget 2k"), "colour ");
    let built_in = line("scene:spheres");
    assert!(built_in.starts_with("colour   degree 0 (auto)"), "{built_in}");
    let folder_text = text(&folder);
    assert_eq!(line(folder_text), built_in, "transforms beside a model with tracks");
    // The memory for choosing the degree is released before anything else is allocated, so that a run takes as much as
    // with an explicit degree. What the process holds meanwhile is measured, and may differ.
    let table = |degree: &str| {
        let flags = "--budget 2k --backend cpu --threads 2 -v";
        let stdout = call(&format!("plan {folder_text} --sh-degree {degree} {flags}")).ok().stdout;
        let lines = stdout.lines().skip_while(|line| *line != "memory promised");
        let lines = lines.take_while(|line| !line.starts_with("  total"));
        let is_fixed =
            |line: &&str| !line.starts_with("  before") && !line.contains("program and dataset");
        lines.filter(is_fixed).map(str::to_owned).collect::<Vec<_>>()
    };
    let automatic = table("auto");
    assert!(automatic.len() > 15, "{automatic:#?}");
    assert_eq!(automatic, table("0"));
    // The COLMAP files alone give the same degree.
    for file in ["transforms_train.json", "transforms_test.json"] {
        std::fs::remove_file(folder.join(file)).expect("an existing file");
    }
    assert!(line(folder_text).starts_with("colour   degree 0 (auto)"));
}

#[test]
fn nothing_is_left_out_by_default() {
    let scene = Photographs::colmap_text();
    for (flags, note) in [("", "left out nothing\n"), ("--full", "left out nothing (--full)\n")] {
        let (_root, run) = scratch();
        let (scene, output) = (text(scene.path()), text(&run));
        let outcome = call(&format!("train {scene} -o {output} --iterations 5 {flags}")).ok();
        assert!(outcome.stdout.contains(note), "{}", outcome.stdout);
        assert_eq!(report(&run)["left_out"], serde_json::json!([]));
        assert_eq!(report(&run)["sh_degree"], 3);
    }
}

#[test]
fn contradictory_flags_are_both_named() {
    let scene = Photographs::colmap_text();
    let (_root, run) = scratch();
    for (flags, words) in [
        ("--full --sh-degree auto", ["--full", "--sh-degree auto"]),
        ("--sh-degree 4", ["--sh-degree", "auto"]),
    ] {
        train(scene.path(), &run, flags).refused(flags, &words);
        assert!(!run.exists(), "{flags}");
    }
    train(scene.path(), &run, "--sh-degree 1 --budget 500").ok();
    let again = train(scene.path(), &run, "--resume --sh-degree auto");
    again.refused("--resume", &["--resume", "--sh-degree auto", "given 1"]);
    let again = train(scene.path(), &run, "--resume --full");
    again.refused("--resume", &["--resume", "--full"]);
}

#[test]
#[ignore = "takes minutes: run by .ci/run"]
fn a_degree_decided_by_trial_runs_survives_resuming() {
    let (root, whole) = scratch();
    let flags = "-r 2 --memory 60MiB --sh-degree auto --iterations 5000 --backend cpu";
    let outcome =
        call(&format!("train scene:spheres -o {} {flags} --checkpoint-every 2500", text(&whole)));
    let outcome = outcome.ok();
    let line = "colour   degree 3 (auto): in trial runs of 1,000 iterations";
    assert!(outcome.stdout.contains(line), "{}", outcome.stdout);
    let found = report(&whole);
    let trial = &found["sh_degree_from"]["trial"];
    let pair = |field: &str| [0, 1].map(|at| trial[field][at].as_f64().expect("a number"));
    let ([low, high], [many, few]) = (pair("psnr"), pair("rows"));
    assert!(many > 1.5 * few && low.min(high) > 20.0 && low - high < 1.0, "{trial}");
    assert_eq!((&found["sh_degree"], &found["left_out"]), (&3.into(), &serde_json::json!([])));
    let part = root.path().join("part");
    copy_unfinished(&whole, &part, 5_000);
    let again = call(&format!("train -o {} --resume", text(&part))).ok();
    assert!(!again.stdout.contains("two trial runs"), "{}", again.stdout);
    assert!(model(&part, 5_000) == model(&whole, 5_000), "{}", part.display());
    assert_eq!(report(&part), found);
}

/// In the room, more Gaussians are worth more than view-dependent colours.
#[test]
#[ignore = "takes minutes: run by .ci/run"]
fn trial_runs_choose_more_gaussians_where_they_pay() {
    let (_root, run) = scratch();
    let flags = "-r 2 --memory 84MiB --sh-degree auto --iterations 5000 --backend cpu";
    let outcome = call(&format!("train scene:room -o {} {flags}", text(&run))).ok();
    assert!(
        outcome.stdout.contains("colour   degree 0 (auto): in trial runs"),
        "{}",
        outcome.stdout
    );
    let found = report(&run);
    assert_eq!(found["sh_degree"], 0);
    let evidence = found["left_out"][0]["evidence"].as_str().expect("a text");
    assert!(evidence.starts_with("in trial runs of 1,000 iterations"), "{found}");
    let summary = json(&run.join("stats/summary.json"));
    let bytes = |field: &str| summary[field].as_u64().expect("a number");
    assert!(bytes("peak_bytes") <= bytes("memory"), "{summary}");
}

#[test]
fn what_prevents_trial_runs_is_said() {
    let scene = Photographs::colmap_text();
    let few = text(scene.path());
    for (scene, flags, words) in [
        ("scene:spheres", "--memory 90MiB -i 5000 -r 2", "degree 3 or 0 (auto): two trial runs of"),
        ("scene:spheres", "--memory 90MiB -i 4999 -r 2", "at least 5,000 iterations"),
        ("scene:spheres", "--memory 90MiB -i 5000 -r 4", "still have 32 px at half the size"),
        ("scene:spheres", "--memory 90MiB -i 5000 -r 2 -b 2k", "the budget allows hardly more"),
        (
            "scene:spheres",
            "--memory 90MiB -i 5000 -r 2 --policy-set diet.grow_until=900",
            "in steps",
        ),
        (few, "--memory 90MiB -i 5000", "at least 16 training views"),
    ] {
        let planned = call(&format!("plan {scene} --backend cpu --sh-degree auto {flags}")).ok();
        let line = planned.stdout.lines().find(|line| line.starts_with("colour "));
        assert!(line.is_some_and(|line| line.contains(words)), "{flags}: {}", planned.stdout);
    }
}
