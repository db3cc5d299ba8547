//! `--init MODEL` and `--freeze MODEL`: a run that starts from a model there is already, or beside one that stays as
//! it is, and what cannot be started from.

use std::path::Path;

use densify::train::output::model_path;

use super::{
    Outcome, call, count, files, gaussians, json, read, records, resume, scratch, text, train,
    write_ply,
};
use crate::photographs::Photographs;

/// A policy that does nothing: `vanilla` without growth.
const STILL: &str = "--policy vanilla --policy-set vanilla.grow_every=0 --policy-set vanilla.reset_every=0 \
                     --policy-set vanilla.white_reset_at=0";

/// The loss of a run's first step that is recorded.
fn first_loss(run: &Path) -> f64 {
    records(&run.join("stats/train.jsonl"))[0]["loss"].as_f64().expect("a loss")
}

fn refused(outcome: &Outcome, root: &Path, words: &[&str]) {
    outcome.refused("--init", words);
    assert!(!root.join("no").exists());
}

#[test]
fn a_run_goes_on_from_any_model() {
    let scene = Photographs::colmap_text();
    let (root, run) = scratch();
    train(scene.path(), &run, 150, &format!("--budget 300 --quiet {STILL}")).ok();
    let ply = model_path(&run, 150);
    let init = |file: &Path, run: &str, flags: &str| {
        let flags = format!("--init {} --quiet {STILL} {flags}", text(file));
        let run = root.path().join(run);
        (train(scene.path(), &run, 20, &flags), run)
    };

    // It starts where the other ended, and its colours depend on the view from the first step on.
    let (outcome, again) = init(&ply, "again", "--budget 300");
    outcome.ok();
    let [from_points, from_model] = [&run, &again].map(|run| first_loss(run));
    assert!(from_model < 0.5 * from_points, "{from_model} after {from_points}");
    let rows = |run: &Path, iteration| gaussians(&model_path(run, iteration)).len();
    assert_eq!(rows(&again, 20), rows(&run, 150));

    // So does a file of another format.
    {
        let spz = root.path().join("model.spz");
        call(&format!("export {} -o {}", text(&run), text(&spz))).ok();
        let (outcome, other) = init(&spz, "other", "--budget 300");
        outcome.ok();
        assert!(first_loss(&other) < 1.1 * from_model + 0.01, "{}", first_loss(&other));
    }

    // Stopped before it has a checkpoint, or with one and without the file, it ends in the same bytes.
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

/// Of a finished model the steps of a run from its start would take much at first.
#[test]
fn a_finished_model_keeps_its_quality_within_2_percent_of_the_iterations() {
    let scene = Photographs::colmap_text();
    let (root, run) = scratch();
    train(scene.path(), &run, 300, &format!("--budget 300 --eval --quiet {STILL}")).ok();
    let own = json(&run.join("results.json"))["ours_300"]["PSNR"].as_f64().unwrap();
    let after = |rates: &str| {
        let to = root.path().join(rates);
        let flags = format!(
            "--init {} --init-rates {rates} --budget 300 --eval --quiet --test-iterations 6 {STILL}",
            text(&model_path(&run, 300))
        );
        train(scene.path(), &to, 300, &flags).ok();
        json(&to.join("results.json"))["ours_6"]["PSNR"].as_f64().unwrap()
    };
    let (fine, full) = (after("fine"), after("full"));
    assert!(
        fine > own - 0.1 && full < own - 0.3,
        "{own}: {fine} with fine steps, {full} with full"
    );
}

#[test]
fn frozen_gaussians_stay_as_they_are_through_a_stop_too() {
    let scene = Photographs::colmap_text();
    let (root, run) = scratch();
    train(scene.path(), &run, 60, &format!("--budget 100 --quiet {STILL}")).ok();
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
    // What a file rounds is beyond the last bit of what it was read as.
    let [was, is] = [gaussians(&ply), after.gather(&rows)];
    let close = |a: &[f32], b: &[f32]| {
        a.len() == b.len() && a.iter().zip(b).all(|(a, b)| (a - b).abs() <= 2e-6 * a.abs().max(1.0))
    };
    assert!(close(was.means.as_flattened(), is.means.as_flattened()));
    assert!(close(was.log_scales.as_flattened(), is.log_scales.as_flattened()));
    assert!(close(&was.opacity_logits, &is.opacity_logits) && close(&was.sh, &is.sh));
    assert!(after.len() > frozen + 100 && after.len() <= 260, "{} rows", after.len());
    assert!(count(&summary, "peak_rows") <= 260, "{summary}");
    assert!(count(&summary, "peak_bytes") <= count(&summary, "ledger_bytes"), "{summary}");

    // It goes on to the same bytes where the file is gone.
    let whole = read(&model_path(&beside, 300));
    std::fs::remove_dir_all(beside.join("point_cloud/iteration_300")).unwrap();
    std::fs::remove_file(beside.join("checkpoints/iteration_300.safetensors")).unwrap();
    std::fs::remove_file(&copy).unwrap();
    resume(scene.path(), &beside, "").ok();
    assert!(read(&model_path(&beside, 300)) == whole);

    // What cannot be.
    let no = |flags: &str, words: &[&str]| {
        let outcome = train(scene.path(), &root.path().join("no"), 2, flags);
        outcome.refused("--freeze", words);
        assert!(!root.path().join("no").exists());
    };
    no(&format!("--freeze {} --budget {frozen}", text(&ply)), &["leave no room", "--budget"]);
    no(&format!("--freeze {} --budget auto:200", text(&ply)), &["--budget auto"]);
    no(&format!("--freeze {}", text(&copy)), &["copy.ply"]);
    let mut above = gaussians(&ply);
    above.means.iter_mut().for_each(|mean| mean[1] += 1e4);
    write_ply(&above, &copy);
    no(&format!("--freeze {}", text(&copy)), &["copy.ply", "none of its", "coordinates"]);
    resume(scene.path(), &beside, &format!("--freeze {}", text(&ply)))
        .refused("another", &["--freeze"]);
}

#[test]
fn of_too_large_a_model_those_stay_that_show() {
    let scene = Photographs::colmap_text();
    let (root, run) = scratch();
    train(scene.path(), &run, 60, &format!("--budget 300 --quiet {STILL}")).ok();
    let mut large = gaussians(&model_path(&run, 60));
    let seen = large.len();
    // As many again that no pixel shows: they are in view, and transparent.
    let rows: Vec<usize> = (0..seen).collect();
    let mut faint = large.gather(&rows);
    faint.opacity_logits.fill(-9.0);
    large.append(faint);
    let file = root.path().join("large.ply");
    write_ply(&large, &file);
    let cut = root.path().join("cut");
    let flags = format!("--init {} --budget {seen} {STILL}", text(&file));
    let outcome = train(scene.path(), &cut, 1, &flags).ok();
    let said = format!("{seen} Gaussians beyond the budget left out");
    assert!(outcome.stdout.contains(&said), "{outcome:?}");
    // One step changes little: those that stay are the visible ones.
    let visible = |logit: &&f32| **logit > -8.0;
    let kept = gaussians(&model_path(&cut, 1));
    assert_eq!(kept.opacity_logits.iter().filter(visible).count(), seen);
    let summary = json(&cut.join("stats/summary.json"));
    assert!(count(&summary, "peak_rows") <= seen as u64);
    assert!(count(&summary, "peak_bytes") <= count(&summary, "ledger_bytes"), "{summary}");
}

#[test]
fn what_cannot_be_started_from_is_refused_or_named() {
    let scene = Photographs::colmap_text();
    let (root, run) = scratch();
    train(scene.path(), &run, 60, &format!("--budget 300 --quiet {STILL}")).ok();
    let file = model_path(&run, 60);
    let start = |file: &Path, flags: &str| {
        let flags = format!("--budget 300 --init {} {flags}", text(file));
        train(scene.path(), &root.path().join("no"), 2, &flags)
    };
    let absent = root.path().join("absent.ply");
    refused(&start(&absent, ""), root.path(), &["--init", "absent.ply"]);
    let photograph = scene.file("images/view_00.png");
    refused(&start(&photograph, ""), root.path(), &["--init", "view_00.png"]);
    let saved = text(&file).to_owned();
    refused(&start(&run, ""), root.path(), &["--init", "meta.json", &saved]);
    refused(&start(&file, "--init-points 9"), root.path(), &["--init-points 9", "random"]);
    let cut = root.path().join("cut.ply");
    std::fs::write(&cut, &read(&file)[..2_000]).unwrap();
    refused(&start(&cut, ""), root.path(), &["--init", "cut.ply"]);

    // In other coordinates: far away no view shows it; turned about it shows the wrong things.
    let moved = |name: &str, map: fn([f32; 3]) -> [f32; 3]| {
        let mut model = gaussians(&file);
        for mean in &mut model.means {
            *mean = map(*mean);
        }
        let path = root.path().join(name);
        write_ply(&model, &path);
        path
    };
    let above = moved("above.ply", |[x, y, z]| [x, y + 1e4, z]);
    refused(&start(&above, ""), root.path(), &["above.ply", "0 of its", "coordinates"]);
    assert!(!files(root.path()).keys().any(|name| name.starts_with("no/")));
    // So far away that some camera looks there is as good as out of view.
    let far = moved("far.ply", |[x, y, z]| [x + 1e4, y, z]);
    refused(&start(&far, ""), root.path(), &["far.ply", "of its", "coordinates"]);
    // In view, and nothing like the photographs; whatever the model is taken for, nothing is written.
    let before = files(root.path());
    let tenfold = moved("tenfold.ply", |mean| mean.map(|v| 10.0 * v));
    let expected = ["tenfold.ply", "nothing of the photographs", "coordinates"];
    refused(&start(&tenfold, ""), root.path(), &expected);
    let small = root.path().join("small.ply");
    let on = format!("--scene {} --test-every 2 --backend cpu", text(scene.path()));
    let compress = format!("compress {} --to 50 -o {} {on}", text(&tenfold), text(&small));
    call(&compress).refused("compress", &expected);
    std::fs::remove_file(&tenfold).unwrap();
    assert!(files(root.path()) == before);
    // So little like them that it may be elsewhere.
    let below = moved("below.ply", |[x, y, z]| [x, y + 2.0, z]);
    let doubt = "may not be those of the dataset";
    for words in [
        format!("train {} -o {} -i 2 --init {}", text(scene.path()), text(&small), text(&below)),
        format!("eval {} {on}", text(&below)),
        format!("export {} -o {} {on}", text(&below), text(&root.path().join("again.ply"))),
    ] {
        let outcome = call(&words).ok();
        assert!(outcome.stdout.contains(doubt), "{words}: {outcome:?}");
    }
    let outcome = start(&file, "").ok();
    assert!(!outcome.stdout.contains("coordinates"), "{outcome:?}");
}
