//! Gradients and losses outside of training; see [`Differentiable`].

use super::depth_channel::{BY_ALPHA, CENTRE, DepthChannel, SQUARE};
use super::loss::ErrorRequests;
use super::optimise::Differentiate;
use super::rasterize::{DepthPlane, ZERO_PLANE};
use super::rasterize_bwd::BY_DEPTH;
use super::tiles::Grid;
use super::{CpuBackend, ModelGradient, for_each_pixel, scalars};
use crate::signals::RecordLayout;
use crate::{BackendError, Differentiable, ImageGradient, Rendering, StepOutput};
use densify_core::camera::Camera;
use densify_core::image::Image8;

impl Differentiable for CpuBackend {
    fn differentiate(
        &mut self,
        camera: &Camera,
        background: [f32; 3],
        sh_degree: u8,
        upstream: &ImageGradient,
    ) -> Result<(Rendering, ModelGradient), BackendError> {
        upstream.assert_size(camera);
        let records = self.record_cap * RecordLayout::DIFFERENTIATED.stride();
        if self.records.len() < records {
            self.records = bytemuck::zeroed_vec(records);
        }
        let frame = self.forward(camera, background, sh_degree, DepthPlane::Depth, None)?;
        let rendering = self.rendering(&frame);
        let tiles = self.gradient[..frame.grid.tiles()].iter_mut().zip(&mut self.canvas);
        for (tile, (gradient, canvas)) in tiles.enumerate() {
            gradient.planes = [ZERO_PLANE; 5];
            for plane in [CENTRE, SQUARE, BY_ALPHA] {
                canvas.planes[plane] = ZERO_PLANE;
            }
            for_each_pixel(&frame.grid, tile, |patch, lane, at| {
                for channel in 0..3 {
                    gradient.planes[channel][patch][lane] = upstream.rgb[3 * at + channel];
                }
                gradient.planes[BY_DEPTH][patch][lane] = upstream.depth[at];
                canvas.planes[BY_ALPHA][patch][lane] = upstream.alpha[at];
            });
        }
        self.backward(&frame, RecordLayout::DIFFERENTIATED, DepthChannel::DEPTH);
        let mut gradient = ModelGradient::zeros(self.rows, self.sh_degree);
        self.arch.dispatch(Differentiate {
            params: self.params.view(self.rows),
            sums: &self.sums,
            visible: &self.visible,
            view: &frame.view,
            out: &mut gradient,
        });
        Ok((rendering, gradient))
    }

    fn loss(
        &mut self,
        rendering: &Rendering,
        target: &Image8,
        background: [f32; 3],
    ) -> Result<(StepOutput, Vec<f32>), BackendError> {
        let grid = Grid::new(rendering.width, rendering.height);
        assert_eq!(
            grid,
            Grid::new(target.width, target.height),
            "rendering and target differ in size"
        );
        self.resize_images(&grid);
        for (tile, canvas) in self.canvas[..grid.tiles()].iter_mut().enumerate() {
            for_each_pixel(&grid, tile, |patch, lane, at| {
                for channel in 0..3 {
                    canvas.planes[channel][patch][lane] = rendering.rgb[3 * at + channel];
                }
            });
        }
        let value = self.image_loss(&grid, target, background, ErrorRequests::default());
        let mut gradient = vec![0.0; rendering.rgb.len()];
        for (tile, from) in self.gradient[..grid.tiles()].iter().enumerate() {
            for_each_pixel(&grid, tile, |patch, lane, at| {
                for channel in 0..3 {
                    gradient[3 * at + channel] = from.planes[channel][patch][lane];
                }
            });
        }
        Ok((scalars(value), gradient))
    }
}
