//! The exposure of the photograph at hand: between stages 3 and 4 the rendered colours become those of the
//! photograph, and after stage 4 the derivative by them becomes that by the rendered colours, and sums by the
//! transform itself. Nothing runs where a step has no exposure.
//!
//! Strips of tiles are the tasks. Each returns its own sums, which are added in order.

use pulp::{Simd, WithSimd};
use rayon::prelude::*;

use super::CpuBackend;
use super::rasterize::{TRANSMITTANCE, TileCanvas, TilePlace};
use super::rasterize_bwd::TileGradient;
use super::simd::WIDTH;
use super::tiles::Grid;
use densify_core::colour::{ColourGradient, ColourTransform, ExposureSums};

/// Sums of a task: nine by colour, three plain, three behind.
const SUMS: usize = 15;

impl CpuBackend {
    /// Transforms the rendered image.
    pub(super) fn expose(&mut self, grid: &Grid, exposure: &ColourTransform) {
        let Self { threads, arch, canvas, clock, .. } = self;
        let strips = canvas[..grid.tiles()].par_chunks_mut(grid.columns);
        threads.install(|| {
            threads.each("exposure", strips, |tiles| arch.dispatch(Expose { exposure, tiles }));
        });
        clock.lap("exposure");
    }

    /// Takes the derivative of the loss back to the colours before the transform, and returns that by the
    /// transform of an image over this background.
    pub(super) fn exposure_bwd(
        &mut self,
        grid: &Grid,
        exposure: &ColourTransform,
        background: [f32; 3],
    ) -> ColourGradient {
        let Self { threads, arch, canvas, gradient, clock, .. } = self;
        let tasks = (
            canvas[..grid.tiles()].par_chunks(grid.columns),
            gradient[..grid.tiles()].par_chunks_mut(grid.columns),
        );
        let tasks = tasks.into_par_iter().enumerate();
        let parts = threads.install(|| {
            threads.collect("exposure_bwd", tasks, |(strip, (canvas, gradient))| {
                let first = strip * grid.columns;
                arch.dispatch(ExposeBwd { grid, first, exposure, canvas, gradient })
            })
        });
        clock.lap("exposure");
        let mut total = [0.0; SUMS];
        for part in parts {
            for (total, part) in total.iter_mut().zip(part) {
                *total += part;
            }
        }
        let of = |from: usize| std::array::from_fn(|i| total[from + i]);
        let by_colour = [of(0), of(3), of(6)];
        let sums = ExposureSums { by_colour, plain: of(9), behind: of(12) };
        exposure.gradient(background, &sums)
    }
}

/// Transforms the pixels of some tiles.
struct Expose<'a> {
    exposure: &'a ColourTransform,
    tiles: &'a mut [TileCanvas],
}

impl WithSimd for Expose<'_> {
    type Output = ();

    /// Plain loops, which the compiler turns into vectors of the dispatched instruction set.
    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        let Self { exposure: ColourTransform { matrix, offset }, tiles } = self;
        for tile in tiles {
            let [red, green, blue, ..] = &mut tile.planes;
            let pixels = red.as_flattened_mut().iter_mut();
            let pixels = pixels.zip(green.as_flattened_mut()).zip(blue.as_flattened_mut());
            for ((r, g), b) in pixels {
                let of = |i: usize| {
                    let [x, y, z] = matrix[i];
                    x * *r + y * *g + z * *b + offset[i]
                };
                [*r, *g, *b] = [of(0), of(1), of(2)];
            }
        }
    }
}

/// Differentiates the transform in the pixels of some tiles.
struct ExposeBwd<'a> {
    grid: &'a Grid,
    /// Number of the first tile.
    first: usize,
    exposure: &'a ColourTransform,
    /// As the loss has seen it.
    canvas: &'a [TileCanvas],
    gradient: &'a mut [TileGradient],
}

impl WithSimd for ExposeBwd<'_> {
    type Output = [f64; SUMS];

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) -> [f64; SUMS] {
        let Self { grid, first, exposure, canvas, gradient } = self;
        let [from_red, from_green, from_blue] = &exposure.matrix;
        let mut total = [0.0_f64; SUMS];
        for (number, (canvas, gradient)) in (first..).zip(canvas.iter().zip(gradient)) {
            // Beyond the image there may be a gradient of no pixel.
            let (inside, _) = TilePlace::new(grid, number).inside();
            let mut sums = [[0.0_f32; WIDTH]; SUMS];
            for (p, inside) in inside.iter().enumerate() {
                for lane in 0..WIDTH {
                    let colour: [f32; 3] = std::array::from_fn(|c| canvas.planes[c][p][lane]);
                    let light = canvas.planes[TRANSMITTANCE][p][lane];
                    let g: [f32; 3] =
                        std::array::from_fn(|c| gradient.planes[c][p][lane] * inside[lane]);
                    for i in 0..3 {
                        for j in 0..3 {
                            sums[3 * i + j][lane] += g[i] * colour[j];
                        }
                        sums[9 + i][lane] += g[i];
                        sums[12 + i][lane] += g[i] * light;
                        gradient.planes[i][p][lane] =
                            from_red[i] * g[0] + from_green[i] * g[1] + from_blue[i] * g[2];
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
