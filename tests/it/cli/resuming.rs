//! Runs that are stopped and go on: the same bytes as if nothing had been, for every policy; and
//! what cannot be gone on from is refused.

use std::path::{Path, PathBuf};

use densify_policies::registry::{PolicyEntry, find, policies};
use serde_json::Value;
use tempfile::TempDir;

use super::{
    Outcome, copy_unfinished, count, files, frequent_edits, json, model, read, records, resume,
    scratch, train,
};
use crate::photographs::Photographs;
use crate::subject::devices;

const ITERATIONS: u32 = 202;
/// Half of it: in the midst of an epoch of 12 views, and of any interval of `frequent_edits`.
const HALF: u32 = 101;

fn checkpoint(run: &Path, step: u32) -> std::path::PathBuf {
    run.join(format!("checkpoints/iteration_{step}.safetensors"))
}

/// The value of a log or a summary without what depends on the clock, or on the process (which a
/// built-in scene makes grow).
fn timeless(mut value: Value) -> Value {
    let clock = ["seconds", "cpu_seconds", "stage_seconds"];
    let process = ["peak_bytes", "resident_bytes", "ledger", "ledger_bytes"];
    for key in clock.into_iter().chain(process) {
        value.as_object_mut().expect("a record").remove(key);
    }
    value
}

/// Fails unless two runs have left the same, but for times.
fn assert_same(a: &Path, b: &Path, what: &str) {
    let log = |run: &Path| -> Vec<Value> {
        records(&run.join("stats/train.jsonl")).into_iter().map(timeless).collect()
    };
    assert_eq!(log(a), log(b), "{what}");
    let summary = |run: &Path| timeless(json(&run.join("stats/summary.json")));
    assert_eq!(summary(a), summary(b), "{what}");
    let (a, b) = (files(a), files(b));
    assert!(a.keys().eq(b.keys()), "{what}: {:?} and {:?}", a.keys(), b.keys());
    let exact = ["stats/events.jsonl", "config.toml", "cameras.json", ".ply", "results.json"];
    for name in a.keys() {
        let is_exact = exact.iter().any(|end| name.ends_with(end));
        assert!(!is_exact || a[name] == b[name], "{what}: {name} differs");
        // TensorBoard's has times, too.
        let is_board = name.contains("tfevents");
        assert!(!is_board || a[name].len() == b[name].len(), "{what}: {name}");
    }
}

/// Trains to the end; then goes on from the checkpoint at half of it, in a copy of the folder in
/// which the logs still have everything later. Returns the run that was not stopped, and the folder that it is in.
fn compare(scene: &Path, flags: &str, what: &str) -> (TempDir, PathBuf) {
    let (root, whole) = scratch();
    let flags = format!("--checkpoint-every {HALF} {flags}");
    train(scene, &whole, ITERATIONS, &flags).ok();
    let part = root.path().join("part");
    copy_unfinished(&whole, &part, ITERATIONS);
    let outcome = train(scene, &part, ITERATIONS, &format!("{flags} --resume")).ok();
    let said = format!("from step {HALF}");
    assert!(outcome.stdout.contains(&said), "{what}: {}", outcome.stdout);
    assert_same(&whole, &part, what);
    let events = records(&whole.join("stats/events.jsonl"));
    let steps: Vec<u64> = events.iter().map(|event| count(event, "step")).collect();
    let half = u64::from(HALF);
    let sides = (steps.iter().any(|&step| step < half), steps.iter().any(|&step| step > half));
    assert_eq!(sides, (true, true), "{what}: no edits on both sides: {steps:?}");
    assert!(!steps.contains(&half), "{what}: an edit just then");
    (root, whole)
}

/// The PSNR of test views and the Gaussians at the end of a run.
fn quality(run: &Path) -> (f64, u64) {
    let scores = &json(&run.join("results.json"))[format!("ours_{ITERATIONS}")];
    let rows = count(&json(&run.join("stats/summary.json")), "rows");
    (scores["PSNR"].as_f64().expect("a score"), rows)
}

