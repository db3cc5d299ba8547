//! The surface that the model shows in a view: median depth, the spread of depths along each ray, and the weight that
//! each row has in front of a given surface.
//!
//! Blending is [replayed](super::replay). The first replay uses the canvas's colours, which nobody reads, for its
//! results. The second one reads the surface from the image gradient's plane for depth, which is set to 0 afterwards,
//! and writes one record per (row, tile).

use std::sync::atomic::{AtomicU32, AtomicU64, Ordering::Relaxed};

use pulp::{Simd, WithSimd};
use rayon::prelude::*;

use super::batch::{BATCH, Batch};
use super::passes::{Frame, for_each_pixel};
use super::project::Splat;
use super::rasterize::{
    Blending, DEPTH, DepthPlane, PATCHES, Plane, TRANSMITTANCE, TileCanvas, TilePlace, ZERO_PLANE,
};
use super::rasterize_bwd::BY_DEPTH;
use super::records::{Sums, TileRecords, gather_all, parts};
use super::replay::{Blended, blend, is_finished};
use super::simd::{V, WIDTH};
use super::tiles::{Entry, Visible};
use super::{BackendError, CpuBackend};
use crate::inspect::{RowWeights, SurfaceDepths};
use densify_core::camera::Camera;

/// Planes of the canvas that hold the results.
const MEDIAN: usize = 0;
const SQUARES: usize = 1;
/// Values per record: weight in front of the surface, and whole weight.
const STRIDE: usize = 2;

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
        let Frame { grid, bands, .. } = &frame?;
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

    /// Measures each row's weight in front of `surface` in a view. Shape: `[height, width]`; 0 where it is unknown.
    pub(super) fn weights_in_view(
        &mut self,
        camera: &Camera,
        surface: &[f32],
    ) -> Result<Vec<RowWeights>, BackendError> {
        let clock = std::mem::take(&mut self.clock);
        let frame = self.forward(camera, [0.0; 3], 0, DepthPlane::Unused, None);
        self.clock = clock;
        let Frame { grid, bands, .. } = &frame?;
        assert_eq!(surface.len(), grid.width * grid.height, "one depth per pixel");
        for (tile, gradient) in self.gradient[..grid.tiles()].iter_mut().enumerate() {
            gradient.planes[BY_DEPTH] = ZERO_PLANE;
            for_each_pixel(grid, tile, |patch, lane, at| {
                gradient.planes[BY_DEPTH][patch][lane] = surface[at];
            });
        }
        let blending = self.shortcuts.into();
        self.reserve_sums(self.signals.layout());
        let Self { threads, arch, lists, splats, records, sums, visible, gradient, rows, .. } =
            self;
        let rows = *rows;
        let sums = &mut sums[..rows * STRIDE];
        threads.install(|| {
            let visible = &visible[..rows.div_ceil(WIDTH)];
            for band in bands {
                if bands.len() > 1 {
                    let visible = Visible { splats: &splats[..rows], seen: visible };
                    lists.refill(threads, visible, grid, band);
                }
                let mut fresh = band.start == 0;
                for part in parts(threads, lists, band.len(), records.len() / STRIDE) {
                    threads.each_with("replay", part.tiles.clone(), Batch::new, |batch, i| {
                        let tile = band.start + i;
                        arch.dispatch(Weights {
                            splats,
                            list: lists.of_tile(i),
                            place: TilePlace::new(grid, tile),
                            blending,
                            surface: &gradient[tile].planes[BY_DEPTH],
                            records: part.records(lists, i, records, STRIDE),
                            batch,
                        });
                    });
                    let to = Sums { sums, stride: STRIDE, fresh, visible };
                    let add = |sums: &mut [f32], records: &[AtomicU32]| {
                        gather_all::<STRIDE>(sums, false, records);
                    };
                    part.gather(threads, lists, records, to, add);
                    fresh = false;
                }
            }
        });
        for gradient in &mut gradient[..grid.tiles()] {
            gradient.planes[BY_DEPTH] = ZERO_PLANE;
        }
        let is_seen = |row: usize| visible[row / WIDTH] >> (row % WIDTH) & 1 == 1;
        let weights = |row: usize| match is_seen(row) {
            true => RowWeights { in_front: sums[row * STRIDE], whole: sums[row * STRIDE + 1] },
            false => RowWeights::default(),
        };
        Ok((0..rows).map(weights).collect())
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

/// Replays the blending of one tile for the weights of its entries.
struct Weights<'a> {
    splats: &'a [Splat],
    /// The tile's entries, sorted front to back.
    list: &'a [AtomicU64],
    place: TilePlace,
    /// The settings of the forward pass.
    blending: Blending,
    surface: &'a Plane,
    /// The records of this tile's entries; only entries in the current [`Part`](super::records::Part) have one.
    records: TileRecords<'a>,
    /// Scratch.
    batch: &'a mut Batch,
}

impl WithSimd for Weights<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, s: S) {
        let Self { splats, list, place, blending, surface, records, batch } = self;
        let c = |x: f32| V::splat(s, x);
        let zero = V::zero(s);
        let (mut transmittance, mut unfinished) = place.inside();
        for (n, chunk) in list.chunks(BATCH).enumerate() {
            batch.set(s, splats, chunk, &place);
            for (i, entry) in chunk.iter().enumerate() {
                let splat = &batch.splats[i];
                let mut todo = batch.patches_of[i] & unfinished;
                let mut sums = [zero; STRIDE];
                while todo != 0 {
                    let p = todo.trailing_zeros() as usize % PATCHES;
                    todo &= todo - 1;
                    for at in (0..WIDTH).step_by(S::F32_LANES) {
                        let Blended { weight, .. } =
                            blend(s, batch, blending, [i, p, at], &mut transmittance[p]);
                        let in_front = c(splat.depth).lt(V::load(s, &surface[p][at..]));
                        sums[0] = sums[0] + in_front.keep(weight);
                        sums[1] = sums[1] + weight;
                    }
                    if is_finished(&transmittance[p]) {
                        unfinished &= !(1 << p);
                    }
                }
                let record = records.record(Entry::load(entry), n * BATCH + i);
                for (to, sum) in record.into_iter().flatten().zip(sums) {
                    to.store(sum.sum().to_bits(), Relaxed);
                }
            }
        }
    }
}

#[cfg(test)]
#[allow(clippy::float_cmp, reason = "exact values")]
mod tests;
