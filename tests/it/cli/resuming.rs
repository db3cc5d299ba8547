//! `--resume`: for every policy, an interrupted run writes the same files, byte for byte; unusable checkpoints are
//! refused.

use std::path::{Path, PathBuf};

use densify_policies::registry::{PolicyEntry, find, policies};
use serde_json::Value;
use tempfile::TempDir;

use super::{
    Outcome, config, copy_unfinished, count, files, frequent_edits, json, model, read, records,
    resume, scratch, train,
};
use crate::photographs::Photographs;
use crate::subject::devices;

const ITERATIONS: u32 = 202;
/// The step to resume from: neither the end of an epoch of 12 views nor a multiple of any interval of `frequent_edits`.
const HALF: u32 = 101;

fn checkpoint(run: &Path, step: u32) -> std::path::PathBuf {
    run.join(format!("checkpoints/iteration_{step}.safetensors"))
}

/// Removes the fields of a record that depend on the clock or on the memory of the process (which rendering a built-in
/// scene increases).
fn reproducible_fields(mut value: Value) -> Value {
    let clock = ["seconds", "cpu_seconds", "stage_seconds"];
    let process = ["peak_bytes", "resident_bytes", "ledger", "ledger_bytes"];
    for key in clock.into_iter().chain(process) {
        value.as_object_mut().expect("a record").remove(key);
    }
    value
}

/// Checks that two runs have written the same files, apart from times and measured memory.
fn assert_same(a: &Path, b: &Path, case: &str) {
    let log = |run: &Path| -> Vec<Value> {
        records(&run.join("stats/train.jsonl")).into_iter().map(reproducible_fields).collect()
    };
    assert_eq!(log(a), log(b), "{case}");
    let summary = |run: &Path| reproducible_fields(json(&run.join("stats/summary.json")));
    assert_eq!(summary(a), summary(b), "{case}");
    let (a, b) = (files(a), files(b));
    assert!(a.keys().eq(b.keys()), "{case}: {:?} and {:?}", a.keys(), b.keys());
    let exact = ["stats/events.jsonl", "config.toml", "cameras.json", ".ply", "results.json"];
    for name in a.keys() {
        let is_exact = exact.iter().any(|end| name.ends_with(end));
        assert!(!is_exact || a[name] == b[name], "{case}: {name} differs");
        // The TensorBoard file contains times.
        let is_board = name.contains("tfevents");
        assert!(!is_board || a[name].len() == b[name].len(), "{case}: {name}");
    }
}

/// Trains to the end. Then copies the run without its last files, though with complete logs, and resumes the copy from
/// the checkpoint at [`HALF`]. Returns the temporary folder and, in it, the uninterrupted run.
fn compare(scene: &Path, flags: &str, case: &str) -> (TempDir, PathBuf) {
    let (root, whole) = scratch();
    let flags = format!("--checkpoint-every {HALF} {flags}");
    train(scene, &whole, ITERATIONS, &flags).ok();
    let part = root.path().join("part");
    copy_unfinished(&whole, &part, ITERATIONS);
    let outcome = train(scene, &part, ITERATIONS, &format!("{flags} --resume")).ok();
    let message = format!("from step {HALF}");
    assert!(outcome.stdout.contains(&message), "{case}: {}", outcome.stdout);
    assert_same(&whole, &part, case);
    let events = records(&whole.join("stats/events.jsonl"));
    let steps: Vec<u64> = events.iter().map(|event| count(event, "step")).collect();
    let half = u64::from(HALF);
    let sides = (steps.iter().any(|&step| step < half), steps.iter().any(|&step| step > half));
    assert_eq!(sides, (true, true), "{case}: no edits on both sides: {steps:?}");
    assert!(!steps.contains(&half), "{case}: an edit at the checkpoint");
    (root, whole)
}

/// The first edit of a run, which depends only on the rounding of a few steps: step, cause, and numbers of Gaussians.
fn first_edit(run: &Path) -> (u64, String, [u64; 3]) {
    let event = &records(&run.join("stats/events.jsonl"))[0];
    let cause = event["cause"].as_str().expect("a cause").to_owned();
    (count(event, "step"), cause, ["before", "removed", "after"].map(|key| count(event, key)))
}