/// Flags by which a policy acts almost to the end, and does once a little later what it would do at half of
/// the run.
fn late(policy: &PolicyEntry) -> String {
    let at = |(name, default): (String, toml::Value)| {
        let is_half = name.ends_with("_at") && default.as_integer() == Some(15_000);
        let step = if is_half { Some(107) } else { name.ends_with("_until").then_some(190) };
        Some(format!("--policy-set {}.{name}={} ", policy.name, step?))
    };
    policy.parameters().into_iter().filter_map(at).collect()
}

/// Every registered policy, with flags for a short run of it.
fn short_policies() -> impl Iterator<Item = (&'static str, String)> {
    policies().expect("the registry is sound").into_iter().map(|entry| {
        let (policy, often, late) = (entry.name, frequent_edits(entry), late(entry));
        (policy, format!("--policy {policy} {often} {late} --eval"))
    })
}

#[test]
fn every_policy_goes_on_as_if_nothing_had_been() {
    let scene = Photographs::colmap_text();
    for (policy, flags) in short_policies() {
        compare(scene.path(), &format!("{flags} --budget 2k"), policy);
    }
}

/// And as well as on the native backend. On one adapter: what differs between drivers, `agreement` has found, and
/// runs take long.
#[test]
#[ignore = "takes minutes: run by .ci/run"]
fn every_policy_goes_on_a_device_as_if_nothing_had_been() {
    let Some(device) = devices().first() else { return };
    let name = device.adapter().name.split(' ').next().expect("a name");
    let scene = Photographs::colmap_text();
    for (policy, flags) in short_policies() {
        // Few Gaussians: software drivers take long for each, and it is states and edits that are tested.
        let flags = format!("{flags} --budget 900");
        let on_device = format!("{flags} --backend gpu --gpu {name} --deterministic");
        let (_whole_root, whole) = compare(scene.path(), &on_device, policy);
        let (_root, run) = scratch();
        train(scene.path(), &run, ITERATIONS, &format!("{flags} --backend cpu")).ok();
        let [found, expected] = [whole, run].map(|run| quality(&run));
        let told = format!("{policy} on {name}: {found:?}, natively {expected:?}");
        // Where a sum ends in another bit, another Gaussian may be replaced: up to 0.11 dB in so short a run.
        // `mini-splatting` draws all of them by weights.
        let near = if policy == "mini-splatting" { 2.0 } else { 0.3 };
        assert!((found.0 - expected.0).abs() < near, "{told}");
        assert!(found.1.abs_diff(expected.1) * 50 <= expected.1, "{told}");
    }
}

#[test]
fn whatever_outlives_a_step_is_kept() {
    let scene = Photographs::colmap_text();
    // Gradients summed until the very next step; bands; a background of its own at every step; a later degree.
    for flags in [
        "--policy mcmc --policy-set mcmc.grow_every=7",
        "--policy taming --policy-set taming.sh_every=17 --policy-set taming.grow_every=7",
        "--policy taming --policy-set taming.grow_every=7 --background random --threads 2",
        "--policy vanilla --policy-set vanilla.grow_every=9 --tile-cap 400 --seed 5",
        "--policy diet --policy-set diet.grow_every=9 --save-iterations 50,150 --eval \
         --test-iterations 30,101,160",
        // Candidates wait at the checkpoint.
        "--policy vanilla --policy-set vanilla.grow_every=9",
        "--policy mcmc --policy-set mcmc.grow_every=7 --threads 2",
        "--policy diet --policy-set diet.grow_every=9 --policy-set diet.insert_every=19 \
         --policy-set diet.rows_per_candidate=20 --policy-set diet.compensate_from=60 \
         --policy-set diet.rho_c=0.1",
    ] {
        let policy = flags.split(' ').nth(1).expect("a name");
        let late = late(find(policy).expect("it is registered"));
        compare(scene.path(), &format!("--budget 2k {flags} {late}"), flags);
    }
}

#[test]
#[ignore = "takes minutes: run by .ci/run"]
fn a_built_in_scene_goes_on_too() {
    compare(
        Path::new("scene:spheres"),
        "--budget 4k -r 16 --policy-set diet.grow_every=20 --policy-set diet.grow_until=190",
        "",
    );
}

