//! `--init MODEL` and `--freeze MODEL`: runs that start from a model or train around a frozen one, and refused models.

use std::path::Path;

use densify::train::output::model_path;

use super::{
    Outcome, call, count, files, gaussians, json, read, read_text, records, resume, scratch, text,
    train, write_ply,
};
use crate::photographs::Photographs;

/// Flags for a policy that never edits.
const NO_EDITS: &str = "--policy vanilla --policy-set vanilla.grow_every=0 --policy-set vanilla.reset_every=0 \
                     --policy-set vanilla.white_reset_at=0";

/// The first recorded loss of a run.
fn first_loss(run: &Path) -> f64 {
    records(&run.join("stats/train.jsonl"))[0]["loss"].as_f64().expect("a loss")
}

/// Checks that a call was refused and that its output folder `no` was not created.
fn assert_refused(outcome: &Outcome, root: &Path, words: &[&str]) {
    outcome.refused("--init", words);
    assert!(!root.join("no").exists());
}

#[test]
fn a_run_can_start_from_any_model() {
    let scene = Photographs::colmap_text();
    let (root, run) = scratch();
    train(scene.path(), &run, 150, &format!("--budget 300 --quiet {NO_EDITS}")).ok();
    let ply = model_path(&run, 150);
    let init = |file: &Path, run: &str, flags: &str| {
        let flags = format!("--init {} --quiet {NO_EDITS} {flags}", text(file));
        let run = root.path().join(run);
        (train(scene.path(), &run, 20, &flags), run)
    };

    // Training starts at the quality of the model, with view-dependent colour from the first step.
    let (outcome, again) = init(&ply, "again", "--budget 300");
    outcome.ok();
    let [from_points, from_model] = [&run, &again].map(|run| first_loss(run));
    assert!(from_model < 0.5 * from_points, "{from_model} after {from_points}");
    let rows = |run: &Path, iteration| gaussians(&model_path(run, iteration)).len();
    assert_eq!(rows(&again, 20), rows(&run, 150));

    // Other formats work the same way.
    let spz = root.path().join("model.spz");
    call(&format!("export {} -o {}", text(&run), text(&spz))).ok();
    let (outcome, other) = init(&spz, "other", "--budget 300");
    outcome.ok();
    assert!(first_loss(&other) < 1.1 * from_model + 0.01, "{}", first_loss(&other));

    // A learning rate of 0 freezes its parameters.
    let (outcome, still) = init(&ply, "still", "--budget 300 --lr mean_start=0");
    outcome.ok();
    let [before, after] = [&ply, &model_path(&still, 20)].map(|file| gaussians(file));
    let moved =
        |a: &[f32], b: &[f32]| a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
    assert!(moved(before.means.as_flattened(), after.means.as_flattened()) < 1e-5);
    assert!(moved(&before.sh, &after.sh) > 1e-3);

    // A run's folder stands for its last model, whose file is recorded; the same command continues the run.
    let (outcome, of_run) = init(&run, "of-run", "--budget 300");
    outcome.ok();
    assert!(read(&model_path(&of_run, 20)) == read(&model_path(&again, 20)));
    assert!(read_text(&of_run.join("config.toml")).contains(text(&ply)));
    resume(scene.path(), &of_run, &format!("--init {} --iterations 24", text(&run))).ok();

    // Resumed from a checkpoint after the file is gone, the run writes the same model, byte for byte.
    let whole = read(&model_path(&again, 20));
    let gone = root.path().join("gone.ply");
    std::fs::copy(&ply, &gone).unwrap();
    let (outcome, part) = init(&gone, "part", "--budget 300 --checkpoint-every 10");
    outcome.ok();
    for file in ["point_cloud/iteration_20", "checkpoints/iteration_20.safetensors"] {
        let path = part.join(file);
        let _ = if path.is_dir() {
            std::fs::remove_dir_all(&path)
        } else {
            std::fs::remove_file(&path)
        };
    }
    std::fs::remove_file(&gone).unwrap();
    let outcome = resume(scene.path(), &part, "").ok();
    assert!(read(&model_path(&part, 20)) == whole, "{outcome:?}");
    resume(scene.path(), &part, &format!("--init {}", text(&ply))).refused("another", &["--init"]);
}

/// The learning rates of a new run would degrade a finished model at first.
#[test]
fn fine_rates_keep_the_quality_of_a_finished_model_in_the_first_steps() {
    let scene = Photographs::colmap_text();
    let (root, run) = scratch();
    train(scene.path(), &run, 300, &format!("--budget 300 --eval --quiet {NO_EDITS}")).ok();
    let initial = json(&run.join("results.json"))["ours_300"]["PSNR"].as_f64().unwrap();
    let after = |rates: &str| {
        let to = root.path().join(rates);
        let flags = format!(
            "--init {} --init-rates {rates} --budget 300 --eval --quiet --test-iterations 6 {NO_EDITS}",
            text(&model_path(&run, 300))
        );
        train(scene.path(), &to, 300, &flags).ok();
        json(&to.join("results.json"))["ours_6"]["PSNR"].as_f64().unwrap()
    };
    let (fine, full) = (after("fine"), after("full"));
    assert!(
        fine > initial - 0.1 && full < initial - 0.3,
        "{initial} dB: {fine} dB with fine rates, {full} dB with full rates"
    );
}

