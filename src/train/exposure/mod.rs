//! How a photograph was exposed: an affine transform of the scene's colours, C' = matrix·C + offset, in the
//! encoded values of the image, in `[0, 1]`.
//!
//! Cameras choose shutter time and white balance anew for each photograph. In linear light that is a factor
//! per channel. The sRGB curve is 1.055·x^(1/2.4) − 0.055 but for the darkest values, so that the same in
//! encoded values is, exactly, a factor and an offset. The form is that of INRIA's trainer; with
//! [`ExposureModel::Channels`] the matrix is diagonal.
//!
//! What lies behind the scene was not photographed: `--background` and the transparency of an image are
//! composited after the transform. A renderer that transforms whole pixels gets this by rendering over
//! [`ColourTransform::behind`](densify_core::colour::ColourTransform::behind).

mod fit;
pub mod reported;
mod views;

use clap::ValueEnum;
use serde::{Deserialize, Serialize};

pub use fit::fitted;
pub use views::{Exposures, named_transforms};

/// `--exposure`: whether each photograph has an exposure of its own.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum ExposureChoice {
    /// All photographs are exposed alike
    #[default]
    Off,
    /// On where the colours of the reconstruction's points show that exposures differ, which is decided before
    /// training
    Auto,
    /// An exposure is learned for each photograph
    On,
}

/// `--exposure-model`: what an exposure may do to colours.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum ExposureModel {
    /// A factor and an offset per channel
    #[default]
    Channels,
    /// Any affine transform, which may mix channels
    Matrix,
}
