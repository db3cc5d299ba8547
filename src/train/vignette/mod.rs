//! Vignettes of cameras, learned together with the model: one per camera, which its views share.
//!
//! The factor on light is 1 in the middle of the photograph, so that the model keeps its brightness, and falls from there. A weak regularisation towards no vignette fixes what the photographs do not determine. A camera takes an Adam
//! step whenever one of its photographs is trained on. The host computes these steps in a fixed order, so that runs are
//! reproducible.

mod learned;

use clap::ValueEnum;
use serde::{Deserialize, Serialize};

pub use learned::{Vignettes, named_vignettes};

/// The choice to learn vignettes of the cameras or not.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum VignetteChoice {
    /// Photographs are as bright at their edges as in the middle
    #[default]
    Off,
    /// On if the colours of the reconstruction's points show that a camera loses light towards the edges, which is
    /// decided before training
    Auto,
    /// A vignette is learned for each camera
    On,
}