#[test]
fn frozen_gaussians_never_change_even_when_resumed() {
    let scene = Photographs::colmap_text();
    let (root, run) = scratch();
    train(scene.path(), &run, 60, &format!("--budget 100 --quiet {NO_EDITS}")).ok();
    let ply = model_path(&run, 60);
    let frozen = gaussians(&ply).len();
    let copy = root.path().join("copy.ply");
    std::fs::copy(&ply, &copy).unwrap();
    let beside = root.path().join("beside");
    let flags = "--budget 260 --checkpoint-every 100 --policy-set diet.grow_every=20";
    let outcome =
        train(scene.path(), &beside, 300, &format!("--freeze {} {flags}", text(&copy))).ok();
    assert!(outcome.stdout.contains(&format!("frozen   {frozen} Gaussians of ")), "{outcome:?}");
    let after = gaussians(&model_path(&beside, 300));
    let summary = json(&beside.join("stats/summary.json"));
    let rows: Vec<usize> = (0..frozen).collect();
    // Writing the file rounds the values.
    let [expected, found] = [gaussians(&ply), after.gather(&rows)];
    let close = |a: &[f32], b: &[f32]| {
        a.len() == b.len() && a.iter().zip(b).all(|(a, b)| (a - b).abs() <= 2e-6 * a.abs().max(1.0))
    };
    assert!(close(expected.means.as_flattened(), found.means.as_flattened()));
    assert!(close(expected.log_scales.as_flattened(), found.log_scales.as_flattened()));
    assert!(
        close(&expected.opacity_logits, &found.opacity_logits) && close(&expected.sh, &found.sh)
    );
    assert!(after.len() > frozen + 100 && after.len() <= 260, "{} rows", after.len());
    assert!(count(&summary, "peak_rows") <= 260, "{summary}");
    assert!(count(&summary, "peak_bytes") <= count(&summary, "ledger_bytes"), "{summary}");

    // Resumed without the file, the run writes the same model, byte for byte.
    let whole = read(&model_path(&beside, 300));
    std::fs::remove_dir_all(beside.join("point_cloud/iteration_300")).unwrap();
    std::fs::remove_file(beside.join("checkpoints/iteration_300.safetensors")).unwrap();
    std::fs::remove_file(&copy).unwrap();
    resume(scene.path(), &beside, "").ok();
    assert!(read(&model_path(&beside, 300)) == whole);

    // A run's folder stands for its last model.
    let of_run = root.path().join("of-run");
    let outcome = train(scene.path(), &of_run, 2, &format!("--freeze {} {flags}", text(&run))).ok();
    assert!(outcome.stdout.contains(&format!("frozen   {frozen} Gaussians of ")), "{outcome:?}");

    // Invalid combinations are refused.
    let refused = |flags: &str, words: &[&str]| {
        let outcome = train(scene.path(), &root.path().join("no"), 2, flags);
        outcome.refused("--freeze", words);
        assert!(!root.path().join("no").exists());
    };
    refused(&format!("--freeze {} --budget {frozen}", text(&ply)), &["leave no room", "--budget"]);
    refused(&format!("--freeze {} --budget auto:200", text(&ply)), &["--budget auto"]);
    refused(&format!("--freeze {}", text(&copy)), &["copy.ply"]);
    let mut above = gaussians(&ply);
    above.means.iter_mut().for_each(|mean| mean[1] += 1e4);
    write_ply(&above, &copy);
    refused(&format!("--freeze {}", text(&copy)), &["copy.ply", "none of its", "coordinates"]);
    resume(scene.path(), &beside, &format!("--freeze {}", text(&ply)))
        .refused("another", &["--freeze"]);
}

