//! Training with smaller images at the policy's request.
//!
//! *EAGLES* (Girish et al. 2024) starts with small images and increases their size during the run. The camera of a view
//! is scaled with its image, so that the model stays in the same coordinates.

use std::sync::Arc;

use densify_policies::policy::PolicyError;

use super::{TrainError, Trainer};
use densify_core::camera::Camera;
use densify_core::image::SharedImage;
use densify_core::image::depth::SharedDepth;
use densify_data::views::ViewSource;

/// Smallest side of shrunk images `[px]`, because nothing could be learned from smaller images.
const MIN_SIDE: u32 = 16;

impl<V: ViewSource> Trainer<V> {
    /// A view's camera, image and depth at the resolution that the policy requests for this step.
    pub(super) fn at_resolution(
        &self,
        step: u32,
        view: usize,
        image: SharedImage,
        depth: Option<SharedDepth>,
    ) -> Result<(Camera, SharedImage, Option<SharedDepth>), TrainError> {
        let scale = self.ask_policy(step, |policy| policy.resolution(step))?;
        let checked = self.needs.check_resolution(scale).map_err(PolicyError::Other);
        checked.map_err(|error| self.policy_error(step, error))?;
        let camera = self.camera(view);
        let (width, height) = shrunk((camera.width, camera.height), scale);
        if (width, height) == (camera.width, camera.height) {
            return Ok((camera, image, depth));
        }
        let depth = depth.map(|depth| Arc::new(depth.shrunk(width, height)));
        Ok((camera.resized(width, height), Arc::new(image.shrunk(width, height)), depth))
    }
}

/// Both sides times `scale`, rounded down. The scale is raised if the shorter side would be less than [`MIN_SIDE`].
fn shrunk((width, height): (u32, u32), scale: f64) -> (u32, u32) {
    let min_scale = f64::from(MIN_SIDE) / f64::from(width.min(height));
    let scale = scale.max(min_scale).min(1.0);
    // The small addend compensates for the rounding of products that should be integers.
    let side = |side: u32| ((f64::from(side) * scale + 1e-6) as u32).max(1);
    (side(width), side(height))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sides_are_shrunk_in_proportion_and_not_below_the_minimum() {
        assert_eq!(shrunk((256, 192), 0.3), (76, 57));
        assert_eq!(shrunk((100, 50), 0.7), (70, 35));
        assert_eq!(shrunk((256, 192), 1.0), (256, 192));
        // Both sides times 16 / 64.
        assert_eq!(shrunk((256, 64), 0.1), (64, 16));
        assert_eq!(shrunk((9, 300), 0.1), (9, 300));
    }
}
