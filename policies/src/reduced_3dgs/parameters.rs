//! The parameters of `reduced-3dgs`, explained in its manual page.

use std::ops::Bound::{Excluded, Unbounded};

use serde::{Deserialize, Serialize};

use crate::parameters::in_range;
use crate::policy::PolicyResult;
use crate::prune::Victims;
use crate::vanilla::VanillaParams;

/// Parameters of [`Reduced`](super::Reduced).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default)]
#[expect(missing_docs, reason = "the manual page documents every parameter, and a test checks it")]
pub struct ReducedParams {
    #[serde(flatten)]
    pub growth: VanillaParams,
    pub prune_every: u32,
    pub prune_until: u32,
    pub neighbours: u32,
    pub sigmas: f64,
    pub deviations: f64,
    pub min_redundancy: f64,
    pub faint_share: f64,
    pub faint_opacity: f64,
    pub opacity_term: f64,
    pub victims: Victims,
    pub random_keep: u32,
}

impl Default for ReducedParams {
    fn default() -> Self {
        Self {
            growth: VanillaParams::default(),
            prune_every: 1000,
            prune_until: 30_000,
            neighbours: 30,
            sigmas: 3.0,
            deviations: 1.0,
            min_redundancy: 3.0,
            faint_share: 0.03,
            faint_opacity: 0.05,
            opacity_term: 0.001,
            victims: Victims::Lowest,
            random_keep: 0,
        }
    }
}

impl ReducedParams {
    /// Checks the ranges of the parameters that are not `vanilla`'s.
    pub(super) fn check(&self) -> PolicyResult {
        in_range("neighbours", f64::from(self.neighbours), 1.0..=1000.0)?;
        in_range("sigmas", self.sigmas, (Excluded(0.0), Unbounded))?;
        in_range("deviations", self.deviations, 0.0..)?;
        in_range("min_redundancy", self.min_redundancy, 0.0..)?;
        in_range("faint_share", self.faint_share, 0.0..=1.0)?;
        in_range("faint_opacity", self.faint_opacity, 0.0..=1.0)?;
        in_range("opacity_term", self.opacity_term, 0.0..)
    }
}
