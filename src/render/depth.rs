//! Depth in the loss of a training step.

use clap::ValueEnum;
use serde::{Deserialize, Serialize};

use densify_core::image::depth::DepthMap;

/// The term of the loss that compares a rendering with given depth.
///
/// A term is a mean over pixels, weighted by their confidence times their mask. Inverse depths are multiplied by the
/// [median](DepthMap::median) of the given depth, D, so that a weight means the same in every unit of length. X* is
/// the given inverse depth of a pixel, w and x the blend weights and inverse depths of the Gaussians on its ray. Blend
/// weights receive gradient, because that is what removes Gaussians in front of a surface.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Hash, ValueEnum, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum DepthTerm {
    /// D·|X − X*| with X = Σ w·x / Σ w, the expected inverse depth.
    #[default]
    Expected,
    /// Σ w·(D·|x − X*| − 1), which also makes the pixels with given depth opaque.
    Samples,
}

/// Given depth of a view with its part in the loss.
#[derive(Debug, Clone, Copy)]
pub struct DepthTarget<'a> {
    /// The depth, of the camera's size.
    pub map: &'a DepthMap,
    /// Weight of the term, >= 0.
    pub weight: f32,
    /// The term.
    pub term: DepthTerm,
}
