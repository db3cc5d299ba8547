//! Policies on scenes whose geometry is known exactly: small views of built-in scenes, 1,000 steps, fixed
//! seeds. How near a policy comes to the surface.
//!
//! Bounds are some 20 % beyond what was measured. They hold the policies to what they reach, and say
//! nothing of how good that is: a thousand steps at 64 px are few.

use std::path::PathBuf;

use densify::train::metrics::geometry::Geometry;
use densify_policies::registry::policies;
use tempfile::TempDir;

use super::{call, count, json, scratch, text};

const BUDGET: u64 = 800;
const STEPS: u32 = 1000;
/// The best hard stop that was found: growth five times as often as by default (the interval's
/// least for so short a run is 100 steps), and no resets, which a short run does not recover from.
const HARD_STOP: &str = "--policy-set vanilla.grow_every=20 --policy-set vanilla.reset_every=0";

/// A built-in scene in a folder.
struct Known {
    _root: TempDir,
    folder: PathBuf,
}

/// What came of a run.
#[derive(Debug)]
struct Outcome {
    geometry: Geometry,
    psnr: f64,
    ssim: f64,
    peak: u64,
}

impl Known {
    /// 24 views of a scene to train on and 6 held out, and 400 points to start from.
    fn new(name: &str, side: u32) -> Self {
        let (root, folder) = scratch();
        let size = format!("--size {side} --train 24 --test 6 --points 400");
        call(&format!("scenegen --preset {name} {size} -o {}", text(&folder))).ok();
        Self { _root: root, folder }
    }

    /// Trains a policy and measures the model.
    #[expect(clippy::print_stderr, reason = "shown where a test fails or is asked to show it")]
    fn train(&self, policy: &str, flags: &str) -> Outcome {
        let (_root, run) = scratch();
        let (folder, run_text) = (text(&self.folder), text(&run));
        let fixed = format!("--budget {BUDGET} --iterations {STEPS} --sh-degree 0 --backend cpu");
        call(&format!(
            "train {folder} -o {run_text} --policy {policy} {fixed} --eval --quiet {flags}"
        ))
        .ok();
        call(&format!("eval {run_text} --backend cpu")).ok();
        let of = |file: &str| json(&run.join(file))[format!("ours_{STEPS}")].take();
        let (scores, summary) = (of("results.json"), json(&run.join("stats/summary.json")));
        let score = |name: &str| scores[name].as_f64().expect("a score");
        let outcome = Outcome {
            geometry: serde_json::from_value(of("geometry.json")).expect("a geometry"),
            psnr: score("PSNR"),
            ssim: score("SSIM"),
            peak: count(&summary, "peak_rows"),
        };
        assert!(outcome.peak <= BUDGET, "{policy}: {outcome:?}");
        eprintln!("{policy} {flags}: {outcome:?}");
        outcome
    }

    /// Holds every policy to what is allowed, as shares: depth RMSE of the diagonal, floaters of the rows.
    fn check(
        &self,
        depth: impl Fn(&str) -> f64,
        floaters: f64,
        more: impl Fn(&str, &Outcome) -> bool,
    ) {
        let mut beyond = Vec::new();
        for entry in policies().expect("the registry is sound") {
            let outcome = self.train(entry.name, "");
            let found = &outcome.geometry;
            // Before thin wires, `reduced-3dgs` leaves 5.4 % of the pixels empty on some processors.
            let is_near = found.depth.rmse < depth(entry.name) && found.depth.coverage > 0.93;
            let is_clean = found.floaters.of_rows < floaters;
            if !(is_near && is_clean && more(entry.name, &outcome)) {
                beyond.push((entry.name, outcome));
            }
        }
        assert!(beyond.is_empty(), "{beyond:#?}");
    }
}

#[test]
#[ignore = "takes minutes: run by .ci/run"]
fn spheres() {
    // They end with a fifth and a half of the budget.
    let depth = |policy: &str| match policy {
        "mini-splatting" => 0.042,
        "reduced-3dgs" => 0.039,
        "eagles" | "lightgaussian" => 0.036,
        _ => 0.033,
    };
    Known::new("spheres", 64).check(depth, 0.005, |_, _| true);
}

#[test]
#[ignore = "takes minutes: run by .ci/run"]
fn clutter() {
    let depth = |policy: &str| match policy {
        "mcmc" | "igs" => 0.05,
        "diet" => 0.056,
        "taming" => 0.065,
        "lightgaussian" | "reduced-3dgs" => 0.115,
        // Most of its steps see images of 19 to 60 px, and it ends with half of the budget.
        "eagles" => 0.155,
        "mini-splatting" => 0.09,
        _ => 0.108,
    };
    Known::new("table", 64).check(depth, 0.025, |_, _| true);
}

#[test]
#[ignore = "takes minutes: run by .ci/run"]
fn wires() {
    let recall = |outcome: &Outcome, width: f64| {
        let thin = outcome.geometry.thin.iter().find(|t| (t.width - width).abs() < 1e-9);
        thin.map_or(0.0, |t| t.recall)
    };
    let is_found = |policy: &str, outcome: &Outcome| {
        // A third or a fifth of the Gaussians shows less of a wire.
        let least = match policy {
            "lightgaussian" => [0.16, 0.25],
            "mini-splatting" => [0.07, 0.08],
            _ => [0.2, 0.27],
        };
        recall(outcome, 2.0) > least[0] && recall(outcome, 4.0) > least[1]
    };
    let depth = |policy: &str| match policy {
        "mini-splatting" => 0.083,
        "lightgaussian" | "eagles" => 0.075,
        _ => 0.063,
    };
    Known::new("thin", 96).check(depth, 0.01, is_found);
}

/// At equal budget, both at it, `diet` is nearer to pictures held out and to the surface than a hard
/// stop: in the mean over two seeds.
#[test]
#[ignore = "takes minutes: run by .ci/run"]
fn diet_beats_the_hard_stop() {
    for known in ["spheres", "table"].map(|scene| Known::new(scene, 64)) {
        let mean = |policy, flags| {
            let runs = [0, 1].map(|seed| known.train(policy, &format!("--seed {seed} {flags}")));
            assert!(runs.iter().all(|run| run.peak >= BUDGET - BUDGET / 50), "{policy}: {runs:?}");
            let mean = |of: fn(&Outcome) -> f64| 0.5 * (of(&runs[0]) + of(&runs[1]));
            (mean(|o| o.ssim), mean(|o| o.psnr), mean(|o| o.geometry.depth.rmse))
        };
        let (stop, diet) = (mean("vanilla", HARD_STOP), mean("diet", ""));
        assert!(diet.0 > stop.0 + 0.003, "SSIM {} against {}", diet.0, stop.0);
        assert!(diet.1 > stop.1, "PSNR {} against {}", diet.1, stop.1);
        assert!(diet.2 < 0.97 * stop.2, "depth RMSE {} against {}", diet.2, stop.2);
    }
}
