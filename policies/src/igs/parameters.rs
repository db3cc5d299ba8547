//! The parameters of `igs`, explained in its manual page.

use std::ops::Bound::{Excluded, Included, Unbounded};

use serde::{Deserialize, Serialize};

use crate::parameters::{REFERENCE_ITERATIONS, in_range};
use crate::policy::PolicyResult;

/// Maximum number of iterations per optimiser step.
pub(crate) const MAX_SUM: u32 = 1000;

/// Parameters of [`Igs`](super::Igs).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
#[expect(missing_docs, reason = "the manual page documents every parameter, and a test checks it")]
pub struct IgsParams {
    pub grow_from: u32,
    pub grow_until: u32,
    pub grow_every: u32,
    pub curve_until: u32,
    pub tau: f64,
    pub views: u32,
    pub split_share: f64,
    pub child_opacity: f64,
    pub final_from: u32,
    pub final_divisor: f64,
    pub min_opacity: f64,
    pub prune_last: bool,
    pub first_prune_at: u32,
    pub first_prune_opacity: f64,
    pub reset_every: u32,
    pub resets: u32,
    pub reset_opacity: f64,
    pub recover: u32,
    pub recoveries: u32,
    pub recovery_share: f64,
    pub sum_from: u32,
    pub sum: u32,
    pub sum_more_from: u32,
    pub sum_more: u32,
    pub sums: SumScaling,
    pub mean_start: f64,
    pub mean_end: f64,
    pub sh_rest: f64,
}

/// The effect of the run's length on `sum` and `sum_more`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum SumScaling {
    /// Scaled with the run's length, so that the number of optimiser steps stays the same.
    Scaled,
    /// Used as given in a run of any length.
    Fixed,
}

impl SumScaling {
    /// Iterations per optimiser step in a run of this number of iterations; `sum` is that of a run of 30,000.
    pub(crate) fn of_run(self, sum: u32, iterations: u32) -> u32 {
        match self {
            Self::Fixed => sum,
            Self::Scaled => {
                let exact =
                    f64::from(sum) * f64::from(iterations) / f64::from(REFERENCE_ITERATIONS);
                exact.round().clamp(1.0, f64::from(MAX_SUM)) as u32
            }
        }
    }
}

impl Default for IgsParams {
    fn default() -> Self {
        Self {
            grow_from: 500,
            grow_until: 15_000,
            grow_every: 100,
            curve_until: 14_500,
            tau: 3e-4,
            views: 10,
            split_share: 0.45,
            child_opacity: 0.6,
            final_from: 14_500,
            final_divisor: 1.5,
            min_opacity: 0.005,
            prune_last: false,
            first_prune_at: 300,
            first_prune_opacity: 0.02,
            reset_every: 3000,
            resets: 4,
            reset_opacity: 0.05,
            recover: 300,
            recoveries: 2,
            recovery_share: 0.2,
            sum_from: 15_000,
            sum: 5,
            sum_more_from: 22_500,
            sum_more: 20,
            sums: SumScaling::Scaled,
            mean_start: 4e-5,
            mean_end: 2e-6,
            sh_rest: 2.5e-4,
        }
    }
}

impl IgsParams {
    /// `sum` and `sum_more` for a run of this number of iterations.
    pub(super) fn scaled_sums(&self, iterations: u32) -> [u32; 2] {
        [self.sum, self.sum_more].map(|sum| self.sums.of_run(sum, iterations))
    }

    /// Checks ranges.
    pub(super) fn check(&self) -> PolicyResult {
        let positive = (Excluded(0.0), Unbounded);
        let open_unit = (Excluded(0.0), Excluded(1.0));
        in_range("tau", self.tau, 0.0..)?;
        in_range("views", self.views.into(), 1.0..)?;
        in_range("split_share", self.split_share, open_unit)?;
        in_range("child_opacity", self.child_opacity, (Excluded(0.0), Included(1.0)))?;
        in_range("final_divisor", self.final_divisor, 1.0..)?;
        in_range("min_opacity", self.min_opacity, 0.0..=1.0)?;
        in_range("first_prune_opacity", self.first_prune_opacity, 0.0..=1.0)?;
        in_range("recover", self.recover.into(), 1.0..)?;
        in_range("recovery_share", self.recovery_share, 0.0..=1.0)?;
        in_range("sum", self.sum.into(), 1.0..=MAX_SUM.into())?;
        in_range("sum_more", self.sum_more.into(), 1.0..=MAX_SUM.into())?;
        in_range("mean_start", self.mean_start, positive)?;
        in_range("mean_end", self.mean_end, positive)?;
        in_range("sh_rest", self.sh_rest, positive)?;
        Ok(())
    }
}