/// Test PSNR and number of Gaussians at the end of a run.
fn quality(run: &Path) -> (f64, u64) {
    let scores = &json(&run.join("results.json"))[format!("ours_{ITERATIONS}")];
    let rows = count(&json(&run.join("stats/summary.json")), "rows");
    (scores["PSNR"].as_f64().expect("a score"), rows)
}

/// Flags that make a policy edit almost to the end, and delay its one-time edits until shortly after the checkpoint.
fn late_edits(policy: &PolicyEntry) -> String {
    let at = |(name, default): (String, toml::Value)| {
        let is_half = name.ends_with("_at") && default.as_integer() == Some(15_000);
        let step = if is_half { Some(107) } else { name.ends_with("_until").then_some(190) };
        Some(format!("--policy-set {}.{name}={} ", policy.name, step?))
    };
    policy.parameters().into_iter().filter_map(at).collect()
}

/// Every registered policy with flags for a short run.
fn short_policies() -> impl Iterator<Item = (&'static str, String)> {
    policies().expect("the registry is sound").into_iter().map(|entry| {
        let (policy, often, late) = (entry.name, frequent_edits(entry), late_edits(entry));
        (policy, format!("--policy {policy} {often} {late} --eval"))
    })
}

#[test]
fn every_policy_resumes_exactly() {
    let scene = Photographs::colmap_text();
    for (policy, flags) in short_policies() {
        compare(scene.path(), &format!("{flags} --budget 2k"), policy);
    }
}

/// Also compares the quality with the native backend. One adapter is enough, because `agreement` compares the drivers.
#[test]
#[ignore = "takes minutes: run by .ci/run"]
fn every_policy_resumes_exactly_on_a_gpu() {
    let Some(device) = devices().first() else { return };
    let name = device.adapter().name.split(' ').next().expect("a name");
    let scene = Photographs::colmap_text();
    for (policy, flags) in short_policies() {
        // A small budget, because software drivers are slow; the same moments on both, whose defaults differ.
        let flags = format!("{flags} --budget 900 --knob moment_storage=f32");
        let on_device = format!("{flags} --backend gpu --gpu {name} --deterministic");
        let (_whole_root, whole) = compare(scene.path(), &on_device, policy);
        let (_root, run) = scratch();
        train(scene.path(), &run, ITERATIONS, &format!("{flags} --backend cpu")).ok();
        let [(step, cause, rows), native] = [&whole, &run].map(|run| first_edit(run));
        assert_eq!((step, &*cause), (native.0, &*native.1), "{policy} on {name}");
        let differ = rows.iter().zip(native.2).any(|(&rows, native)| rows.abs_diff(native) > 1);
        assert!(
            !differ,
            "{policy} on {name}: the first edit has {rows:?}, natively {:?}",
            native.2
        );
        let [found, expected] = [whole, run].map(|run| quality(&run));
        let message = format!("{policy} on {name}: {found:?}, natively {expected:?}");
        // From then on, a difference in the last bit can change which Gaussian is replaced, as another seed would.
        // Seeds differ by up to 1 dB. `mini-splatting` resamples all Gaussians by weight.
        let tolerance = if policy == "mini-splatting" { 2.0 } else { 1.0 };
        assert!((found.0 - expected.0).abs() < tolerance, "{message}");
        assert!(found.1.abs_diff(expected.1) * 50 <= expected.1, "{message}");
    }
}

/// Floaters are removed before the checkpoint; the removal itself keeps no state.
#[test]
fn a_run_that_removes_floaters_resumes_exactly() {
    let scene = Photographs::colmap_text();
    let (root, whole) = scratch();
    let flags = "--budget 2k --eval --remove-floaters --checkpoint-every 77";
    train(scene.path(), &whole, 150, flags).ok();
    let part = root.path().join("part");
    copy_unfinished(&whole, &part, 150);
    let outcome = train(scene.path(), &part, 150, &format!("{flags} --resume")).ok();
    assert!(outcome.stdout.contains("from step 77"), "{}", outcome.stdout);
    assert_same(&whole, &part, "floaters");
    let steps: Vec<u64> = records(&whole.join("stats/events.jsonl"))
        .iter()
        .filter(|event| event["cause"] == "in front of the surface")
        .map(|event| count(event, "step"))
        .collect();
    assert!(!steps.is_empty() && steps.iter().all(|step| [15, 30, 45].contains(step)), "{steps:?}");
}

