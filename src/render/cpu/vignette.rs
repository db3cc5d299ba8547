//! The vignette of the current photograph. After the [exposure](super::exposure), the rendered colours are dimmed;
//! after stage 4 the gradient is backpropagated to the colours before, and the gradient with respect to the
//! coefficients is summed up. Steps without a vignette skip both passes.
//!
//! A task processes a row of tiles and returns its own sums, which are added in order.

use pulp::{Simd, WithSimd};
use rayon::prelude::*;

use super::CpuBackend;
use super::rasterize::{PATCH, PATCHES, Plane, TileCanvas, TilePlace};
use super::rasterize_bwd::TileGradient;
use super::simd::WIDTH;
use super::tiles::{Grid, TILE};
use densify_core::image::Image8;
use densify_core::vignette::{COEFFICIENTS, CURVE_OFFSET, Dimming, Vignette, dimmed, undimmed};

impl CpuBackend {
    /// Dims the rendered image as the photograph's vignette does.
    pub(super) fn dim(&mut self, grid: &Grid, vignette: &Vignette, target: &Image8) {
        let Self { threads, arch, canvas, clock, .. } = self;
        let strips = canvas[..grid.tiles()].par_chunks_mut(grid.columns).enumerate();
        threads.install(|| {
            threads.each("vignette", strips, |(strip, tiles)| {
                let first = strip * grid.columns;
                arch.dispatch(Dim { grid, first, vignette, target, tiles });
            });
        });
        clock.lap("vignette");
    }

    /// Backpropagates the gradient of the loss to the colours before the vignette, which it restores in the canvas, and
    /// returns the gradient with respect to the coefficients.
    pub(super) fn dim_bwd(
        &mut self,
        grid: &Grid,
        vignette: &Vignette,
        target: &Image8,
    ) -> [f32; COEFFICIENTS] {
        let Self { threads, arch, canvas, gradient, clock, .. } = self;
        let tasks = (
            canvas[..grid.tiles()].par_chunks_mut(grid.columns),
            gradient[..grid.tiles()].par_chunks_mut(grid.columns),
        );
        let tasks = tasks.into_par_iter().enumerate();
        let parts = threads.install(|| {
            threads.collect("vignette_bwd", tasks, |(strip, (tiles, gradient))| {
                let first = strip * grid.columns;
                arch.dispatch(DimBwd { grid, first, vignette, target, tiles, gradient })
            })
        });
        clock.lap("vignette");
        let mut total = [0.0_f64; COEFFICIENTS];
        for part in parts {
            for (total, part) in total.iter_mut().zip(part) {
                *total += part;
            }
        }
        total.map(|sum| sum as f32)
    }
}

/// The photograph's alpha in a tile; 1 if it has none, or outside the image.
#[inline(always)]
fn alpha_of(target: &Image8, place: &TilePlace) -> Plane {
    let mut plane = [[1.0; WIDTH]; PATCHES];
    if let Some(alpha) = &target.alpha {
        place.for_each_pixel(target.width as usize, |patch, lane, at| {
            plane[patch][lane] = f32::from(alpha[at]) * (1.0 / 255.0);
        });
    }
    plane
}

/// What a vignette does to the pixel of a patch and lane.
#[inline(always)]
fn dimming(
    vignette: &Vignette,
    place: &TilePlace,
    patch: usize,
    lane: usize,
    alpha: f32,
) -> Dimming {
    const ACROSS: usize = TILE / PATCH;
    let x = patch % ACROSS * PATCH + lane % PATCH;
    let y = patch / ACROSS * PATCH + lane / PATCH;
    vignette.at(place.x + x as f32, place.y + y as f32, alpha)
}

/// Dims the pixels of a row of tiles.
struct Dim<'a> {
    grid: &'a Grid,
    /// The number of the first tile.
    first: usize,
    vignette: &'a Vignette,
    target: &'a Image8,
    tiles: &'a mut [TileCanvas],
}

impl WithSimd for Dim<'_> {
    type Output = ();

    /// Scalar loops, which the compiler vectorises for the dispatched instruction set.
    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        let Self { grid, first, vignette, target, tiles } = self;
        for (number, tile) in (first..).zip(tiles) {
            let place = TilePlace::new(grid, number);
            let alpha = alpha_of(target, &place);
            for (p, alpha) in alpha.iter().enumerate() {
                for (lane, alpha) in alpha.iter().enumerate() {
                    let Dimming { factor, .. } = dimming(vignette, &place, p, lane, *alpha);
                    for c in 0..3 {
                        let colour = &mut tile.planes[c][p][lane];
                        *colour = dimmed(factor, *colour);
                    }
                }
            }
        }
    }
}

/// Differentiates the vignette in the pixels of a row of tiles.
struct DimBwd<'a> {
    grid: &'a Grid,
    /// The number of the first tile.
    first: usize,
    vignette: &'a Vignette,
    target: &'a Image8,
    /// The dimmed image.
    tiles: &'a mut [TileCanvas],
    gradient: &'a mut [TileGradient],
}

impl WithSimd for DimBwd<'_> {
    type Output = [f64; COEFFICIENTS];

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) -> [f64; COEFFICIENTS] {
        let Self { grid, first, vignette, target, tiles, gradient } = self;
        let mut total = [0.0_f64; COEFFICIENTS];
        for (number, (tile, gradient)) in (first..).zip(tiles.iter_mut().zip(gradient)) {
            let place = TilePlace::new(grid, number);
            let alpha = alpha_of(target, &place);
            // Lanes outside the image may hold an arbitrary gradient.
            let (inside, _) = place.inside();
            let mut sums = [[0.0_f32; WIDTH]; COEFFICIENTS];
            for (p, inside) in inside.iter().enumerate() {
                for lane in 0..WIDTH {
                    let Dimming { factor, slope, squared_radius } =
                        dimming(vignette, &place, p, lane, alpha[p][lane]);
                    let mut by_factor = 0.0;
                    for c in 0..3 {
                        let colour = &mut tile.planes[c][p][lane];
                        let g = gradient.planes[c][p][lane] * inside[lane];
                        *colour = undimmed(factor, *colour);
                        by_factor += g * (*colour + CURVE_OFFSET);
                        gradient.planes[c][p][lane] = g * factor;
                    }
                    let mut power = by_factor * slope;
                    for sums in &mut sums {
                        power *= squared_radius;
                        sums[lane] += power;
                    }
                }
            }
            for (total, lanes) in total.iter_mut().zip(sums) {
                *total += lanes.iter().map(|&x| f64::from(x)).sum::<f64>();
            }
        }
        total
    }
}
