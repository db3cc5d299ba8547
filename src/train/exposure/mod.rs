//! Exposures of photographs: affine transforms of the scene's colours, C' = matrix·C + offset, in sRGB-encoded values
//! in `[0, 1]`.
//!
//! Cameras choose shutter time and white balance for each photograph. In linear light the choice is a factor per
//! channel. Except for the darkest values, the sRGB curve is 1.055·x^(1/2.4) − 0.055, so that such a factor acts on
//! encoded values exactly as a factor and an offset. INRIA's trainer uses the same form; with
//! [`ExposureModel::Channels`] the matrix is diagonal.
//!
//! The background was not photographed, so it is composited after the transform. A renderer that transforms whole
//! pixels achieves this by rendering over [`ColourTransform::behind`](densify_core::colour::ColourTransform::behind).

mod best_fit;
mod learned;
pub mod reported;

use clap::ValueEnum;
use serde::{Deserialize, Serialize};

pub use best_fit::fitted;
pub use learned::{Exposures, named_transforms};

/// The choice to learn exposures of the photographs or not.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum ExposureChoice {
    /// All photographs are exposed alike
    #[default]
    Off,
    /// On if the colours of the reconstruction's points show that exposures differ, which is decided before
    /// training
    Auto,
    /// An exposure is learned for each photograph
    On,
}

/// The form of the colour transform that is learned as an exposure.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum ExposureModel {
    /// A factor and an offset per channel
    #[default]
    Channels,
    /// Any affine transform, which may mix channels
    Matrix,
}
