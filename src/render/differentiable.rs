//! Gradients and losses on their own: tools for tests and for research, not part of training.

use super::cpu::ModelGradient;
use super::{Backend, BackendError, Rendering, StepOutput};
use densify_core::camera::Camera;
use densify_core::image::Image8;

/// dL/dpixel of an image.
#[derive(Debug, Clone, PartialEq)]
pub struct ImageGradient {
    /// Shape: `[height, width, 3]`.
    pub rgb: Vec<f32>,
    /// Shape: `[height, width]`.
    pub alpha: Vec<f32>,
    /// Shape: `[height, width]`.
    pub depth: Vec<f32>,
}

impl ImageGradient {
    /// Panics unless it is of a camera's image.
    pub(super) fn assert_size(&self, camera: &Camera) {
        let pixels = camera.width as usize * camera.height as usize;
        assert_eq!(self.rgb.len(), 3 * pixels, "upstream.rgb");
        assert_eq!(self.alpha.len(), pixels, "upstream.alpha");
        assert_eq!(self.depth.len(), pixels, "upstream.depth");
    }
}

/// A backend with gradients and losses on their own.
pub trait Differentiable: Backend {
    /// Renders a view and differentiates Σ rgb·upstream.rgb + Σ alpha·upstream.alpha +
    /// Σ depth·upstream.depth with respect to every parameter. Changes nothing of the model.
    ///
    /// Needs every field of a record, so that it allocates more than the ledger says where the
    /// policy's needs are smaller.
    ///
    /// # Errors
    /// See [`BackendError`].
    ///
    /// # Panics
    /// When `upstream` does not have the image's size.
    fn differentiate(
        &mut self,
        camera: &Camera,
        background: [f32; 3],
        sh_degree: u8,
        upstream: &ImageGradient,
    ) -> Result<(Rendering, ModelGradient), BackendError>;

    /// The training loss of a rendering against a target and its gradient by the rendering's
    /// pixels. Shape of the gradient: `[height, width, 3]`.
    ///
    /// # Errors
    /// See [`BackendError`].
    ///
    /// # Panics
    /// When rendering and target differ in size.
    fn loss(
        &mut self,
        rendering: &Rendering,
        target: &Image8,
        background: [f32; 3],
    ) -> Result<(StepOutput, Vec<f32>), BackendError>;
}
