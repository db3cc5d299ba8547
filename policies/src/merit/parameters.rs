//! The parameters of `merit`, explained in its manual page.

use std::ops::Bound::{Excluded, Included, Unbounded};

use serde::{Deserialize, Serialize};

use crate::parameters::in_range;
use crate::policy::{ErrorScore, PolicyResult, Signal};

/// Parameters of [`Merit`](super::Merit).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
#[expect(missing_docs, reason = "the manual page documents every parameter, and a test checks it")]
pub struct MeritParams {
    pub grow_from: u32,
    pub grow_until: u32,
    pub grow_every: u32,
    pub curve_until: u32,
    pub curve: f64,
    pub rho: f64,
    pub mu: f64,
    pub gradient: Gradient,
    pub colour_weight: f64,
    pub full_depth: f64,
    pub error_share: f64,
    pub error_power: f64,
    pub error_edge: f64,
    pub error_footprint: f64,
    pub error_view_power: f64,
    pub least_views: u32,
    pub importance: Importance,
    pub protect: u32,
    pub small: f64,
    pub split_share: f64,
    pub child_opacity: f64,
    pub min_opacity: f64,
    pub tax: f64,
    pub scale_term: f64,
    pub opacity_term: f64,
    pub fade_from: f64,
    pub fade_to: f64,
}

/// Which gradient with respect to the projected mean.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Gradient {
    /// With absolute values summed over pixels.
    Abs,
    /// Its norm.
    Screen,
}

impl Gradient {
    pub(super) fn signal(self) -> Signal {
        match self {
            Self::Abs => Signal::ScreenGradientAbs,
            Self::Screen => Signal::ScreenGradient,
        }
    }
}

/// How the importance of a row is measured.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Importance {
    /// Squared mean over views of the root of the largest blend weight.
    Mean,
    /// Largest blend weight in the previous and the current epoch.
    Max,
}

impl Importance {
    pub(super) fn signal(self) -> Signal {
        match self {
            Self::Mean => Signal::WeightMaxRoot,
            Self::Max => Signal::WeightMax,
        }
    }
}

impl Default for MeritParams {
    fn default() -> Self {
        Self {
            grow_from: 500,
            grow_until: 15_000,
            grow_every: 100,
            curve_until: 10_000,
            curve: 0.5,
            rho: 0.25,
            mu: 0.3,
            gradient: Gradient::Abs,
            colour_weight: 30.0,
            full_depth: 0.8,
            error_share: 0.5,
            error_power: 4.0,
            error_edge: 0.25,
            error_footprint: 0.75,
            error_view_power: 0.4,
            least_views: 3,
            importance: Importance::Mean,
            protect: 100,
            small: 0.0,
            split_share: 0.45,
            child_opacity: 0.6,
            min_opacity: 0.005,
            tax: 0.3,
            scale_term: 0.01,
            opacity_term: 0.0,
            fade_from: 0.5,
            fade_to: 0.3,
        }
    }
}

impl MeritParams {
    /// Checks ranges.
    pub(super) fn check(&self) -> PolicyResult {
        in_range("curve", self.curve, (Excluded(0.0), Unbounded))?;
        in_range("rho", self.rho, 0.0..)?;
        in_range("mu", self.mu, 0.0..=1.0)?;
        in_range("colour_weight", self.colour_weight, 0.0..)?;
        in_range("full_depth", self.full_depth, 0.0..)?;
        in_range("error_share", self.error_share, 0.0..=1.0)?;
        in_range("error_power", self.error_power, (Excluded(0.0), Included(16.0)))?;
        in_range("error_edge", self.error_edge, 0.0..)?;
        in_range("error_footprint", self.error_footprint, 0.0..=1.0)?;
        in_range("error_view_power", self.error_view_power, (Excluded(0.0), Included(1.0)))?;
        // `Signal::Age` saturates there.
        in_range("protect", f64::from(self.protect), 0.0..=65_535.0)?;
        in_range("small", self.small, 0.0..)?;
        in_range("split_share", self.split_share, (Excluded(0.0), Excluded(1.0)))?;
        in_range("child_opacity", self.child_opacity, (Excluded(0.0), Included(1.0)))?;
        in_range("min_opacity", self.min_opacity, 0.0..=1.0)?;
        in_range("tax", self.tax, 0.0..)?;
        in_range("scale_term", self.scale_term, 0.0..)?;
        in_range("opacity_term", self.opacity_term, 0.0..)?;
        in_range("fade_from", self.fade_from, 0.0..1.0)?;
        in_range("fade_to", self.fade_to, (Excluded(0.0), Included(1.0)))
    }

    pub(super) fn error_score(&self) -> ErrorScore {
        if self.error_share > 0.0 {
            ErrorScore {
                power: self.error_power as f32,
                edge: self.error_edge as f32,
                footprint: self.error_footprint as f32,
                view_power: self.error_view_power as f32,
            }
        } else {
            ErrorScore::default()
        }
    }
}