#[test]
fn checkpoints_contain_all_state_that_lasts_between_steps() {
    let scene = Photographs::colmap_text();
    // Gradients accumulated between steps, several bands, random backgrounds, and a rising SH degree.
    for flags in [
        "--policy mcmc --policy-set mcmc.grow_every=7",
        "--policy taming --policy-set taming.sh_every=17 --policy-set taming.grow_every=7",
        "--policy taming --policy-set taming.grow_every=7 --background random --threads 2",
        "--policy vanilla --policy-set vanilla.grow_every=9 --tile-cap 400 --seed 5",
        "--policy diet --policy-set diet.grow_every=9 --save-iterations 50,150 --eval \
         --test-iterations 30,101,160",
        "--policy vanilla --policy-set vanilla.grow_every=9",
        "--policy mcmc --policy-set mcmc.grow_every=7 --threads 2",
        // Candidates are pending at the checkpoint.
        "--policy diet --policy-set diet.grow_every=9 --policy-set diet.insert_every=19 \
         --policy-set diet.rows_per_candidate=20 --policy-set diet.compensate_from=60 \
         --policy-set diet.rho_c=0.1",
    ] {
        let policy = flags.split(' ').nth(1).expect("a name");
        let late = late_edits(find(policy).expect("a registered policy"));
        compare(scene.path(), &format!("--budget 2k {flags} {late}"), flags);
    }
}

#[test]
#[ignore = "takes minutes: run by .ci/run"]
fn a_built_in_scene_resumes_exactly() {
    compare(
        Path::new("scene:spheres"),
        "--budget 4k -r 16 --policy-set diet.grow_every=20 --policy-set diet.grow_until=190",
        "",
    );
}

/// Trains 40 steps with a checkpoint every 10 steps, of which the last two are kept.
fn train_short(scene: &Photographs, run: &Path, flags: &str) -> Outcome {
    let flags = format!("--budget 330 --checkpoint-every 10 --policy-set diet.rho=0.25 {flags}");
    train(scene.path(), run, 40, &flags).ok()
}

/// A huge learning rate for colour makes every Gaussian non-finite by the first audit.
#[test]
fn a_diverged_run_saves_a_checkpoint() {
    let scene = Photographs::colmap_text();
    let (_root, run) = scratch();
    let diverges = |outcome: Outcome| {
        let Outcome { code, stderr, .. } = &outcome;
        assert_eq!(*code, Some(1), "{outcome:?}");
        for word in ["step 100: ", "Gaussians have non-finite values", "--resume", "row 0"] {
            assert!(stderr.contains(word), "{word:?} is not in {stderr}");
        }
    };
    diverges(train(scene.path(), &run, 200, "--budget 330 --lr sh_dc=1e38 --policy mcmc"));
    let names: Vec<String> = files(&run.join("checkpoints")).into_keys().collect();
    assert_eq!(names, ["iteration_100.safetensors"]);
    // The resumed run diverges again at the next audit.
    let again = resume(scene.path(), &run, "--on-nan stop");
    assert!(again.code == Some(1) && again.stderr.contains("step 200: "), "{again:?}");
}

#[test]
fn a_run_without_checkpoints_cannot_be_resumed() {
    let scene = Photographs::colmap_text();
    let (_root, run) = scratch();
    train(scene.path(), &run, 20, "--budget 330 --checkpoint-every 0").ok();
    assert!(!run.join("checkpoints").exists());
    let refused = resume(scene.path(), &run, "");
    refused.refused("none", &["no checkpoint to resume from", "--overwrite"]);
}

