//! LPIPS, a distance between the features of two images in a trained network (Zhang, Isola, Efros, Shechtman, Wang,
//! *The Unreasonable Effectiveness of Deep Features as a Perceptual Metric*, CVPR 2018, arXiv 1801.03924,
//! version 0.1).
//!
//! The published weights are not part of this project; the user provides them in a file ([`Lpips::open`]). Two networks
//! are supported, VGG-16 and AlexNet, each with five stages. After each stage the features of a pixel are scaled to
//! unit length; the squared differences between both images, weighted by feature, are averaged over the image, and the
//! five averages are added.

mod convolution;
mod network;
mod weights;

pub use network::Network;
pub use weights::LpipsError;

use super::{MetricError, Pair};
use densify_core::image::Image8;
use network::{Activation, Stage};

/// Added to the length of a pixel's features to avoid division by 0; as published.
const EPSILON: f32 = 1e-10;
/// Mean red, green and blue of the images that the networks were trained on, in `[-1, 1]`.
const SHIFT: [f32; 3] = [-0.030, -0.088, -0.188];
/// Standard deviation of red, green and blue in these images.
const SCALE: [f32; 3] = [0.458, 0.448, 0.450];

/// A network with its weights.
#[derive(Debug)]
pub struct Lpips {
    network: Network,
    stages: Vec<Stage>,
}

impl Lpips {
    /// The network that the weights belong to.
    pub fn network(&self) -> Network {
        self.network
    }

    /// LPIPS of a render against a target, >= 0; 0 for equal images.
    ///
    /// `rendered`: shape `[height, width, 3]`, clamped to `[0, 1]` here. Targets with coverage are composited on
    /// `background`, in `[0, 1]`. A mask scales the differences between the pixels of both images before the first
    /// stage. NaN if the render contains a NaN.
    ///
    /// # Errors
    /// When the sizes differ, the image is too small for the network, or the target's mask ignores every pixel.
    pub fn compare(
        &self,
        rendered: &[f32],
        target: &Image8,
        background: [f32; 3],
    ) -> Result<f64, MetricError> {
        let pair = Pair::new(rendered, target, background)?;
        let least = self.network.least_side();
        if pair.width.min(pair.height) < least {
            let (width, height) = (target.width, target.height);
            return Err(MetricError::TooSmall { least, width, height });
        }
        if (0..pair.width * pair.height).all(|p| pair.weight(p) <= 0.0) {
            return Err(MetricError::NothingToCompare);
        }
        let mut images = images(&pair);
        let mut sum = 0.0;
        for stage in &self.stages {
            let (distance, pooled) = stage.run(&images);
            sum += distance;
            images = pooled;
        }
        Ok(sum)
    }
}

/// Render and target as inputs of the network.
fn images(pair: &Pair<'_>) -> [Activation; 2] {
    let (width, height) = (pair.width, pair.height);
    let scaled = |c: usize, value: f64| (2.0 * value as f32 - 1.0 - SHIFT[c]) / SCALE[c];
    let [mut render, mut truth] =
        [3, 3].map(|channels| Activation::zeros(channels, 0..height, width));
    for c in 0..3 {
        for p in 0..width * height {
            let (weight, at) = (pair.weight(p), c * width * height + p);
            // An ignored pixel may be NaN.
            let error = if weight > 0.0 { weight * pair.error(p, c) } else { 0.0 };
            truth.values[at] = scaled(c, pair.truth(p, c));
            render.values[at] = scaled(c, pair.truth(p, c) + error);
        }
    }
    [render, truth]
}

#[cfg(test)]
mod tests;
