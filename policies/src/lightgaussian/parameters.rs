//! The parameters of `lightgaussian`, explained in its manual page.

use serde::{Deserialize, Serialize};

use crate::parameters::in_range;
use crate::policy::PolicyResult;
use crate::prune::Victims;
use crate::vanilla::VanillaParams;

/// Parameters of [`LightGaussian`](super::LightGaussian).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default)]
#[expect(missing_docs, reason = "the manual page documents every parameter, and a test checks it")]
pub struct LightGaussianParams {
    #[serde(flatten)]
    pub growth: VanillaParams,
    pub schedule: Schedule,
    pub first_at: u32,
    pub first_share: f64,
    pub second_at: u32,
    pub second_share: f64,
    pub once_at: u32,
    pub once_share: f64,
    pub victims: Victims,
    pub hit: Hit,
    pub volume: Volume,
    pub volume_power: f64,
}

/// The number of prunes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Schedule {
    /// Two prunes, of `first_share` and `second_share`.
    Twice,
    /// One prune, of `once_share`.
    Once,
}

/// The contribution of a pixel to the significance of the rows blended into it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Hit {
    /// The row's opacity.
    Opacity,
    /// The row's blend weight α·T in the pixel.
    BlendWeight,
}

/// The volume of a row in its significance.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Volume {
    /// The product of the standard deviations.
    Plain,
    /// The product of the standard deviations, clipped at its 90th percentile.
    Clipped,
}

impl Default for LightGaussianParams {
    fn default() -> Self {
        Self {
            growth: VanillaParams::default(),
            schedule: Schedule::Twice,
            first_at: 16_000,
            first_share: 0.5,
            second_at: 24_000,
            second_share: 0.4,
            once_at: 20_000,
            once_share: 0.66,
            victims: Victims::Lowest,
            hit: Hit::Opacity,
            volume: Volume::Plain,
            volume_power: 0.1,
        }
    }
}

impl LightGaussianParams {
    /// Checks the ranges of the parameters that are not `vanilla`'s.
    pub(super) fn check(&self) -> PolicyResult {
        in_range("first_share", self.first_share, 0.0..=1.0)?;
        in_range("second_share", self.second_share, 0.0..=1.0)?;
        in_range("once_share", self.once_share, 0.0..=1.0)?;
        in_range("volume_power", self.volume_power, 0.0..=1.0)
    }
}
