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
use super::rasterize::{
    DEPTH, DepthPlane, Plane, TRANSMITTANCE, TileCanvas, TilePlace, ZERO_PLANE, set_row_of_plane,
};
use super::rasterize_bwd::{BY_DEPTH, TileGradient};
use super::simd::{SIGN, WIDTH};
use super::tiles::{Grid, TILE};
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
    /// True if the channel has squares.
    pub(super) has_squares: bool,
    /// The sign bit if ρ is the absolute value, 0 if it is the identity.
    pub(super) sign_bit: u32,
}

impl DepthChannel {
    /// Depth itself.
    pub(super) const DEPTH: Self = Self { is_inverse: false, has_squares: false, sign_bit: 0 };

    pub(super) fn of_loss(loss: &DepthLoss<'_>) -> Self {
        let sign_bit = match loss.term {
            DepthTerm::Expected => 0,
            DepthTerm::Samples => SIGN,
        };
        Self { is_inverse: true, has_squares: loss.distortion > 0.0, sign_bit }
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

    /// Scalar loops, which the compiler vectorises for the dispatched instruction set.
    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) -> f64 {
        let Self { grid, first, loss, canvas, gradient } = self;
        let mut total = 0.0;
        for (number, (canvas, gradient)) in (first..).zip(canvas.iter_mut().zip(gradient)) {
            let given = GivenTile::new(&loss, &TilePlace::new(grid, number));
            let mut values = [0.0; WIDTH];
            for (p, by_depth) in gradient.planes[BY_DEPTH].iter_mut().enumerate() {
                for lane in 0..WIDTH {
                    let [inverse, confidence] = [given.inverse[p][lane], given.confidence[p][lane]];
                    let transmittance = canvas.planes[TRANSMITTANCE][p][lane];
                    let sum = canvas.planes[DEPTH][p][lane];
                    let mask = given.mask[p][lane];
                    let found = loss.at_pixel([inverse, confidence, mask], transmittance, sum);
                    values[lane] += found.value;
                    by_depth[lane] = found.by_depth;
                    canvas.planes[CENTRE][p][lane] = found.centre;
                    canvas.planes[SQUARE][p][lane] = found.square;
                    canvas.planes[BY_ALPHA][p][lane] = found.by_alpha;
                }
            }
            total += values.iter().map(|&value| f64::from(value)).sum::<f64>();
        }
        total
    }
}

/// The given depth in a tile's pixels; 0 outside the image.
pub(super) struct GivenTile {
    /// The given inverse depth; 0 where none is given `[1/scene units]`.
    pub(super) inverse: Plane,
    /// Confidence times mask.
    confidence: Plane,
    mask: Plane,
}

impl GivenTile {
    #[inline(always)]
    pub(super) fn new(loss: &DepthLoss<'_>, place: &TilePlace) -> Self {
        let mut given = Self { inverse: ZERO_PLANE, confidence: ZERO_PLANE, mask: ZERO_PLANE };
        for y in 0..place.height {
            let first = (place.y as usize + y) * loss.width + place.x as usize;
            let [mut inverse, mut confidence, mut mask] = [[0.0; TILE]; 3];
            for x in 0..place.width {
                [inverse[x], confidence[x], mask[x]] = loss.given(first + x);
            }
            set_row_of_plane(&mut given.inverse, y, &inverse);
            set_row_of_plane(&mut given.confidence, y, &confidence);
            set_row_of_plane(&mut given.mask, y, &mask);
        }
        given
    }
}
