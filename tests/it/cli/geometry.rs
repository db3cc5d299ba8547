//! Geometric accuracy of policies on built-in scenes with known surfaces: small views, 1,000 steps, fixed seeds.
//!
//! The bounds are about 20 % above measured values. They catch regressions but do not rank the policies, because a
//! thousand steps at 64 px are few.

use std::path::PathBuf;

use densify::train::metrics::geometry::Geometry;
use densify_policies::registry::policies;
use tempfile::TempDir;

use super::{call, count, json, scratch, text};

const BUDGET: u64 = 800;
const STEPS: u32 = 1000;
/// `vanilla` stops growing at the budget, a hard stop. These are the best settings found for it: growth every 20 steps
/// (the default is 100 even in short runs), and no opacity resets, from which a short run does not recover.
const HARD_STOP: &str = "--policy-set vanilla.grow_every=20 --policy-set vanilla.reset_every=0";

/// A built-in scene written to a temporary folder.
struct WrittenScene {
    _root: TempDir,
    folder: PathBuf,
}

/// The results of a run.
#[derive(Debug)]
struct Outcome {
    geometry: Geometry,
    psnr: f64,
    ssim: f64,
    peak: u64,
}

impl WrittenScene {
    /// Writes a scene with 24 training views, 6 test views and 400 initial points.
    fn new(name: &str, side: u32) -> Self {
        let (root, folder) = scratch();
        let size = format!("--size {side} --train 24 --test 6 --points 400");
        call(&format!("scenegen --preset {name} {size} -o {}", text(&folder))).ok();
        Self { _root: root, folder }
    }

    /// Trains a policy and measures the model.
    #[expect(clippy::print_stderr, reason = "shown if a test fails")]
    fn train(&self, policy: &str, flags: &str) -> Outcome {
        let (_root, run) = scratch();
        let (folder, run_text) = (text(&self.folder), text(&run));
        let fixed = format!("--budget {BUDGET} --iterations {STEPS} --sh-degree 0 --backend cpu");
        call(&format!(
            "train {folder} -o {run_text} --policy {policy} {fixed} --eval --quiet {flags}"
        ))
        .ok();
        call(&format!("eval {run_text} --backend cpu")).ok();
        let metrics = |file: &str| json(&run.join(file))[format!("ours_{STEPS}")].take();
        let (scores, summary) = (metrics("results.json"), json(&run.join("stats/summary.json")));
        let score = |name: &str| scores[name].as_f64().expect("a score");
        let outcome = Outcome {
            geometry: serde_json::from_value(metrics("geometry.json")).expect("a geometry"),
            psnr: score("PSNR"),
            ssim: score("SSIM"),
            peak: count(&summary, "peak_rows"),
        };
        assert!(outcome.peak <= BUDGET, "{policy}: {outcome:?}");
        eprintln!("{policy} {flags}: {outcome:?}");
        outcome
    }

    /// Checks every policy against limits: depth RMSE relative to the diagonal, floaters as a share of the Gaussians.
    fn check(
        &self,
        depth: impl Fn(&str) -> f64,
        floaters: f64,
        more: impl Fn(&str, &Outcome) -> bool,
    ) {
        let mut failures = Vec::new();
        for entry in policies().expect("the registry is sound") {
            let outcome = self.train(entry.name, "");
            let geometry = &outcome.geometry;
            // On `thin`, `reduced-3dgs` leaves 5.4 % of the pixels empty on some processors.
            let is_accurate =
                geometry.depth.rmse < depth(entry.name) && geometry.depth.coverage > 0.93;
            let is_clean = geometry.floaters.of_rows < floaters;
            if !(is_accurate && is_clean && more(entry.name, &outcome)) {
                failures.push((entry.name, outcome));
            }
        }
        assert!(failures.is_empty(), "{failures:#?}");
    }
}

#[test]
#[ignore = "takes minutes: run by .ci/run"]
fn every_policy_is_accurate_on_spheres() {
    // The less accurate policies end with only a fifth to half of the budget.
    let depth = |policy: &str| match policy {
        "mini-splatting" => 0.042,
        "reduced-3dgs" => 0.039,
        "eagles" | "lightgaussian" => 0.036,
        _ => 0.033,
    };
    WrittenScene::new("spheres", 64).check(depth, 0.005, |_, _| true);
}

#[test]
#[ignore = "takes minutes: run by .ci/run"]
fn every_policy_is_accurate_on_the_table() {
    let depth = |policy: &str| match policy {
        "mcmc" | "igs" => 0.05,
        "diet" => 0.056,
        "taming" => 0.065,
        "lightgaussian" | "reduced-3dgs" => 0.115,
        // Trains mostly on images of 19 to 60 px and ends with half of the budget.
        "eagles" => 0.155,
        "mini-splatting" => 0.09,
        _ => 0.108,
    };
    WrittenScene::new("table", 64).check(depth, 0.025, |_, _| true);
}

#[test]
#[ignore = "takes minutes: run by .ci/run"]
fn every_policy_is_accurate_on_thin_wires() {
    let recall = |outcome: &Outcome, width: f64| {
        let thin = outcome.geometry.thin.iter().find(|t| (t.width - width).abs() < 1e-9);
        thin.map_or(0.0, |t| t.recall)
    };
    let is_found = |policy: &str, outcome: &Outcome| {
        // These two policies end with a third or a fifth of the Gaussians and miss more of the wires.
        let min_recall = match policy {
            "lightgaussian" => [0.16, 0.25],
            "mini-splatting" => [0.07, 0.08],
            _ => [0.2, 0.27],
        };
        recall(outcome, 2.0) > min_recall[0] && recall(outcome, 4.0) > min_recall[1]
    };
    let depth = |policy: &str| match policy {
        "mini-splatting" => 0.083,
        "lightgaussian" | "eagles" => 0.075,
        _ => 0.063,
    };
    WrittenScene::new("thin", 96).check(depth, 0.01, is_found);
}

/// With an equal budget that both exhaust, `diet` beats a hard stop in image quality and depth, averaged over two seeds.
#[test]
#[ignore = "takes minutes: run by .ci/run"]
fn diet_beats_the_hard_stop() {
    for scene in ["spheres", "table"].map(|name| WrittenScene::new(name, 64)) {
        let mean = |policy, flags| {
            let runs = [0, 1].map(|seed| scene.train(policy, &format!("--seed {seed} {flags}")));
            assert!(runs.iter().all(|run| run.peak >= BUDGET - BUDGET / 50), "{policy}: {runs:?}");
            let mean = |metric: fn(&Outcome) -> f64| 0.5 * (metric(&runs[0]) + metric(&runs[1]));
            (mean(|o| o.ssim), mean(|o| o.psnr), mean(|o| o.geometry.depth.rmse))
        };
        let (stop, diet) = (mean("vanilla", HARD_STOP), mean("diet", ""));
        assert!(diet.0 > stop.0 + 0.003, "SSIM {} against {}", diet.0, stop.0);
        assert!(diet.1 > stop.1, "PSNR {} against {}", diet.1, stop.1);
        assert!(diet.2 < 0.97 * stop.2, "depth RMSE {} against {}", diet.2, stop.2);
    }
}
