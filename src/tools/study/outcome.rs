//! The outcome of a run, a line of a study's journal.

use std::collections::BTreeMap;

use serde::{Deserialize, Deserializer, Serialize};
use toml::Table;

use super::limit::Limit;

use densify_run::Partial;
use densify_train::metrics::geometry::Geometry;
use densify_train::output::Mean;

/// The outcome of a run.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct Outcome {
    /// Version of densify.
    pub(super) densify: String,
    /// Label of the scene.
    pub(super) scene: String,
    /// The factor that is varied: a policy in `compare`, a knob in `trade`.
    pub(super) factor: String,
    /// Its level: the limit, or the knob's value.
    pub(super) level: String,
    /// Maximum number of rows: that given, or as many as the memory limit holds.
    pub(super) budget: usize,
    /// Memory limit, if that is what is equal for all policies `[bytes]`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(super) memory: Option<u64>,
    pub(super) seed: u32,
    pub(super) iterations: u32,
    /// Folder of the run, in `runs`.
    pub(super) run: String,
    /// Description of the run, by which a finished run is recognised.
    pub(super) spec: Table,
    /// Checksum of the model's file.
    pub(super) model: u32,
    /// Size of the model's file `[bytes]`.
    #[serde(default)]
    pub(super) model_bytes: Option<u64>,
    /// Mean PSNR of the test views `[dB]`.
    #[serde(deserialize_with = "or_infinite")]
    pub(super) psnr: f64,
    /// Mean SSIM of the test views.
    pub(super) ssim: f64,
    /// Mean FLIP of the test views.
    pub(super) flip: f64,
    /// Mean LPIPS of the test views, if it was measured.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(super) lpips: Option<f64>,
    /// Scores of each test view, by its name.
    #[serde(default)]
    pub(super) views: BTreeMap<String, Mean>,
    /// Number of Gaussians at the end.
    pub(super) rows: usize,
    /// Largest number of Gaussians at any instant.
    pub(super) peak_rows: usize,
    /// Spherical-harmonic degree of the model.
    #[serde(default)]
    pub(super) sh_degree: Option<u8>,
    /// Peak resident memory of the process `[bytes]`, if known.
    pub(super) peak_bytes: Option<u64>,
    /// Memory promised by the ledger `[bytes]`.
    pub(super) ledger_bytes: u64,
    /// Wall time of training `[s]`.
    pub(super) seconds: f64,
    /// Wall time of the processes that trained and evaluated, if this study started them `[s]`.
    #[serde(default)]
    pub(super) wall_seconds: Option<f64>,
    /// The time that was expected before any run was measured `[s]`.
    #[serde(default)]
    pub(super) modelled_seconds: Option<f64>,
    /// Processor time of training `[s]`, if known.
    pub(super) cpu_seconds: Option<f64>,
    /// Number of views rendered for the policy's decisions.
    pub(super) extra_forwards: u64,
    /// Iterations at which the test views were evaluated during training, with their mean PSNR `[dB]`.
    #[serde(deserialize_with = "curve_or_infinite")]
    pub(super) curve: Vec<(u32, f64)>,
    /// Geometric errors, if the surface is known.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(super) geometry: Option<Geometry>,
}

/// Reads a PSNR; where a view equals its photograph it is infinite, which JSON writes as null.
fn or_infinite<'de, D: Deserializer<'de>>(from: D) -> Result<f64, D::Error> {
    Ok(Option::deserialize(from)?.unwrap_or(f64::INFINITY))
}

/// Reads a curve of such values.
fn curve_or_infinite<'de, D: Deserializer<'de>>(from: D) -> Result<Vec<(u32, f64)>, D::Error> {
    let points = Vec::<(u32, Option<f64>)>::deserialize(from)?.into_iter();
    Ok(points.map(|(step, psnr)| (step, psnr.unwrap_or(f64::INFINITY))).collect())
}

impl Outcome {
    /// True for a run with this description by this version of densify.
    pub(super) fn is_of(&self, spec: &Partial) -> bool {
        self.densify == env!("CARGO_PKG_VERSION") && spec.is_table(&self.spec)
    }

    /// The limit under which the run was compared.
    pub(super) fn limit(&self) -> Limit {
        self.memory.map_or(Limit::Rows(self.budget), Limit::Memory)
    }

    /// True if the budget was kept at every instant.
    pub(super) fn kept_its_budget(&self) -> bool {
        self.peak_rows <= self.budget
    }
}

/// An outcome for tests.
#[cfg(test)]
pub(super) fn sample(factor: &str, level: &str, seed: u32, psnr: f64) -> Outcome {
    Outcome {
        densify: "1".into(),
        scene: "room".into(),
        factor: factor.into(),
        level: level.into(),
        budget: 1000,
        memory: None,
        seed,
        iterations: 7000,
        run: String::new(),
        spec: Table::new(),
        model: (psnr * 1e3) as u32,
        model_bytes: None,
        psnr,
        ssim: psnr / 100.0,
        flip: 1.0 - psnr / 100.0,
        lpips: None,
        views: BTreeMap::new(),
        rows: 900,
        peak_rows: 1000,
        sh_degree: Some(3),
        peak_bytes: None,
        ledger_bytes: 1,
        seconds: 1.25,
        wall_seconds: None,
        modelled_seconds: None,
        cpu_seconds: None,
        extra_forwards: 0,
        curve: Vec::new(),
        geometry: None,
    }
}
