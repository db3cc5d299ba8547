//! `densify train`: the files of a run and the consistency of its figures.

use std::path::Path;

use assert_cmd::Command;
use densify_policies::registry::{find, policies};
use serde_json::Value;

use super::{
    Outcome, WITHOUT_GPU, config, count, files, frequent_edits, json, model, outcome_of, records,
    scratch, text, train,
};
use crate::photographs::{POINTS, Photographs, VIEWS};

const ITERATIONS: u32 = 100;
const BUDGET: u64 = 360;

fn number(value: &Value, key: &str) -> f64 {
    value[key].as_f64().unwrap_or_else(|| panic!("no number {key} in {value}"))
}

/// Checks that the run folder contains exactly the documented files.
fn check_tree(run: &Path) {
    let mut names: Vec<String> = files(run).into_keys().collect();
    let board = names.iter().position(|name| name.starts_with("events.out.tfevents."));
    names.remove(board.expect("a TensorBoard file"));
    let ply = format!("point_cloud/iteration_{ITERATIONS}/point_cloud.ply");
    let checkpoint = format!("checkpoints/iteration_{ITERATIONS}.safetensors");
    let expected = [
        "cameras.json",
        &checkpoint,
        "config.toml",
        "per_view.json",
        &ply,
        "results.json",
        "stats/events.jsonl",
        "stats/requirements.json",
        "stats/summary.json",
        "stats/train.jsonl",
    ];
    assert_eq!(names, expected);
    let cameras = json(&run.join("cameras.json"));
    assert_eq!(cameras.as_array().map(Vec::len), Some(VIEWS));
    assert_eq!(config(run)["budget"].as_integer(), Some(BUDGET as i64));
}

/// Checks that every event stays within the budget and starts from the row count of the previous one.
fn check_events(run: &Path, summary: &Value) {
    let events = records(&run.join("stats/events.jsonl"));
    assert!(!events.is_empty(), "the policy did nothing in {ITERATIONS} steps");
    let mut rows = None;
    let mut step = 0;
    for event in &events {
        let [before, removed, added, after] =
            ["before", "removed", "added", "after"].map(|key| count(event, key));
        assert!(count(event, "step") > step, "{event}");
        step = count(event, "step");
        assert!(before.max(after) <= BUDGET, "{event}");
        assert_eq!(before + added - removed, after, "{event}");
        assert!(rows.is_none_or(|rows| rows == before), "{event} does not follow {rows:?}");
        assert!(count(event, "updated") <= after, "{event}");
        assert!(event["denied"].is_u64(), "{event}");
        assert!(event["cause"].as_str().is_some_and(|cause| !cause.is_empty()), "{event}");
        rows = Some(after);
    }
    assert_eq!(rows, Some(count(summary, "rows")));
    assert!(step <= u64::from(ITERATIONS));
}

fn check_summary(run: &Path, policy: &str, held_out: u64) -> Value {
    let summary = json(&run.join("stats/summary.json"));
    assert_eq!(summary["finished"], true);
    assert_eq!(summary["policy"], policy);
    assert_eq!(count(&summary, "iterations"), u64::from(ITERATIONS));
    assert_eq!(count(&summary, "test_views"), held_out);
    assert_eq!(count(&summary, "train_views"), VIEWS as u64 - held_out);
    assert_eq!(count(&summary, "budget"), BUDGET);
    assert!(count(&summary, "rows") <= count(&summary, "peak_rows"));
    assert!(count(&summary, "peak_rows") <= BUDGET);
    if cfg!(target_os = "linux") {
        let (peak, ledger) = (number(&summary, "peak_bytes"), number(&summary, "ledger_bytes"));
        assert!(peak <= 1.15 * ledger, "peak of {peak} bytes, {ledger} promised");
    }
    summary
}

