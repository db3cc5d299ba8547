//! The parameters of `mini-splatting`, explained in its manual page.

use std::ops::Bound::{Excluded, Included, Unbounded};

use serde::{Deserialize, Serialize};

use crate::parameters::in_range;
use crate::policy::PolicyResult;
use crate::prune::Victims;
use crate::vanilla::VanillaParams;

/// Parameters of [`MiniSplatting`](super::MiniSplatting).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default)]
#[expect(missing_docs, reason = "the manual page documents every parameter, and a test checks it")]
pub struct MiniSplattingParams {
    #[serde(flatten)]
    pub growth: VanillaParams,
    pub dominant_share: f64,
    pub first_reinit_at: u32,
    pub second_reinit_at: u32,
    pub reinit_share: f64,
    pub sample_at: u32,
    pub sample_share: f64,
    pub importance: Importance,
    pub restart_opacity: f64,
    pub cut_at: u32,
    pub cut_mass: f64,
    pub opacity_rate: f64,
    pub victims: Victims,
}

/// The importance of a row in one view.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Importance {
    /// Sum of the blend weights.
    Sum,
    /// Mean of the blend weights over the row's pixels.
    Density,
}

impl Default for MiniSplattingParams {
    fn default() -> Self {
        Self {
            growth: VanillaParams { reset_every: 0, white_reset_at: 0, ..VanillaParams::default() },
            dominant_share: 2e-4,
            first_reinit_at: 5000,
            second_reinit_at: 10_000,
            reinit_share: 0.8,
            sample_at: 15_000,
            sample_share: 0.5,
            importance: Importance::Sum,
            restart_opacity: 0.1,
            cut_at: 20_000,
            cut_mass: 0.99,
            opacity_rate: 0.05,
            victims: Victims::Lowest,
        }
    }
}

impl MiniSplattingParams {
    /// Checks the ranges of the parameters that are not `vanilla`'s.
    pub(super) fn check(&self) -> PolicyResult {
        let open_unit = (Excluded(0.0), Excluded(1.0));
        in_range("dominant_share", self.dominant_share, 0.0..=1.0)?;
        in_range("reinit_share", self.reinit_share, (Excluded(0.0), Included(1.0)))?;
        in_range("sample_share", self.sample_share, 0.0..=1.0)?;
        in_range("restart_opacity", self.restart_opacity, open_unit)?;
        in_range("cut_mass", self.cut_mass, 0.0..=1.0)?;
        in_range("opacity_rate", self.opacity_rate, (Excluded(0.0), Unbounded))
    }
}