#[test]
fn a_damaged_checkpoint_is_named_and_the_previous_one_is_used() {
    let scene = Photographs::colmap_text();
    let (root, run) = scratch();
    train_short(&scene, &run, "");
    let sound = read(&checkpoint(&run, 40));
    let expected = model(&run, 40);
    let mut flipped = sound.clone();
    flipped[sound.len() - 3] ^= 4;
    // Other faults are tested where checkpoints are read.
    let faults: [(&str, Vec<u8>, &str); 3] = [
        ("cut", sound[..sound.len() - 9].to_vec(), "cut short"),
        ("a bit of a tensor", flipped, "damaged"),
        ("a picture", read(&scene.file("images/view_00.png")), "not a safetensors file"),
    ];
    for (case, bytes, words) in &faults {
        let here = root.path().join("here");
        copy_unfinished(&run, &here, 0);
        std::fs::write(checkpoint(&here, 40), bytes).expect("a damaged file");
        let outcome = resume(scene.path(), &here, "").ok();
        for word in ["iteration_40.safetensors", words, "from step 30"] {
            assert!(outcome.stdout.contains(word), "{case}: {word:?} in {}", outcome.stdout);
        }
        assert!(model(&here, 40) == expected, "{case}");
        // The damaged checkpoint has been rewritten and can be used.
        resume(scene.path(), &here, "").ok();
        std::fs::write(checkpoint(&here, 30), bytes).expect("a damaged file");
        std::fs::write(checkpoint(&here, 40), bytes).expect("a damaged file");
        let both = ["iteration_30.safetensors", "iteration_40.safetensors", words, "--overwrite"];
        resume(scene.path(), &here, "").refused(case, &both);
        std::fs::remove_dir_all(&here).expect("the copy");
    }
}

#[test]
fn options_that_contradict_the_checkpoint_are_refused() {
    let scene = Photographs::colmap_text();
    let (_root, run) = scratch();
    train_short(&scene, &run, "");
    let before = files(&run);
    let cases: [(&str, &[&str]); 13] = [
        ("--budget 400", &["--budget: 400 now, 330 in that run", "iteration_40"]),
        ("--policy vanilla", &["--policy: \"vanilla\" now, \"diet\" in that run"]),
        // This policy would need masks from the start.
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
        assert!(files(&run) == before, "{flags}: the run was changed");
    }
    // Repeated options, and options that do not affect the result, are accepted.
    resume(scene.path(), &run, "--budget 330 --policy diet --policy-set diet.rho=0.25").ok();
    resume(scene.path(), &run, "--threads 1 --tile-cap 500 --image-cache 0 --quiet").ok();
}

#[test]
fn a_different_dataset_is_refused() {
    let (_root, run) = scratch();
    let scene = Photographs::colmap_text();
    train_short(&scene, &run, "");
    scene.replace("sparse/0/cameras.txt", "52 52", "52 52.5");
    resume(scene.path(), &run, "").refused("cameras", &["the cameras of the views", "--resume"]);
    // The dataset may be moved. Other differences are tested where checkpoints are read.
    let moved = Photographs::colmap_text();
    resume(moved.path(), &run, "").ok();
}

#[test]
fn an_extended_run_keeps_its_schedule() {
    let scene = Photographs::colmap_text();
    let (root, run) = scratch();
    train_short(&scene, &run, "");
    let first = model(&run, 40);
    let late = root.path().join("late");
    copy_unfinished(&run, &late, 40);
    let outcome = resume(scene.path(), &run, "--iterations 65").ok();
    assert!(outcome.stdout.contains("extended from 40 to 65"), "{}", outcome.stdout);
    let summary = json(&run.join("stats/summary.json"));
    assert!(count(&summary, "iterations") == 65 && summary["finished"] == true, "{summary}");
    assert!(model(&run, 40) == first && model(&run, 65) != first);
    // Extending from an earlier checkpoint gives the same result.
    resume(scene.path(), &late, "--iterations 65").ok();
    assert!(model(&late, 65) == model(&run, 65));
    assert!(read(&late.join("stats/events.jsonl")) == read(&run.join("stats/events.jsonl")));
    // The run records its new length.
    let outcome = resume(scene.path(), &run, "").ok();
    assert!(outcome.stdout.contains("all 65 iterations are done"), "{}", outcome.stdout);
}

