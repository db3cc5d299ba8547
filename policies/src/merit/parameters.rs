//! The parameters of `merit`, explained in its manual page.

use std::ops::Bound::{Excluded, Included};

use serde::{Deserialize, Serialize};

use crate::parameters::in_range;
use crate::policy::{PixelLossChoice, PolicyResult, Signal};

/// Parameters of [`Merit`](super::Merit).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
#[expect(missing_docs, reason = "the manual page documents every parameter, and a test checks it")]
pub struct MeritParams {
    pub grow_from: u32,
    pub grow_until: u32,
    pub grow_every: u32,
    pub curve_until: u32,
    pub rho: f64,
    pub replaceable: f64,
    pub most_rho: f64,
    pub gradient: Gradient,
    pub colour_weight: f64,
    pub full_depth: f64,
    pub least_views: u32,
    pub protect: u32,
    pub small: f64,
    pub split_share: f64,
    pub child_opacity: f64,
    pub min_opacity: f64,
    pub pixel_loss: PixelLossChoice,
}

/// The gradient with respect to the projected mean.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Gradient {
    /// With absolute values summed over pixels: [`Signal::ScreenGradientAbs`].
    Abs,
    /// Without absolute values: [`Signal::ScreenGradient`].
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

impl Default for MeritParams {
    fn default() -> Self {
        Self {
            grow_from: 500,
            grow_until: 15_000,
            grow_every: 100,
            curve_until: 30_000,
            rho: 0.25,
            replaceable: 0.15,
            most_rho: 2.0,
            gradient: Gradient::Abs,
            colour_weight: 30.0,
            full_depth: 0.8,
            least_views: 3,
            protect: 100,
            small: 0.01,
            split_share: 0.45,
            child_opacity: 0.6,
            min_opacity: 0.005,
            pixel_loss: PixelLossChoice::Auto,
        }
    }
}

impl MeritParams {
    /// Checks ranges.
    pub(super) fn check(&self) -> PolicyResult {
        in_range("rho", self.rho, 0.0..)?;
        in_range("replaceable", self.replaceable, 0.0..)?;
        in_range("most_rho", self.most_rho, 0.0..)?;
        in_range("colour_weight", self.colour_weight, 0.0..)?;
        in_range("full_depth", self.full_depth, 0.0..)?;
        // `Signal::Age` saturates at 65,535.
        in_range("protect", f64::from(self.protect), 0.0..=65_535.0)?;
        in_range("small", self.small, 0.0..)?;
        in_range("split_share", self.split_share, (Excluded(0.0), Excluded(1.0)))?;
        in_range("child_opacity", self.child_opacity, (Excluded(0.0), Included(1.0)))?;
        in_range("min_opacity", self.min_opacity, 0.0..=1.0)
    }
}