/// A run of 40 steps with checkpoints at 10, 20, …; the last two are left.
fn short_run(scene: &Photographs, run: &Path, flags: &str) -> Outcome {
    let flags = format!("--budget 330 --checkpoint-every 10 --policy-set diet.rho=0.25 {flags}");
    train(scene.path(), run, 40, &flags).ok()
}

/// Steps of colour so long that their squares are infinite: every row is unsound at the first audit.
#[test]
fn a_run_that_diverges_is_kept() {
    let scene = Photographs::colmap_text();
    let (_root, run) = scratch();
    let diverges = |outcome: Outcome| {
        let Outcome { code, stderr, .. } = &outcome;
        assert_eq!(*code, Some(1), "{outcome:?}");
        for word in ["step 100: ", "rows hold numbers that are not finite", "--resume", "row 0"] {
            assert!(stderr.contains(word), "{word:?} is not in {stderr}");
        }
    };
    diverges(train(scene.path(), &run, 200, "--budget 330 --lr sh_dc=1e38 --policy mcmc"));
    let names: Vec<String> = files(&run.join("checkpoints")).into_keys().collect();
    assert_eq!(names, ["iteration_100.safetensors"]);
    // Nothing has become of it meanwhile: it ends at the next audit.
    let again = resume(scene.path(), &run, "--on-nan stop");
    assert!(again.code == Some(1) && again.stderr.contains("step 200: "), "{again:?}");
}

#[test]
fn a_run_without_checkpoints_cannot_go_on() {
    let scene = Photographs::colmap_text();
    let (_root, run) = scratch();
    train(scene.path(), &run, 20, "--budget 330 --checkpoint-every 0").ok();
    assert!(!run.join("checkpoints").exists());
    let refused = resume(scene.path(), &run, "");
    refused.refused("none", &["no checkpoint to go on from", "--overwrite"]);
}

#[test]
fn a_damaged_checkpoint_is_named_and_the_one_before_is_taken() {
    let scene = Photographs::colmap_text();
    let (root, run) = scratch();
    short_run(&scene, &run, "");
    let sound = read(&checkpoint(&run, 40));
    let expected = model(&run, 40);
    let mut flipped = sound.clone();
    flipped[sound.len() - 3] ^= 4;
    // Other faults of a file, and what is said of them, are in `src/checkpoint/tests.rs`.
    let faults: [(&str, Vec<u8>, &str); 3] = [
        ("cut", sound[..sound.len() - 9].to_vec(), "cut short"),
        ("a bit of a tensor", flipped, "damaged"),
        ("a picture", read(&scene.file("images/view_00.png")), "not a safetensors file"),
    ];
    for (what, bytes, words) in &faults {
        let here = root.path().join("here");
        copy_unfinished(&run, &here, 0);
        std::fs::write(checkpoint(&here, 40), bytes).expect("a damaged file");
        let outcome = resume(scene.path(), &here, "").ok();
        for word in ["iteration_40.safetensors", words, "from step 30"] {
            assert!(outcome.stdout.contains(word), "{what}: {word:?} in {}", outcome.stdout);
        }
        assert!(model(&here, 40) == expected, "{what}");
        // What was damaged has been written anew, by a process of its own: it is sound.
        resume(scene.path(), &here, "").ok();
        std::fs::write(checkpoint(&here, 30), bytes).expect("a damaged file");
        std::fs::write(checkpoint(&here, 40), bytes).expect("a damaged file");
        let both = ["iteration_30.safetensors", "iteration_40.safetensors", words, "--overwrite"];
        resume(scene.path(), &here, "").refused(what, &both);
        std::fs::remove_dir_all(&here).expect("the copy");
    }
}

