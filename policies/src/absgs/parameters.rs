//! The parameters of `absgs`, explained in its manual page.

use std::ops::Bound::Excluded;

use serde::{Deserialize, Serialize};

use crate::parameters::in_range;
use crate::policy::PolicyResult;

/// Parameters of [`AbsGs`](super::AbsGs).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
#[expect(missing_docs, reason = "the manual page documents every parameter, and a test checks it")]
pub struct AbsGsParams {
    pub grow_from: u32,
    pub grow_until: u32,
    pub grow_every: u32,
    pub tau: f64,
    pub tau_abs: f64,
    pub small: f64,
    pub split_factor: f64,
    pub min_opacity: f64,
    pub max_scale: f64,
    pub max_scale_from: u32,
    pub reset_every: u32,
    pub reset_opacity: f64,
    pub white_reset_at: u32,
    pub limit_every: u32,
    pub limit_opacity: f64,
    pub last_prune_at: u32,
    pub last_prune_opacity: f64,
    pub last_prune_share: f64,
}

impl Default for AbsGsParams {
    fn default() -> Self {
        Self {
            grow_from: 500,
            grow_until: 15_000,
            grow_every: 100,
            tau: 2e-4,
            tau_abs: 4e-4,
            small: 0.001,
            split_factor: 1.6,
            min_opacity: 0.005,
            max_scale: 0.0,
            max_scale_from: 3000,
            reset_every: 3000,
            reset_opacity: 0.01,
            white_reset_at: 500,
            limit_every: 500,
            limit_opacity: 0.8,
            last_prune_at: 18_000,
            last_prune_opacity: 0.1,
            last_prune_share: 0.5,
        }
    }
}

impl AbsGsParams {
    /// Checks ranges, except that of `reset_opacity`.
    pub(super) fn check(&self) -> PolicyResult {
        in_range("tau", self.tau, 0.0..)?;
        in_range("tau_abs", self.tau_abs, 0.0..)?;
        in_range("small", self.small, 0.0..)?;
        in_range("split_factor", self.split_factor, 1.0..=100.0)?;
        in_range("min_opacity", self.min_opacity, 0.0..=1.0)?;
        in_range("max_scale", self.max_scale, 0.0..)?;
        in_range("limit_opacity", self.limit_opacity, (Excluded(0.0), Excluded(1.0)))?;
        in_range("last_prune_opacity", self.last_prune_opacity, 0.0..=1.0)?;
        in_range("last_prune_share", self.last_prune_share, 0.0..=1.0)
    }
}
