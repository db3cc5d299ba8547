//! Depth in the loss, between stages 4 and 5: its value, and the channel that the backward pass differentiates.
//!
//! A pixel's blend weights w and inverse depths x enter the loss only through Σ w·e(x) with
//! e(x) = m·ρ(x − c) + n·(x − c)² + a, where ρ is the identity or the absolute value. This is exact for all terms:
//!
//! | term | c | m; ρ | n | a |
//! |---|---|---|---|---|
//! | expected | X | λκD/K·sgn(X − X*)/A; identity | 0 | 0 |
//! | samples | X* | λκD/K; absolute value | 0 | −λκ/K |
//! | distortion | X | 0 | λμ/(NX²) | 0 |
//!
//! λ is the term's weight, κ the pixel's confidence times its mask μ, K = Σκ, X* the given inverse depth and D the
//! median of the given depth, N the number of pixels, A = Σw and X = Σwx/A. For the first, dX = Σ((x − X)·dw + w·dx)/A.
//! For the last, the derivative with respect to X vanishes because Σw(x − X) = 0. Pixels with given depth have the
//! first or the second term, all others the third.
//!
//! The channel takes no memory of its own: it is stored in planes of the canvas that are no longer needed.

use pulp::{Simd, WithSimd};
use rayon::prelude::*;

use super::CpuBackend;
use super::rasterize::{DEPTH, DepthPlane, TRANSMITTANCE, TileCanvas, TilePlace, ZERO_PLANE};
use super::rasterize_bwd::{BY_DEPTH, TileGradient};
use super::tiles::Grid;
use crate::StepInput;
use crate::depth::{DepthLoss, DepthTerm, confidence_in};
use crate::signals::Field;

/// The planes of the canvas that hold c, n and a; m is in the plane [`BY_DEPTH`] of the gradient.
pub(super) const CENTRE: usize = DEPTH;
pub(super) const SQUARE: usize = 0;
pub(super) const BY_ALPHA: usize = 1;

/// Pixels per task when confidences are added up.
const PIXELS_PER_TASK: usize = 1 << 16;

/// How the depth channel depends on a splat's depth z.
#[derive(Debug, Clone, Copy)]
pub(super) struct DepthChannel {
    /// True if x is 1/z, false if it is z.
    is_inverse: bool,
    /// ρ(x) is x where x >= 0, and `sign`·x elsewhere.
    pub(super) sign: f32,
}

impl DepthChannel {
    /// Depth itself.
    pub(super) const DEPTH: Self = Self { is_inverse: false, sign: 1.0 };

    pub(super) const fn of_loss(term: DepthTerm) -> Self {
        let sign = match term {
            DepthTerm::Expected => 1.0,
            DepthTerm::Samples => -1.0,
        };
        Self { is_inverse: true, sign }
    }

    /// x of a splat.
    #[inline(always)]
    pub(super) fn value(self, depth: f32) -> f32 {
        if self.is_inverse { 1.0 / depth } else { depth }
    }

    /// dx/dz.
    #[inline(always)]
    pub(super) fn derivative(self, depth: f32) -> f32 {
        if self.is_inverse { -(1.0 / depth) * (1.0 / depth) } else { 1.0 }
    }
}

impl<'a> DepthPlane<'a> {
    /// What the forward pass must accumulate for a loss.
    pub(super) fn of_loss(loss: DepthLoss<'a>) -> Self {
        match loss.term {
            DepthTerm::Expected => Self::Inverse,
            DepthTerm::Samples => Self::Distance(loss),
        }
    }
}

impl CpuBackend {
    /// The depth in the loss of a step, if there is any.
    pub(super) fn depth_loss<'a>(&self, input: &StepInput<'a>) -> Option<DepthLoss<'a>> {
        let is_set_up = self.signals.layout().has(Field::Depth);
        DepthLoss::new(input, self.near, is_set_up, |map, mask| {
            let pixels = map.inverse.len();
            let tasks = (0..pixels.div_ceil(PIXELS_PER_TASK)).into_par_iter();
            self.threads.sum("confidences", tasks, |task| {
                let first = task * PIXELS_PER_TASK;
                confidence_in(map, mask, first..pixels.min(first + PIXELS_PER_TASK))
            })
        })
    }

    /// Writes the channel of the backward pass, and returns the value of the depth term, without its weight, if depth
    /// is given.
    pub(super) fn depth_gradient(&mut self, grid: &Grid, loss: DepthLoss<'_>) -> Option<f32> {
        let Self { threads, arch, canvas, gradient, clock, .. } = self;
        let tasks = (
            canvas[..grid.tiles()].par_chunks_mut(grid.columns),
            gradient[..grid.tiles()].par_chunks_mut(grid.columns),
        );
        let tasks = tasks.into_par_iter().enumerate();
        let parts = threads.collect("depth_gradient", tasks, |(strip, (canvas, gradient))| {
            let first = strip * grid.columns;
            arch.dispatch(DepthGradient { grid, first, loss, canvas, gradient })
        });
        clock.lap("depth_gradient");
        loss.map.map(|_| parts.into_iter().sum::<f64>() as f32)
    }
}

/// Differentiates depth in the pixels of a row of tiles.
struct DepthGradient<'a> {
    grid: &'a Grid,
    /// The number of the first tile.
    first: usize,
    loss: DepthLoss<'a>,
    canvas: &'a mut [TileCanvas],
    gradient: &'a mut [TileGradient],
}

impl WithSimd for DepthGradient<'_> {
    /// The value of the depth term in these pixels.
    type Output = f64;

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) -> f64 {
        let Self { grid, first, loss, canvas, gradient } = self;
        let mut total = 0.0;
        for (number, (canvas, gradient)) in (first..).zip(canvas.iter_mut().zip(gradient)) {
            let sums = std::mem::replace(&mut canvas.planes[DEPTH], ZERO_PLANE);
            let planes = &mut canvas.planes;
            (planes[SQUARE], planes[BY_ALPHA]) = (ZERO_PLANE, ZERO_PLANE);
            let by_depth = &mut gradient.planes[BY_DEPTH];
            *by_depth = ZERO_PLANE;
            TilePlace::new(grid, number).for_each_pixel(grid.width, |patch, lane, pixel| {
                let transmittance = planes[TRANSMITTANCE][patch][lane];
                let found = loss.at_pixel(pixel, transmittance, sums[patch][lane]);
                planes[CENTRE][patch][lane] = found.centre;
                planes[SQUARE][patch][lane] = found.square;
                planes[BY_ALPHA][patch][lane] = found.by_alpha;
                by_depth[patch][lane] = found.by_depth;
                total += f64::from(found.value);
            });
        }
        total
    }
}
