//! The surface that the model shows in a view: median depth, and the spread of depths along each ray.
//!
//! Blending is [replayed](super::replay). The results replace two of the canvas's colours, which nobody reads any more.

use std::sync::atomic::AtomicU64;

use pulp::{Simd, WithSimd};
use rayon::prelude::*;

use super::batch::{BATCH, Batch};
use super::passes::{Frame, for_each_pixel};
use super::project::Splat;
use super::rasterize::{
    Blending, DEPTH, DepthPlane, PATCHES, TRANSMITTANCE, TileCanvas, TilePlace, ZERO_PLANE,
};
use super::replay::{Blended, blend, is_finished};
use super::simd::{V, WIDTH};
use super::tiles::Visible;
use super::{BackendError, CpuBackend};
use crate::inspect::SurfaceDepths;
use densify_core::camera::Camera;

/// Planes of the canvas that hold the results: median depth, 0 where there is none, and Σ α·T·z².
pub(super) const MEDIAN: usize = 0;
const SQUARES: usize = 1;

impl CpuBackend {
    /// Renders the depths of a view.
    pub(super) fn depths_of_view(
        &mut self,
        camera: &Camera,
    ) -> Result<SurfaceDepths, BackendError> {
        // Stage times remain those of training.
        let clock = std::mem::take(&mut self.clock);
        let frame = self.forward(camera, [0.0; 3], 0, DepthPlane::Depth, None);
        self.clock = clock;
        let frame = frame?;
        self.replay_depths(&frame);
        let grid = &frame.grid;
        let pixels = grid.width * grid.height;
        let mut depths = SurfaceDepths {
            width: grid.width as u32,
            height: grid.height as u32,
            alpha: vec![0.0; pixels],
            expected: vec![0.0; pixels],
            median: vec![0.0; pixels],
            spread: vec![0.0; pixels],
        };
        for (tile, canvas) in self.canvas[..grid.tiles()].iter().enumerate() {
            for_each_pixel(grid, tile, |patch, lane, at| {
                let value = |plane: usize| canvas.planes[plane][patch][lane];
                let alpha = 1.0 - value(TRANSMITTANCE);
                depths.alpha[at] = alpha;
                depths.median[at] = value(MEDIAN);
                if alpha > 0.0 {
                    let expected = value(DEPTH) / alpha;
                    depths.expected[at] = expected;
                    let variance = value(SQUARES) / alpha - expected * expected;
                    depths.spread[at] = variance.max(0.0).sqrt();
                }
            });
        }
        Ok(depths)
    }

    /// Replaces the first two colours of the canvas by [`MEDIAN`] and [`SQUARES`].
    pub(super) fn replay_depths(&mut self, frame: &Frame) {
        let Frame { grid, bands, .. } = frame;
        let blending = self.shortcuts.into();
        let Self { threads, arch, lists, splats, visible, canvas, rows, .. } = self;
        let rows = *rows;
        threads.install(|| {
            let visible = &visible[..rows.div_ceil(WIDTH)];
            for band in bands {
                if bands.len() > 1 {
                    let visible = Visible { splats: &splats[..rows], seen: visible };
                    lists.refill(threads, visible, grid, band);
                }
                let tiles = canvas[band.clone()].par_iter_mut().enumerate();
                threads.each_with("replay", tiles, Batch::new, |batch, (i, canvas)| {
                    let place = TilePlace::new(grid, band.start + i);
                    let list = lists.of_tile(i);
                    arch.dispatch(Depths { splats, list, place, blending, canvas, batch });
                });
            }
        });
    }
}

/// Replays the blending of one tile for median depth and the sum of squared depths.
struct Depths<'a> {
    splats: &'a [Splat],
    /// The tile's entries, sorted front to back.
    list: &'a [AtomicU64],
    place: TilePlace,
    /// The settings of the forward pass.
    blending: Blending,
    canvas: &'a mut TileCanvas,
    /// Scratch.
    batch: &'a mut Batch,
}

impl WithSimd for Depths<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, s: S) {
        let Self { splats, list, place, blending, canvas, batch } = self;
        let c = |x: f32| V::splat(s, x);
        let half = c(0.5);
        let [median, squares, ..] = &mut canvas.planes;
        (*median, *squares) = (ZERO_PLANE, ZERO_PLANE);
        let (mut transmittance, mut unfinished) = place.inside();
        for chunk in list.chunks(BATCH) {
            if unfinished == 0 {
                break;
            }
            batch.set(s, splats, chunk, &place);
            for i in 0..chunk.len().min(BATCH) {
                let splat = &batch.splats[i];
                let (depth, square) = (c(splat.depth), c(splat.depth * splat.depth));
                let mut todo = batch.patches_of[i] & unfinished;
                while todo != 0 {
                    let p = todo.trailing_zeros() as usize % PATCHES;
                    todo &= todo - 1;
                    for at in (0..WIDTH).step_by(S::F32_LANES) {
                        let Blended { blends, weight, before, after } =
                            blend(s, batch, blending, [i, p, at], &mut transmittance[p]);
                        let sum = V::load(s, &squares[p][at..]);
                        weight.mul_add(square, sum).store(&mut squares[p][at..]);
                        // Here half of the light is gone.
                        let crosses = blends.and(half.le(before)).and(after.lt(half));
                        let so_far = V::load(s, &median[p][at..]);
                        crosses.select(depth, so_far).store(&mut median[p][at..]);
                    }
                    if is_finished(&transmittance[p]) {
                        unfinished &= !(1 << p);
                    }
                }
            }
        }
    }
}

#[cfg(test)]
#[allow(clippy::float_cmp, reason = "exact values")]
mod tests;
