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
use super::depth_channel::{BY_ALPHA, CENTRE, DepthChannel, SQUARE};
use super::passes::Frame;
use super::rasterize::{
    DEPTH, DepthPlane, Plane, TRANSMITTANCE, TileCanvas, TilePlace, ZERO_PLANE, set_row_of_plane,
};
use super::rasterize_bwd::{BY_DEPTH, TileGradient};
use super::simd::WIDTH;
use super::tiles::{Grid, TILE};
use crate::StepInput;
use crate::depth::{DepthLoss, DepthTerm, confidence_in};
use crate::signals::{Field, RecordLayout};

/// Pixels per task when confidences are added up.
const PIXELS_PER_TASK: usize = 1 << 16;

impl CpuBackend {
    /// The depth in the loss of a step, if there is any, and what the forward pass must accumulate for it.
    pub(super) fn depth_loss<'a>(
        &self,
        input: &StepInput<'a>,
    ) -> (Option<DepthLoss<'a>>, DepthPlane<'a>) {
        let is_set_up = self.signals.layout().has(Field::Depth);
        let loss = DepthLoss::new(input, self.near, is_set_up, |map, mask| {
            let pixels = map.inverse.len();
            let tasks = (0..pixels.div_ceil(PIXELS_PER_TASK)).into_par_iter();
            self.threads.sum("confidences", tasks, |task| {
                let first = task * PIXELS_PER_TASK;
                confidence_in(map, mask, first..pixels.min(first + PIXELS_PER_TASK))
            })
        });
        let plane = loss.map_or(DepthPlane::Unused, |loss| match loss.term {
            DepthTerm::Expected => DepthPlane::Inverse,
            DepthTerm::Samples => DepthPlane::Distance(loss),
        });
        (loss, plane)
    }

    /// Stage 5 of a step, with or without depth in the loss: returns the layout of the records, and the value of the
    /// depth term, without its weight, if depth is given.
    pub(super) fn backward_with_depth(
        &mut self,
        frame: &Frame,
        loss: Option<DepthLoss<'_>>,
    ) -> (RecordLayout, Option<f32>) {
        let layout = self.signals.layout();
        let Some(loss) = loss else {
            self.backward(frame, layout.without_depth(), DepthChannel::DEPTH);
            return (layout.without_depth(), None);
        };
        let value = self.depth_gradient(&frame.grid, loss);
        self.backward(frame, layout, DepthChannel::of_loss(&loss));
        (layout, value)
    }

    /// Writes the channel of the backward pass, and returns the value of the depth term, without its weight, if depth
    /// is given.
    fn depth_gradient(&mut self, grid: &Grid, loss: DepthLoss<'_>) -> Option<f32> {
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