/// Checks that the loss has fallen and the test PSNR is high enough.
fn check_loss(run: &Path, policy: &str, least_psnr: f64) {
    let log = records(&run.join("stats/train.jsonl"));
    assert_eq!(log.len(), ITERATIONS as usize / 10);
    assert_eq!(count(&log[log.len() - 1], "step"), u64::from(ITERATIONS));
    // Sampling restarts all Gaussians of `mini-splatting`, so progress is measured from the first record after it.
    let events = records(&run.join("stats/events.jsonl"));
    let sampled = events.iter().rfind(|event| event["cause"] == "sample");
    let start = sampled.map_or(0, |event| count(event, "step"));
    let loss: Vec<f64> = log
        .iter()
        .filter(|record| count(record, "step") > start)
        .map(|record| number(record, "loss"))
        .collect();
    let first = loss[0];
    let last = loss[loss.len() - 1];
    // The loss need not fall further, because `vanilla` resets opacities midway. `eagles` starts with small images,
    // whose loss is low.
    let is_comparable = policy != "eagles";
    assert!(!is_comparable || last < 0.9 * first, "{policy}: the loss was {loss:?}");
    assert!(log.iter().all(|record| count(record, "rows") <= BUDGET));
    let scores = json(&run.join("results.json"));
    let psnr = number(&scores[format!("ours_{ITERATIONS}")], "PSNR");
    assert!(psnr > least_psnr, "test PSNR {psnr} dB in {}", run.display());
}

fn check(scene: &Photographs, policy: &str, flags: &str, least_psnr: f64) -> Outcome {
    let (_root, run) = scratch();
    let often = frequent_edits(find(policy).expect("a registered policy"));
    let flags = format!("--budget {BUDGET} --policy {policy} {often} --eval {flags}");
    let outcome = train(scene.path(), &run, ITERATIONS, &flags).ok();
    check_tree(&run);
    let summary = check_summary(&run, policy, 2);
    check_events(&run, &summary);
    check_loss(&run, policy, least_psnr);
    outcome
}

#[test]
fn every_policy_trains_on_a_colmap_dataset() {
    let scene = Photographs::colmap_text();
    for policy in policies().expect("the registry is sound").iter().map(|entry| entry.name) {
        let least_psnr = match policy {
            "diet" => 26.0,
            "vanilla" => 22.0,
            _ => 18.0,
        };
        let outcome = check(&scene, policy, "", least_psnr);
        for words in ["promised in all", "360 rows", "test     PSNR", "300 points"] {
            assert!(outcome.stdout.contains(words), "{policy}: {words:?} in {}", outcome.stdout);
        }
        // Each edit is one line of the log.
        let edits = outcome.stderr.lines().filter(|line| line.contains("denied="));
        assert!(edits.clone().count() > 0, "{}", outcome.stderr);
        for key in ["step=", "before=", "removed=", "added=", "after=", "cause="] {
            assert!(edits.clone().all(|line| line.contains(key)), "{key} in {}", outcome.stderr);
        }
    }
}

#[test]
fn training_works_with_transparency_and_without_points() {
    let scene = Photographs::transforms();
    for (policy, least_psnr) in [("diet", 18.0), ("vanilla", 16.0)] {
        let quiet = check(&scene, policy, "--background white --quiet", least_psnr);
        assert_eq!((&*quiet.stdout, &*quiet.stderr), ("", ""));
    }
}

#[test]
fn points_beyond_the_budget_are_subsampled_and_reported() {
    let scene = Photographs::colmap_text();
    let (_root, run) = scratch();
    let outcome = train(scene.path(), &run, 3, "--budget 100").ok();
    let message = format!("{} points beyond the budget", POINTS - 100);
    assert!(outcome.stdout.contains(&message), "{}", outcome.stdout);
    assert!(outcome.stdout.contains("100 Gaussians from 300 points"), "{}", outcome.stdout);
    let summary = json(&run.join("stats/summary.json"));
    assert_eq!(count(&summary, "peak_rows"), 100);
}

#[test]
fn a_budget_of_one_row_trains() {
    let scene = Photographs::colmap_text();
    for policy in policies().expect("the registry is sound").iter().map(|entry| entry.name) {
        let (_root, run) = scratch();
        train(scene.path(), &run, 100, &format!("--budget 1 --policy {policy} --quiet")).ok();
        let summary = json(&run.join("stats/summary.json"));
        assert_eq!((count(&summary, "rows"), count(&summary, "peak_rows")), (1, 1), "{policy}");
    }
}

