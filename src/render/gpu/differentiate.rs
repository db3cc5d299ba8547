//! Gradients and losses without a training step: tools for tests and research.

use super::GpuBackend;
use super::frame::{Frame, State, grid};
use super::rows::{DEPTH, SPLAT};
use glam::Vec3;

use crate::cpu::{EXPONENT_SCALE, ModelGradient};
use crate::signals::{Field, RecordLayout};
use crate::{BackendError, Differentiable, ImageGradient, Rendering, StepOutput};
use densify_core::camera::Camera;
use densify_core::gaussians::{ModelArray, sh_coefficients};
use densify_core::image::Image8;
use densify_core::sh;

/// The records of which gradients are read.
const LAYOUT: RecordLayout = RecordLayout::DIFFERENTIATED;
const STRIDE: usize = LAYOUT.stride();

impl GpuBackend {
    /// Reads the gradients that stages 5 and 6 have left; see `shaders/shared/record.wgsl`.
    fn model_gradient(&self, frame: &Frame) -> Result<ModelGradient, BackendError> {
        let (n, degree) = (self.rows as u64, frame.model[1] as u8);
        let gradient = self.read("splats", 0, (4 * SPLAT) as u64 * n)?;
        let sums = self.read("row sums", 0, 4 * STRIDE as u64 * n)?;
        let means = ModelArray::Means.parameters(self.sizes.sh_degree);
        let means = self.parameters_of(&means, 0..self.rows)?;
        let planes = 3 * sh_coefficients(self.sizes.sh_degree);
        let mut out = ModelGradient { sh: vec![0.0; planes * self.rows], ..Default::default() };
        let rows = gradient.as_chunks::<SPLAT>().0.iter().zip(means.as_chunks::<3>().0);
        for (row, ((g, mean), sums)) in rows.zip(sums.as_chunks::<STRIDE>().0).enumerate() {
            let seen = g[DEPTH] > 0.0;
            let sums = if seen { *sums } else { [0.0; STRIDE] };
            let [quat_z, logit, x, y, unclamped, l1, ..] = sums;
            let unscale = 1.0 / EXPONENT_SCALE;
            out.means.push([g[0], g[1], g[2]]);
            out.log_scales.push([g[3], g[4], g[5]]);
            out.quats.push([g[6], g[7], g[8], quat_z]);
            out.opacity_logits.push(logit);
            out.mean2d.push([x, y]);
            let sum = |field| LAYOUT.at(field).map_or(0.0, |at| sums[at]);
            out.mean2d_abs.push([
                l1 * unscale * unscale * sum(Field::AbsX),
                unscale * unscale * sum(Field::AbsY),
            ]);
            out.colour.push([sums[6], sums[7], sums[8]]);
            out.max_weight.push(sum(Field::WeightMax));
            out.sum_weight.push(sum(Field::WeightSum));
            out.pixel_count.push(sum(Field::PixelCount) as u32);
            out.visible.push(seen);
            let mut y = [0.0_f32; 16];
            y[0] = sh::C0;
            let [cx, cy, cz, _] = frame.centre;
            let towards = Vec3::from(*mean) - Vec3::new(cx, cy, cz);
            sh::basis(degree, towards.normalize_or_zero().into(), &mut y);
            for (k, basis) in y.iter().enumerate().take(sh_coefficients(degree)) {
                for channel in (0..3).filter(|channel| unclamped as u32 >> channel & 1 == 1) {
                    out.sh[row * planes + 3 * k + channel] = basis * sums[6 + channel];
                }
            }
        }
        Ok(out)
    }
}

impl Differentiable for GpuBackend {
    fn differentiate(
        &mut self,
        camera: &Camera,
        background: [f32; 3],
        sh_degree: u8,
        upstream: &ImageGradient,
    ) -> Result<(Rendering, ModelGradient), BackendError> {
        upstream.assert_size(camera);
        assert_eq!(self.sizes.budget.frozen, 0, "frozen rows have no gradients");
        if !self.sizes.alpha_and_depth {
            (self.sizes.alpha_and_depth, self.sizes.records) = (true, LAYOUT);
            self.rebuild()?;
        }
        self.fit_image(camera.width, camera.height)?;
        let pixels =
            upstream.rgb.as_chunks::<3>().0.iter().zip(&upstream.alpha).zip(&upstream.depth);
        let gradient = pixels.map(|((&[r, g, b], &a), &z)| [r, g, b, z, a, 0.0, 0.0, 0.0]);
        self.write("pixel gradient", bytemuck::cast_slice(&gradient.collect::<Vec<_>>()));
        let frame = self.frame(camera, background, sh_degree);
        self.run(&frame, |passes, to| {
            passes.forward(to);
            passes.backward(to);
            passes.differentiate(to, false);
        })?;
        let rendering = self.rendering(camera.width, camera.height, false)?;
        Ok((rendering, self.model_gradient(&frame)?))
    }

    fn loss(
        &mut self,
        rendering: &Rendering,
        target: &Image8,
        background: [f32; 3],
    ) -> Result<(StepOutput, Vec<f32>), BackendError> {
        let (width, height) = (rendering.width, rendering.height);
        assert_eq!((width, height), (target.width, target.height), "sizes differ");
        self.fit_image(width, height)?;
        let pixels = rendering.rgb.as_chunks::<3>().0;
        let canvas: Vec<[f32; 4]> = pixels.iter().map(|&[r, g, b]| [r, g, b, 0.0]).collect();
        self.write("canvas", bytemuck::cast_slice(&canvas));
        let [columns, tiles] = grid(width, height);
        let [r, g, b] = background;
        let frame = Frame {
            background: [r, g, b, 0.0],
            image: [width, height, columns, tiles],
            draw: [0, 0, 0, self.upload_target(target)],
            ..bytemuck::Zeroable::zeroed()
        };
        // Without a forward pass nothing resets the state, and that of the last view could report too few bands.
        self.write("state", bytemuck::bytes_of(&<State as bytemuck::Zeroable>::zeroed()));
        let (state, _) = self.run(&frame, |passes, to| passes.loss(to, false, true))?;
        let gradient = self.read("canvas", 0, 16 * pixels.len() as u64)?;
        let gradient = gradient.as_chunks::<4>().0.iter().flat_map(|[r, g, b, _]| [*r, *g, *b]);
        Ok((state.output(), gradient.collect()))
    }
}
