//! Renderings for people who inspect a model. Training needs none of them.

use densify_core::camera::Camera;

use super::{BackendError, Rendering};

/// Renders properties of the rows instead of their colours.
pub trait Inspect {
    /// Renders a view with the given colours instead of the rows' own: sRGB-encoded, >= 0, the same from every
    /// direction. The model is unchanged.
    ///
    /// # Errors
    /// See [`BackendError`].
    ///
    /// # Panics
    /// When there is not one colour per row: a bug in the caller.
    fn render_painted(
        &mut self,
        camera: &Camera,
        background: [f32; 3],
        colours: &[[f32; 3]],
    ) -> Result<Rendering, BackendError>;

    /// Returns whether the backend supports [`render_counts`](Self::render_counts).
    fn counts_rows(&self) -> bool {
        false
    }

    /// Renders a view whose depth plane holds the number of rows blended into each pixel.
    ///
    /// # Errors
    /// [`BackendError::Unsupported`] unless the backend [counts rows](Self::counts_rows).
    fn render_counts(&mut self, _camera: &Camera) -> Result<Rendering, BackendError> {
        Err(BackendError::Unsupported("counting the Gaussians per pixel"))
    }
}
