//! The parameters of `mrnf`, explained in its manual page.

use std::ops::Bound::{Excluded, Included, Unbounded};

use serde::{Deserialize, Serialize};

use crate::parameters::in_range;
use crate::policy::PolicyResult;

/// Parameters of [`Mrnf`](super::Mrnf).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
#[expect(missing_docs, reason = "the manual page documents every parameter, and a test checks it")]
pub struct MrnfParams {
    pub grow_until: u32,
    pub replace_until: u32,
    pub grow_every: u32,
    pub growth: f64,
    pub tau: f64,
    pub edge: f64,
    pub footprint: f64,
    pub min_opacity: f64,
    pub split_share: f64,
    pub child_opacity: f64,
    pub opacity_decay: f64,
    pub scale_decay: f64,
    pub opacity_term: f64,
    pub scale_term: f64,
    pub scale_term_power: f64,
    pub noise: f64,
    pub noise_sharpness: f64,
    pub mean_start: f64,
    pub mean_end: f64,
    pub log_scale_start: f64,
    pub log_scale_end: f64,
    pub opacity_rate: f64,
    pub quat: f64,
    pub fade: f64,
}

impl Default for MrnfParams {
    fn default() -> Self {
        Self {
            grow_until: 15_000,
            replace_until: 28_500,
            grow_every: 163,
            growth: 0.07,
            tau: 0.0031,
            edge: 0.25,
            footprint: 0.75,
            min_opacity: 0.00392,
            split_share: 0.45,
            child_opacity: 0.6,
            opacity_decay: 0.004,
            scale_decay: 0.002,
            opacity_term: 0.003,
            scale_term: 0.01,
            scale_term_power: 0.4,
            noise: 5e5,
            noise_sharpness: 150.0,
            mean_start: 4.4e-5,
            mean_end: 4e-7,
            log_scale_start: 0.0083,
            log_scale_end: 0.005,
            opacity_rate: 0.012,
            quat: 0.0015,
            fade: 0.3,
        }
    }
}

impl MrnfParams {
    /// Checks ranges.
    pub(super) fn check(&self) -> PolicyResult {
        let positive = (Excluded(0.0), Unbounded);
        in_range("growth", self.growth, 0.0..=1.0)?;
        in_range("tau", self.tau, 0.0..)?;
        in_range("edge", self.edge, 0.0..)?;
        in_range("footprint", self.footprint, 0.0..=1.0)?;
        in_range("min_opacity", self.min_opacity, 0.0..=1.0)?;
        in_range("split_share", self.split_share, (Excluded(0.0), Excluded(1.0)))?;
        in_range("child_opacity", self.child_opacity, (Excluded(0.0), Included(1.0)))?;
        in_range("opacity_decay", self.opacity_decay, 0.0..=1.0)?;
        in_range("scale_decay", self.scale_decay, (Included(0.0), Excluded(1.0)))?;
        in_range("opacity_term", self.opacity_term, 0.0..)?;
        in_range("scale_term", self.scale_term, 0.0..)?;
        in_range("scale_term_power", self.scale_term_power, 0.0..=100.0)?;
        in_range("noise", self.noise, 0.0..)?;
        in_range("noise_sharpness", self.noise_sharpness, 0.0..)?;
        in_range("mean_start", self.mean_start, positive)?;
        in_range("mean_end", self.mean_end, positive)?;
        in_range("log_scale_start", self.log_scale_start, positive)?;
        in_range("log_scale_end", self.log_scale_end, positive)?;
        in_range("opacity_rate", self.opacity_rate, positive)?;
        in_range("quat", self.quat, positive)?;
        in_range("fade", self.fade, (Excluded(0.0), Included(1.0)))
    }
}