#[test]
fn overwriting_needs_a_flag_and_replaces_the_whole_run() {
    let scene = Photographs::colmap_text();
    let (_root, run) = scratch();
    train(scene.path(), &run, 2, "--budget 300").ok();
    std::fs::write(run.join("notes.txt"), "mine").expect("a note");
    let before = files(&run);
    train(scene.path(), &run, 3, "--budget 300")
        .refused("occupied", &["another run", "--overwrite"]);
    assert!(files(&run) == before, "the refused call changed the existing run");
    train(scene.path(), &run, 3, "--budget 300 --overwrite").ok();
    let after = files(&run);
    assert!(after.contains_key("point_cloud/iteration_3/point_cloud.ply"));
    assert!(!after.contains_key("point_cloud/iteration_2/point_cloud.ply"));
    assert_eq!(after["notes.txt"], b"mine");
    assert!(after.keys().all(|name| !name.starts_with('.')), "{:?}", after.keys());
}

#[test]
fn the_policy_sets_how_often_view_dependent_colour_is_updated() {
    let scene = Photographs::colmap_text();
    let trained = |flags: &str| {
        let (_root, run) = scratch();
        let flags = format!("--budget 330 --policy taming -v {flags}");
        let outcome = train(scene.path(), &run, 20, &flags).ok();
        (model(&run, 20), outcome.stdout.contains("gradients summed between steps"))
    };
    let [published, same, every] =
        ["", "--policy-set taming.sh_every=16", "--policy-set taming.sh_every=1"].map(trained);
    assert!(published.1 && !every.1);
    assert!(published.0 == same.0 && published.0 != every.0);
}

#[test]
fn reinitialisation_stays_within_the_budget() {
    let scene = Photographs::colmap_text();
    let (_root, run) = scratch();
    let flags = "--budget 330 --eval --policy-set diet.reinit_at=30";
    train(scene.path(), &run, 60, flags).ok();
    let events = records(&run.join("stats/events.jsonl"));
    let replaced = events.iter().find(|event| event["cause"] == "reinit").expect("an event");
    assert_eq!(count(replaced, "step"), 30);
    assert_eq!(count(replaced, "removed"), count(replaced, "before"));
    let views = (VIEWS - 2) as u64;
    let after = count(replaced, "after");
    // ⌊0.8 · 330⌋ = 264 points, equally many of each view; a few pixels show no surface.
    assert!(after <= 264 / views * views && after > 200, "{replaced}");
    let summary = json(&run.join("stats/summary.json"));
    assert_eq!(count(&summary, "extra_forwards"), views);
    assert!(count(&summary, "peak_rows") <= 330);
}

#[test]
fn instruction_sets_are_chosen_by_the_environment() {
    let call = |set: &str, arguments: &[&str]| {
        let mut command = Command::new(env!("CARGO_BIN_EXE_densify"));
        command.args(arguments).env("DENSIFY_INSTRUCTIONS", set).envs([WITHOUT_GPU]);
        command.env("XDG_CACHE_HOME", env!("CARGO_TARGET_TMPDIR"));
        outcome_of(command)
    };
    call("avx9", &["knobs"]).refused("avx9", &["DENSIFY_INSTRUCTIONS", "`avx9`", "scalar"]);
    let (_kept, folder) = scratch();
    let trained = |set: &str| {
        let run = folder.join(set);
        let fixed = "train scene:spheres --backend cpu -i 5 -b 300 --quiet -o";
        let mut arguments: Vec<&str> = fixed.split(' ').collect();
        arguments.push(text(&run));
        call(set, &arguments).ok();
        model(&run, 5)
    };
    let [best, scalar] = ["best", "scalar"].map(trained);
    assert_eq!(best.len(), scalar.len());
    // Sums are added in another order, so the last bits differ where there are vectors.
    if cfg!(any(target_arch = "x86_64", target_arch = "aarch64")) {
        assert_ne!(best, scalar);
    }
}
