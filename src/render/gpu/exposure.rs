//! A photograph's exposure on the device: uploads the colour transform before a view's passes, and turns the sums that
//! a step returns into derivatives.

use super::GpuBackend;
use super::frame::{Frame, target};
use densify_core::colour::{ColourGradient, ColourTransform, ExposureSums};

/// Bytes of the transform: three rows and the background.
pub(super) const TRANSFORM: u64 = 4 * 16;
/// Bytes of the sums of a workgroup, or of the image.
pub(super) const SUMS: u64 = 4 * 16;
/// Pixels per workgroup; see `shaders/exposure.wgsl`.
const GROUP: u64 = 256;

/// Number of workgroups of an image with this number of pixels.
pub(super) fn groups(pixels: u64) -> u64 {
    pixels.div_ceil(GROUP)
}

impl GpuBackend {
    /// Uploads the exposure of the current view, if any, and sets its flag in the frame.
    pub(super) fn load_exposure(&self, frame: &mut Frame, exposure: Option<&ColourTransform>) {
        let Some(exposure) = exposure else { return };
        assert!(self.sizes.exposures, "the backend was not made for exposures");
        let [r, g, b, _] = frame.background;
        // The view is rendered over the colour that the transform turns into the background.
        let [x, y, z] = exposure.behind([r, g, b]);
        let [red, green, blue] = exposure.rows();
        self.write("exposure", bytemuck::cast_slice(&[red, green, blue, [r, g, b, 0.0]]));
        frame.background[..3].copy_from_slice(&[x, y, z]);
        frame.draw[3] |= target::EXPOSED;
    }

    /// Derivatives of the loss with respect to the exposure, from the sums of the last step.
    pub(super) fn exposure_gradient(
        &self,
        exposure: &ColourTransform,
        background: [f32; 3],
    ) -> ColourGradient {
        let [red, green, blue, behind] = self.exposure_sums.map(|sums| sums.map(f64::from));
        let rows = [red, green, blue];
        let sums = ExposureSums {
            by_colour: rows.map(|[r, g, b, _]| [r, g, b]),
            plain: rows.map(|[.., plain]| plain),
            behind: [behind[0], behind[1], behind[2]],
        };
        exposure.gradient(background, &sums)
    }
}
