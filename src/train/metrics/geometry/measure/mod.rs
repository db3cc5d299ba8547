//! Measures a model against the surface, with weights and visibility from the training views.

mod centres;
mod mesh;
mod pixels;
mod rows;
mod visibility;

use densify_scenegen::GBuffer;

use super::{
    CentreErrors, DepthErrors, Floaters, Geometry, KnownScene, Redundancy, ThinRecall, needs,
};
use crate::metrics::EvaluateError;
use densify_core::camera::Camera;
use densify_data::views::ViewSource;
use densify_render::Backend;
pub use mesh::{MeshErrors, measure_mesh};
use pixels::Pixels;
use rows::Rows;
use visibility::Visibility;

/// Measures the model in `backend`, which was created with [`needs`]: weights and visibility in the training views;
/// depth, normals and thin structures in `views`.
///
/// # Errors
/// When a view cannot be read or rendered, and when the caller stops.
pub fn measure(
    backend: &mut dyn Backend,
    scene: &KnownScene<'_>,
    train: &impl ViewSource,
    views: &impl ViewSource,
) -> Result<Geometry, EvaluateError> {
    let rows = Rows::new(&backend.download()?, scene);
    let visibility = Visibility::measure(backend, scene, &rows, train)?;
    let mut pixels = Pixels::new(&rows, scene)?;
    for view in 0..views.count() {
        pixels.add(backend, views, view)?;
    }
    Ok(Geometry {
        depth: pixels.depth(),
        normal_error: pixels.normal_error(),
        centres: centres::errors(&rows, &visibility, scene)?,
        floaters: visibility.floaters(&rows, scene.diagonal()),
        weight_before_surface: visibility.before_surface(),
        thin: pixels.thin(),
        redundancy: visibility.redundancy(),
    })
}

impl KnownScene<'_> {
    /// Diagonal of the mesh's bounding box `[world units]`.
    fn diagonal(&self) -> f64 {
        self.truth.surface().diagonal()
    }

    /// A view's camera in world coordinates, for projection and for ray casting.
    fn cameras(&self, camera: &Camera) -> (Camera, densify_scenegen::Camera) {
        let world = self.normalisation.world_from_scene_camera(camera);
        let ray_camera = densify_scenegen::Camera {
            width: world.width,
            height: world.height,
            fx: world.fx,
            fy: world.fy,
            cx: world.cx,
            cy: world.cy,
            world_from_camera: world.rotation.transpose(),
            centre: world.centre(),
            lens: None,
        };
        (world, ray_camera)
    }

    /// Depth and normals of the surface in a view. Called once per view; returns an error if the caller asks to stop.
    fn g_buffer(
        &self,
        name: &str,
        ray_camera: &densify_scenegen::Camera,
    ) -> Result<GBuffer, EvaluateError> {
        if (self.is_stopped)() {
            return Err(EvaluateError::Stopped);
        }
        let g_buffer = self.truth.g_buffer(name, ray_camera);
        g_buffer.map_err(|e| EvaluateError::View { view: name.to_owned(), source: e.into() })
    }
}

/// `sum / count`; NaN if `count` is 0.
fn ratio(sum: f64, count: f64) -> f64 {
    // Adding 0 turns the −0 of an empty sum into 0.
    if count > 0.0 { (sum + 0.0) / count } else { f64::NAN }
}

#[cfg(test)]
#[allow(clippy::float_cmp, reason = "exact values")]
mod tests;
