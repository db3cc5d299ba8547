//! Gradients and losses outside of training, for tests and research.

use super::cpu::ModelGradient;
use super::{Backend, BackendError, Rendering, StepOutput};
use densify_core::camera::Camera;
use densify_core::image::Image8;

/// The gradient of a loss with respect to an image.
#[derive(Debug, Clone, PartialEq)]
pub struct ImageGradient {
    /// Gradient with respect to colour. Shape: `[height, width, 3]`.
    pub rgb: Vec<f32>,
    /// Gradient with respect to alpha. Shape: `[height, width]`.
    pub alpha: Vec<f32>,
    /// Gradient with respect to depth. Shape: `[height, width]`.
    pub depth: Vec<f32>,
}

impl ImageGradient {
    /// Panics unless the gradient has the size of the camera's image.
    pub(super) fn assert_size(&self, camera: &Camera) {
        let pixels = camera.width as usize * camera.height as usize;
        assert_eq!(self.rgb.len(), 3 * pixels, "upstream.rgb");
        assert_eq!(self.alpha.len(), pixels, "upstream.alpha");
        assert_eq!(self.depth.len(), pixels, "upstream.depth");
    }
}

/// A backend that computes gradients and losses outside of training.
pub trait Differentiable: Backend {
    /// Renders a view and differentiates Σ rgb·upstream.rgb + Σ alpha·upstream.alpha +
    /// Σ depth·upstream.depth with respect to every parameter. The model is unchanged.
    ///
    /// Uses every field of the gradient records, so it may allocate more than the ledger lists.
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

    /// The training loss of a rendering against a target, and its gradient with respect to the rendering's
    /// colours. Shape of the gradient: `[height, width, 3]`.
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