#[test]
fn options_that_contradict_the_checkpoint_are_refused_by_name() {
    let scene = Photographs::colmap_text();
    let (_root, run) = scratch();
    short_run(&scene, &run, "");
    let before = files(&run);
    let cases: [(&str, &[&str]); 13] = [
        ("--budget 400", &["--budget: 400 now, 330 in that run", "iteration_40"]),
        ("--policy vanilla", &["--policy: \"vanilla\" now, \"diet\" in that run"]),
        // Its masks would begin in the midst of the run.
        ("--policy compact-3dgs", &["--policy: \"compact-3dgs\" now, \"diet\" in that run"]),
        ("--policy-set diet.rho=0.5", &["--policy-set diet.rho: 0.5 now, 0.25 in"]),
        ("--lr opacity=0.5", &["--lr opacity: 0.5 now"]),
        ("--seed 3 --sh-degree 2", &["--seed: 3 now, 0 in", "--sh-degree: 2 now, 1 in"]),
        ("--background white", &["--background: \"white\" now, \"black\" in"]),
        ("--eval", &["--eval: true now, false in"]),
        ("--test-every 3", &["--test-every: 3 now, not set in"]),
        ("--init random", &["--init: \"random\" now, \"points\" in"]),
        ("-r 2", &["--resolution: 2 now, not set in"]),
        ("--iterations 39", &["--iterations 39", "40 iterations", "extended"]),
        ("--overwrite", &["--overwrite", "--resume"]),
    ];
    for (flags, words) in cases {
        resume(scene.path(), &run, flags).refused(flags, words);
        assert!(files(&run) == before, "{flags}: something was written");
    }
    // The same call, or what changes nothing in the result, is no contradiction.
    resume(scene.path(), &run, "--budget 330 --policy diet --policy-set diet.rho=0.25").ok();
    resume(scene.path(), &run, "--threads 1 --tile-cap 500 --image-cache 0 --quiet").ok();
}

#[test]
fn another_dataset_is_refused_with_what_differs() {
    let (_root, run) = scratch();
    let scene = Photographs::colmap_text();
    short_run(&scene, &run, "");
    scene.replace("sparse/0/cameras.txt", "52 52", "52 52.5");
    resume(scene.path(), &run, "").refused("cameras", &["the cameras of the views", "--resume"]);
    // It may lie elsewhere. What else may differ is in `src/checkpoint/tests.rs`.
    let moved = Photographs::colmap_text();
    resume(moved.path(), &run, "").ok();
}

#[test]
fn a_run_is_extended_by_the_schedule_it_began_with() {
    let scene = Photographs::colmap_text();
    let (root, run) = scratch();
    short_run(&scene, &run, "");
    let first = model(&run, 40);
    let late = root.path().join("late");
    copy_unfinished(&run, &late, 40);
    let outcome = resume(scene.path(), &run, "--iterations 65").ok();
    assert!(outcome.stdout.contains("extended from 40 to 65"), "{}", outcome.stdout);
    let summary = json(&run.join("stats/summary.json"));
    assert!(count(&summary, "iterations") == 65 && summary["finished"] == true, "{summary}");
    assert!(model(&run, 40) == first && model(&run, 65) != first);
    // From where it is extended does not matter.
    resume(scene.path(), &late, "--iterations 65").ok();
    assert!(model(&late, 65) == model(&run, 65));
    assert!(read(&late.join("stats/events.jsonl")) == read(&run.join("stats/events.jsonl")));
    // It is remembered.
    let outcome = resume(scene.path(), &run, "").ok();
    assert!(outcome.stdout.contains("all 65 iterations are done"), "{}", outcome.stdout);
}

#[test]
fn a_run_without_a_checkpoint_begins_again_with_its_options() {
    let scene = Photographs::colmap_text();
    let (_root, run) = scratch();
    let outcome = train(scene.path(), &run, 20, "--budget 330 --resume").ok();
    assert!(outcome.stdout.contains("begins at its start"), "{}", outcome.stdout);
    let expected = model(&run, 20);
    // As after a kill before the first checkpoint.
    std::fs::remove_dir_all(run.join("checkpoints")).expect("checkpoints");
    std::fs::remove_dir_all(run.join("point_cloud")).expect("models");
    resume(scene.path(), &run, "--budget 400 --seed 9")
        .refused("other options", &["--budget: 400 now, 330 in that run", "--seed", "config.toml"]);
    let outcome = resume(scene.path(), &run, "").ok();
    assert!(outcome.stdout.contains("begins at its start"), "{}", outcome.stdout);
    assert!(model(&run, 20) == expected, "the options of config.toml");
    assert_eq!(records(&run.join("stats/train.jsonl")).len(), 2);
}
