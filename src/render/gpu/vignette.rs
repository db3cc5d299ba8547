//! A photograph's vignette on the device; see `shaders/vignette.wgsl`. It dims the exposed image, so that a photograph
//! with a vignette and no exposure has the exposure that changes nothing.

use super::GpuBackend;
use super::frame::Frame;
use densify_core::colour::ColourTransform;
use densify_core::vignette::{COEFFICIENTS, Vignette};

/// Bytes of the coefficients, and of the place of the view's pixels.
pub(super) const PARAMETERS: u64 = 2 * 16;
/// Bytes of the sums of a workgroup, or of the image.
pub(super) const SUMS: u64 = 16;

impl GpuBackend {
    /// Uploads the exposure and the vignette of the current view, if any, and sets the flag of images that differ from
    /// the canvas. Returns that flag.
    pub(super) fn load_camera(
        &self,
        frame: &mut Frame,
        exposure: Option<&ColourTransform>,
        vignette: Option<&Vignette>,
    ) -> bool {
        let exposure = exposure.or(vignette.map(|_| &ColourTransform::IDENTITY));
        self.load_exposure(frame, exposure);
        if let Some(Vignette { coefficients: [a, b, c], place }) = vignette {
            assert!(self.sizes.vignettes, "the backend was not made for vignettes");
            let ([x, y], [width, height]) = (place.middle, place.pixel);
            let numbers = [[*a, *b, *c, 0.0], [x, y, width, height]];
            self.write("vignette", bytemuck::cast_slice(&numbers));
        }
        exposure.is_some()
    }

    /// Derivatives of the loss with respect to the coefficients, from the sums of the last step.
    pub(super) fn vignette_gradient(&self) -> [f32; COEFFICIENTS] {
        let [a, b, c, _] = self.vignette_sums;
        [a, b, c]
    }
}