#[test]
fn a_model_beyond_the_budget_keeps_its_visible_gaussians() {
    let scene = Photographs::colmap_text();
    let (root, run) = scratch();
    train(scene.path(), &run, 60, &format!("--budget 300 --quiet {NO_EDITS}")).ok();
    let mut large = gaussians(&model_path(&run, 60));
    let visible_rows = large.len();
    // Adds the same number of nearly transparent Gaussians, which contribute to no pixel.
    let rows: Vec<usize> = (0..visible_rows).collect();
    let mut faint = large.gather(&rows);
    faint.opacity_logits.fill(-9.0);
    large.append(faint);
    let file = root.path().join("large.ply");
    write_ply(&large, &file);
    let cut = root.path().join("cut");
    let flags = format!("--init {} --budget {visible_rows} {NO_EDITS}", text(&file));
    let outcome = train(scene.path(), &cut, 1, &flags).ok();
    let message = format!("{visible_rows} Gaussians beyond the budget left out");
    assert!(outcome.stdout.contains(&message), "{outcome:?}");
    // One step changes opacities little, so they still show which Gaussians were kept.
    let visible = |logit: &&f32| **logit > -8.0;
    let kept = gaussians(&model_path(&cut, 1));
    assert_eq!(kept.opacity_logits.iter().filter(visible).count(), visible_rows);
    let summary = json(&cut.join("stats/summary.json"));
    assert!(count(&summary, "peak_rows") <= visible_rows as u64);
    assert!(count(&summary, "peak_bytes") <= count(&summary, "ledger_bytes"), "{summary}");
}

#[test]
fn unsuitable_models_are_refused_or_reported() {
    let scene = Photographs::colmap_text();
    let (root, run) = scratch();
    train(scene.path(), &run, 60, &format!("--budget 300 --quiet {NO_EDITS}")).ok();
    let file = model_path(&run, 60);
    let start = |file: &Path, flags: &str| {
        let flags = format!("--budget 300 --init {} {flags}", text(file));
        train(scene.path(), &root.path().join("no"), 2, &flags)
    };
    let absent = root.path().join("absent.ply");
    assert_refused(&start(&absent, ""), root.path(), &["--init", "absent.ply"]);
    let photograph = scene.file("images/view_00.png");
    assert_refused(&start(&photograph, ""), root.path(), &["--init", "view_00.png"]);
    assert_refused(&start(scene.path(), ""), root.path(), &["--init", "meta.json"]);
    std::fs::create_dir(root.path().join("early")).unwrap();
    std::fs::write(root.path().join("early/config.toml"), "").unwrap();
    let early = root.path().join("early");
    assert_refused(&start(&early, ""), root.path(), &["--init", "early", "no saved model"]);
    assert_refused(&start(&file, "--init-points 9"), root.path(), &["--init-points 9", "random"]);
    let cut = root.path().join("cut.ply");
    std::fs::write(&cut, &read(&file)[..2_000]).unwrap();
    assert_refused(&start(&cut, ""), root.path(), &["--init", "cut.ply"]);

    // Models in coordinates other than the dataset's.
    let moved = |name: &str, map: fn([f32; 3]) -> [f32; 3]| {
        let mut model = gaussians(&file);
        for mean in &mut model.means {
            *mean = map(*mean);
        }
        let path = root.path().join(name);
        write_ply(&model, &path);
        path
    };
    // This model is outside all views.
    let above = moved("above.ply", |[x, y, z]| [x, y + 1e4, z]);
    assert_refused(&start(&above, ""), root.path(), &["above.ply", "0 of its", "coordinates"]);
    assert!(!files(root.path()).keys().any(|name| name.starts_with("no/")));
    // A very distant model counts as out of view, even if a camera faces it.
    let far = moved("far.ply", |[x, y, z]| [x + 1e4, y, z]);
    assert_refused(&start(&far, ""), root.path(), &["far.ply", "of its", "coordinates"]);
    // A model in view that does not resemble the photographs is refused by every command.
    let before = files(root.path());
    let tenfold = moved("tenfold.ply", |mean| mean.map(|v| 10.0 * v));
    let expected = ["tenfold.ply", "nothing of the photographs", "coordinates"];
    assert_refused(&start(&tenfold, ""), root.path(), &expected);
    let small = root.path().join("small.ply");
    let dataset = format!("--scene {} --test-every 2 --backend cpu", text(scene.path()));
    let compress = format!("compress {} --to 50 -o {} {dataset}", text(&tenfold), text(&small));
    call(&compress).refused("compress", &expected);
    let clean = format!("clean {} -o {} {dataset}", text(&tenfold), text(&small));
    call(&clean).refused("clean", &expected);
    let mesh = format!("mesh {} -o {} {dataset}", text(&tenfold), text(&small));
    call(&mesh).refused("mesh", &expected);
    std::fs::remove_file(&tenfold).unwrap();
    assert!(files(root.path()) == before);
    // A model with little resemblance gets a warning.
    let below = moved("below.ply", |[x, y, z]| [x, y + 2.0, z]);
    let doubt = "may not be those of the dataset";
    for words in [
        format!("train {} -o {} -i 2 --init {}", text(scene.path()), text(&small), text(&below)),
        format!("eval {} {dataset}", text(&below)),
        format!("export {} -o {} {dataset}", text(&below), text(&root.path().join("again.ply"))),
    ] {
        let outcome = call(&words).ok();
        assert!(outcome.stdout.contains(doubt), "{words}: {outcome:?}");
    }
    let outcome = start(&file, "").ok();
    assert!(!outcome.stdout.contains("coordinates"), "{outcome:?}");
}