/// Removes a parameter of `diet` from the description in a checkpoint, as if it had been written before the parameter
/// existed.
fn remove_parameter(checkpoint: &Path, name: &str) {
    let bytes = read(checkpoint);
    let (length, rest) = bytes.split_at(8);
    let length = u64::from_le_bytes(length.try_into().expect("eight bytes"));
    let (header, arrays) = rest.split_at(length.try_into().expect("a header in memory"));
    let mut header: Value = serde_json::from_slice(header).expect("a header");
    let metadata = &mut header["__metadata__"];
    let contents = metadata["densify.header"].as_str().expect("a description");
    let mut contents: Value = serde_json::from_str(contents).expect("a description");
    let parameters = contents["header"]["config"]["policy_set"]["diet"].as_object_mut();
    parameters.and_then(|all| all.remove(name)).expect("the parameter");
    let contents = contents.to_string();
    metadata["densify.crc32c"] = format!("{:08x}", crc32c::crc32c(contents.as_bytes())).into();
    metadata["densify.header"] = contents.into();
    let mut header = header.to_string().into_bytes();
    header.resize(header.len().next_multiple_of(8), b' ');
    let length = (header.len() as u64).to_le_bytes();
    std::fs::write(checkpoint, [&length, &header[..], arrays].concat()).expect("a checkpoint");
}

/// The scene has few views, for which the policy chooses L1.
#[test]
fn a_run_of_before_the_pixel_loss_is_resumed_with_what_it_used() {
    let scene = Photographs::colmap_text();
    for used in ["l1", "huber"] {
        let (root, run) = scratch();
        train_short(&scene, &run, &format!("--policy-set diet.pixel_loss={used}"));
        let part = root.path().join("part");
        copy_unfinished(&run, &part, 40);
        remove_parameter(&checkpoint(&part, 30), "pixel_loss");
        let again = root.path().join("again");
        copy_unfinished(&part, &again, 40);
        let outcome = resume(scene.path(), &part, "").ok();
        let note = format!("goes on with diet.pixel_loss={used}");
        assert!(outcome.stdout.contains(&note), "{used}: {}", outcome.stdout);
        assert!(model(&part, 40) == model(&run, 40), "{used}: another model");
        // The resumed run has the parameter.
        let set = &config(&part)["policy_set"]["diet"]["pixel_loss"];
        assert_eq!(set.as_str(), Some(used));
        resume(scene.path(), &part, "").ok();
        // One who knows better may say so, unless the step sizes are those of L1.
        let other = if used == "l1" { "huber" } else { "l1" };
        let flag = format!("--policy-set diet.pixel_loss={other}");
        resume(scene.path(), &run, &flag).refused(used, &["--policy-set diet.pixel_loss"]);
        let outcome = resume(scene.path(), &again, &flag);
        if used == "l1" {
            outcome.refused(used, &["--lr noise_end"]);
        } else {
            outcome.ok();
            assert!(model(&again, 40) != model(&run, 40), "{other} changes nothing");
        }
    }
}

#[test]
fn a_run_without_a_checkpoint_restarts_with_its_options() {
    let scene = Photographs::colmap_text();
    let (_root, run) = scratch();
    let outcome = train(scene.path(), &run, 20, "--budget 330 --resume").ok();
    assert!(outcome.stdout.contains("begins at its start"), "{}", outcome.stdout);
    let expected = model(&run, 20);
    // The state after a kill before the first checkpoint.
    std::fs::remove_dir_all(run.join("checkpoints")).expect("checkpoints");
    std::fs::remove_dir_all(run.join("point_cloud")).expect("models");
    resume(scene.path(), &run, "--budget 400 --seed 9")
        .refused("other options", &["--budget: 400 now, 330 in that run", "--seed", "config.toml"]);
    let outcome = resume(scene.path(), &run, "").ok();
    assert!(outcome.stdout.contains("begins at its start"), "{}", outcome.stdout);
    assert!(model(&run, 20) == expected, "the options of config.toml were not used");
    assert_eq!(records(&run.join("stats/train.jsonl")).len(), 2);
}
