//! What a study leaves on disk of every run: a line in its file of records.

use serde::{Deserialize, Serialize};
use toml::Table;

use densify_run::Partial;
use densify_train::metrics::geometry::Geometry;

/// The result of a run.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct Outcome {
    /// Version of densify.
    pub(super) densify: String,
    /// Label of the scene.
    pub(super) scene: String,
    /// What is varied: a policy of `compare`, a knob of `trade`.
    pub(super) factor: String,
    /// At which level: the budget, or the knob's value.
    pub(super) level: String,
    pub(super) budget: usize,
    pub(super) seed: u32,
    pub(super) iterations: u32,
    /// Folder of the run, in `runs`.
    pub(super) run: String,
    /// The run's description: one with the same is not run again.
    pub(super) spec: Table,
    /// Checksum of the model's file: equal models have equal ones.
    pub(super) model: u32,
    /// Mean over the views held out `[dB]`.
    pub(super) psnr: f64,
    pub(super) ssim: f64,
    pub(super) flip: f64,
    /// Rows at the end.
    pub(super) rows: usize,
    /// Most rows at any instant.
    pub(super) peak_rows: usize,
    /// Largest resident memory of the process.
    pub(super) peak_bytes: Option<u64>,
    /// What was promised.
    pub(super) ledger_bytes: u64,
    /// Wall time of the steps.
    pub(super) seconds: f64,
    /// Processor time of the steps.
    pub(super) cpu_seconds: Option<f64>,
    /// Views rendered for the policy's decisions.
    pub(super) extra_forwards: u64,
    /// (iteration, PSNR) along the run.
    pub(super) curve: Vec<(u32, f64)>,
    /// How the model sits on the surface, where that is known.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(super) geometry: Option<Geometry>,
}

impl Outcome {
    /// Whether it is of the run with this description, by this version of densify.
    pub(super) fn is_of(&self, spec: &Partial) -> bool {
        self.densify == env!("CARGO_PKG_VERSION") && spec.is_table(&self.spec)
    }

    /// Whether the budget was kept at every instant.
    pub(super) fn kept_its_budget(&self) -> bool {
        self.peak_rows <= self.budget
    }
}

/// A run for tests of what shows results.
#[cfg(test)]
pub(super) fn sample(factor: &str, level: &str, seed: u32, psnr: f64) -> Outcome {
    Outcome {
        densify: "1".into(),
        scene: "room".into(),
        factor: factor.into(),
        level: level.into(),
        budget: 1000,
        seed,
        iterations: 7000,
        run: String::new(),
        spec: Table::new(),
        model: (psnr * 1e3) as u32,
        psnr,
        ssim: psnr / 100.0,
        flip: 1.0 - psnr / 100.0,
        rows: 900,
        peak_rows: 1000,
        peak_bytes: None,
        ledger_bytes: 1,
        seconds: 1.25,
        cpu_seconds: None,
        extra_forwards: 0,
        curve: Vec::new(),
        geometry: None,
    }
}
