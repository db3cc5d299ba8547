//! The exposure of the current photograph: a colour transform. Between stages 3 and 4 the rendered colours are
//! transformed. After stage 4 the gradient is backpropagated to the colours before the transform, and the gradient
//! with respect to the transform itself is summed up. Steps without an exposure skip both passes.
//!
//! A task processes a row of tiles and returns its own sums, which are added in order.

use pulp::{Simd, WithSimd};
use rayon::prelude::*;

use super::CpuBackend;
use super::rasterize::{TRANSMITTANCE, TileCanvas, TilePlace};
use super::rasterize_bwd::TileGradient;
use super::simd::WIDTH;
use super::tiles::Grid;
use densify_core::colour::{ColourGradient, ColourTransform, ExposureSums};

/// Number of sums per task; see [`ExposureSums`].
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

    /// Backpropagates the gradient of the loss to the colours before the transform, and returns the gradient with
    /// respect to the transform, for an image over `background`.
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
        let three = |from: usize| std::array::from_fn(|i| total[from + i]);
        let by_colour = [three(0), three(3), three(6)];
        let sums = ExposureSums { by_colour, plain: three(9), behind: three(12) };
        exposure.gradient(background, &sums)
    }
}

/// Transforms the pixels of a row of tiles.
struct Expose<'a> {
    exposure: &'a ColourTransform,
    tiles: &'a mut [TileCanvas],
}

impl WithSimd for Expose<'_> {
    type Output = ();

    /// Scalar loops, which the compiler vectorises for the dispatched instruction set.
    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        let Self { exposure: ColourTransform { matrix, offset }, tiles } = self;
        for tile in tiles {
            let [red, green, blue, ..] = &mut tile.planes;
            let pixels = red.as_flattened_mut().iter_mut();
            let pixels = pixels.zip(green.as_flattened_mut()).zip(blue.as_flattened_mut());
            for ((r, g), b) in pixels {
                let transformed = |i: usize| {
                    let [x, y, z] = matrix[i];
                    x * *r + y * *g + z * *b + offset[i]
                };
                [*r, *g, *b] = [transformed(0), transformed(1), transformed(2)];
            }
        }
    }
}

/// Differentiates the transform in the pixels of a row of tiles.
struct ExposeBwd<'a> {
    grid: &'a Grid,
    /// The number of the first tile.
    first: usize,
    exposure: &'a ColourTransform,
    /// The transformed image.
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
            // Lanes outside the image may hold an arbitrary gradient.
            let (inside, _) = TilePlace::new(grid, number).inside();
            let mut sums = [[0.0_f32; WIDTH]; SUMS];
            for (p, inside) in inside.iter().enumerate() {
                for lane in 0..WIDTH {
                    let colour: [f32; 3] = std::array::from_fn(|c| canvas.planes[c][p][lane]);
                    let transmittance = canvas.planes[TRANSMITTANCE][p][lane];
                    let g: [f32; 3] =
                        std::array::from_fn(|c| gradient.planes[c][p][lane] * inside[lane]);
                    for i in 0..3 {
                        for j in 0..3 {
                            sums[3 * i + j][lane] += g[i] * colour[j];
                        }
                        sums[9 + i][lane] += g[i];
                        sums[12 + i][lane] += g[i] * transmittance;
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
