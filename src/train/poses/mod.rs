//! Poses of the training views, refined together with the model.
//!
//! Poses that were measured by a phone, or estimated from poor photographs, are off by more than training forgives: a
//! sixth of a pixel costs 2 dB. The gradient with respect to a pose is exact (`project_bwd` of the backends), and each
//! view has its own Adam moments and takes a step when its photograph is trained on. The host computes these steps in a
//! fixed order, so that runs are reproducible.
//!
//! A moved scene with cameras moved along with it gives the same images. So after each pass over the views the similarity
//! that best explains all motions together is removed from them.

mod adam;
mod refined;
mod test_view;

use clap::ValueEnum;
use serde::{Deserialize, Serialize};

pub use refined::{ExpectedErrors, Poses};
pub use test_view::fitted_camera;

/// The choice to refine the poses of the training views or not.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum PoseChoice {
    /// Poses are taken as they are given
    #[default]
    Fixed,
    /// Refined if the points of the reconstruction show that they are off, which is decided before training
    Auto,
    /// Poses are refined during training
    Refine,
}

impl PoseChoice {
    /// The name in options.
    pub fn name(self) -> &'static str {
        match self {
            Self::Fixed => "fixed",
            Self::Auto => "auto",
            Self::Refine => "refine",
        }
    }
}
