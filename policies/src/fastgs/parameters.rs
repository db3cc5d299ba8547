//! The parameters of `fastgs`, explained in its manual page.

use std::ops::Bound::{Excluded, Unbounded};

use serde::{Deserialize, Serialize};

use crate::igs::{MAX_SUM, SumScaling};
use crate::parameters::in_range;
use crate::policy::PolicyResult;

/// Parameters of [`FastGs`](super::FastGs).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
#[expect(missing_docs, reason = "the manual page documents every parameter, and a test checks it")]
pub struct FastGsParams {
    pub grow_from: u32,
    pub grow_until: u32,
    pub grow_every: u32,
    pub tau: f64,
    pub tau_abs: f64,
    pub small: f64,
    pub split_factor: f64,
    pub views: u32,
    pub wrong: f64,
    pub wrong_pixels: u32,
    pub min_opacity: f64,
    pub max_scale: f64,
    pub max_scale_from: u32,
    pub prune_share: f64,
    pub limit_opacity: f64,
    pub reset_every: u32,
    pub reset_opacity: f64,
    pub white_reset_at: u32,
    pub late_prune_every: u32,
    pub late_prune_until: u32,
    pub late_prune_opacity: f64,
    pub late_prune_score: f64,
    pub late_prune_share: f64,
    pub sh_every: u32,
    pub sh_rest: f64,
    pub sum_from: u32,
    pub sum: u32,
    pub sum_more_from: u32,
    pub sum_more: u32,
    pub sums: SumScaling,
}

impl Default for FastGsParams {
    fn default() -> Self {
        Self {
            grow_from: 500,
            grow_until: 15_000,
            grow_every: 500,
            tau: 2e-4,
            tau_abs: 1.2e-3,
            small: 0.001,
            split_factor: 1.6,
            views: 10,
            wrong: 0.1,
            wrong_pixels: 5,
            min_opacity: 0.005,
            max_scale: 0.0,
            max_scale_from: 3000,
            prune_share: 0.5,
            limit_opacity: 0.8,
            reset_every: 3000,
            reset_opacity: 0.01,
            white_reset_at: 500,
            late_prune_every: 3000,
            late_prune_until: 30_000,
            late_prune_opacity: 0.1,
            late_prune_score: 0.9,
            late_prune_share: 0.5,
            sh_every: 16,
            sh_rest: 2.5e-4,
            sum_from: 15_000,
            sum: 32,
            sum_more_from: 20_000,
            sum_more: 64,
            sums: SumScaling::Scaled,
        }
    }
}

impl FastGsParams {
    /// `sh_every`, `sum` and `sum_more` for a run of this number of iterations.
    pub(super) fn scaled_sums(&self, iterations: u32) -> [u32; 3] {
        [self.sh_every, self.sum, self.sum_more].map(|sum| self.sums.of_run(sum, iterations))
    }

    /// Checks ranges, except that of `reset_opacity`.
    pub(super) fn check(&self) -> PolicyResult {
        let open_unit = (Excluded(0.0), Excluded(1.0));
        in_range("tau", self.tau, 0.0..)?;
        in_range("tau_abs", self.tau_abs, 0.0..)?;
        in_range("small", self.small, 0.0..)?;
        in_range("split_factor", self.split_factor, 1.0..=100.0)?;
        in_range("views", self.views.into(), 1.0..)?;
        in_range("wrong", self.wrong, open_unit)?;
        in_range("min_opacity", self.min_opacity, 0.0..=1.0)?;
        in_range("max_scale", self.max_scale, 0.0..)?;
        in_range("prune_share", self.prune_share, 0.0..=1.0)?;
        in_range("limit_opacity", self.limit_opacity, open_unit)?;
        in_range("late_prune_opacity", self.late_prune_opacity, 0.0..=1.0)?;
        in_range("late_prune_score", self.late_prune_score, 0.0..=1.0)?;
        in_range("late_prune_share", self.late_prune_share, 0.0..=1.0)?;
        in_range("sh_every", self.sh_every.into(), 1.0..=1000.0)?;
        in_range("sh_rest", self.sh_rest, (Excluded(0.0), Unbounded))?;
        in_range("sum", self.sum.into(), 1.0..=MAX_SUM.into())?;
        in_range("sum_more", self.sum_more.into(), 1.0..=MAX_SUM.into())
    }
}
