//! Stage 4: the image loss 0.8·L1 + 0.2·(1 − SSIM) and its gradient (Kerbl et al. 2023, section 5.1;
//! SSIM of Wang et al. 2004 with an 11×11 Gaussian window of σ = 1.5 and zero padding).
//!
//! SSIM is written in terms of the difference e = x − y, by an exact identity:
//! SSIM = (1 − μₑ²/A)·(1 − Var(e)/B), A = μₓ² + μᵧ² + C₁, B = Var(x) + Var(y) + C₂.
//! Where the images agree it is 1 to the last bit; the usual form is off by up to 4e-7 there, and
//! its gradient is noise. The identity holds for any linear window, also where zero padding takes
//! part of the window's weight.
//!
//! The file is one piece because the passes share their planes and their strips. Each pass runs over
//! strips of rows, which write nothing that others of the same pass read. Rows of the image are
//! convolved vertically straight from the planes, into a few lines that stay in the cache, and these
//! horizontally: nothing is computed twice, however the image is cut.

mod window;

use pulp::{Arch, Simd, WithSimd};
use rayon::prelude::*;

use super::parts::{Parts, parts};
use super::rasterize::{DARK, TileCanvas, row_of_plane, set_row_of_plane};
use super::rasterize_bwd::TileGradient;
use super::simd::{V, WIDTH, each};
use super::threads::Threads;
use super::tiles::{Grid, TILE};
use crate::dataset::images::Image8;
use window::{
    LinePerRow, Near, ROWS, horizontal, vertical, vertical_of_product, vertical_with_square,
};

const C1: f32 = 0.01 * 0.01;
const C2: f32 = 0.03 * 0.03;
/// Weight of 1 − SSIM; L1 has the rest.
const SSIM_WEIGHT: f32 = 0.2;
/// Rows per strip: a row of tiles.
const STRIP: usize = TILE;
/// Zeros left of a line's first pixel, so that loads stay aligned; as many or more on the right.
const PAD: usize = WIDTH;
/// Lines that are convolved vertically for each row: of e, y, e², y² and e·y.
const CONVOLVED: usize = 5;
/// Lines of scratch of a pass: those, and zeros.
const MOST_LINES: usize = CONVOLVED * ROWS + 1;

/// Planes of image size that the loss keeps between its passes: e, y, and three derivatives.
#[derive(Debug)]
pub(super) struct LossBuffers {
    /// Shape: `[rows, stride]` each.
    planes: [Vec<f32>; 5],
    /// Errors per pixel, the mean over channels, if asked for. Shape: `[rows, stride]` each.
    errors: [Vec<f32>; 2],
    stride: usize,
}

/// What of a loss is asked for.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct ImageTerms {
    /// See [`StepInput::ssim_weight`](crate::backend::StepInput::ssim_weight).
    pub(super) ssim: f32,
    /// Weights of |e| and of 1 − SSIM in the error of each pixel, if that is asked for.
    pub(super) error: Option<[f32; 2]>,
    /// Whether each pixel's part of the loss goes to the last plane of the gradient.
    pub(super) by_pixel: bool,
}

impl Default for ImageTerms {
    fn default() -> Self {
        Self { ssim: 1.0, error: None, by_pixel: false }
    }
}

/// The scalars of a loss; without SSIM that is NaN.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct LossValue {
    pub(super) l1: f64,
    pub(super) ssim: f64,
}

impl LossValue {
    pub(super) fn loss(self) -> f64 {
        if self.ssim.is_nan() {
            return self.l1;
        }
        (1.0 - f64::from(SSIM_WEIGHT)) * self.l1 + f64::from(SSIM_WEIGHT) * (1.0 - self.ssim)
    }
}

fn line(width: usize) -> usize {
    width.next_multiple_of(WIDTH) + 2 * PAD
}

impl LossBuffers {
    /// Bytes for an image of this size, and for the strips of so many threads.
    pub(super) fn bytes(width: usize, height: usize, threads: usize, by_pixel: bool) -> u64 {
        let planes = (6 + usize::from(by_pixel)) * line(width) * height;
        let lines = threads * MOST_LINES * line(width);
        ((planes + lines) * size_of::<f32>()) as u64
    }

    pub(super) fn new() -> Self {
        Self { planes: Default::default(), errors: Default::default(), stride: 0 }
    }

    /// Makes room for an image. Images of one size, or smaller ones, allocate nothing more.
    fn resize(&mut self, grid: &Grid, asked: [bool; 2]) {
        self.stride = line(grid.width);
        for plane in &mut self.planes {
            plane.resize(self.stride * grid.height, 0.0);
        }
        for (error, asked) in self.errors.iter_mut().zip(asked) {
            error.clear();
            if asked {
                error.resize(self.stride * grid.height, 0.0);
            }
        }
    }

    /// Computes the loss of `canvas` against `target`, and dL/dpixel into `gradient`; with weights
    /// also the error of each pixel, as the mean over channels of their combination of |e| and
    /// 1 − SSIM. Nothing of SSIM is computed where neither asks for it.
    #[expect(clippy::too_many_arguments, reason = "a kernel: each is a buffer of its own")]
    pub(super) fn run(
        &mut self,
        threads: &Threads,
        arch: Arch,
        grid: &Grid,
        canvas: &[TileCanvas],
        target: &Image8,
        background: [f32; 3],
        gradient: &mut [TileGradient],
        terms: ImageTerms,
    ) -> LossValue {
        let ImageTerms { ssim: ssim_weight, error: error_weights, by_pixel } = terms;
        let l1_alone = ssim_weight == 0.0 && error_weights.is_none() && !by_pixel;
        self.resize(grid, [error_weights.is_some(), by_pixel]);
        let error_weights = [error_weights.unwrap_or_default(), [1.0 - SSIM_WEIGHT, SSIM_WEIGHT]];
        let stride = self.stride;
        let samples = (3 * grid.width * grid.height) as f64;
        let (mut l1, mut ssim) = (0.0_f64, 0.0_f64);
        for channel in 0..3 {
            let [e, y, p1, p2, p3] = &mut self.planes;
            let strip = STRIP * stride;
            let strips = grid.height.div_ceil(STRIP);
            let [ranking, by_pixel] = &mut self.errors;
            let error_strips = [parts(ranking, strip, strips), parts(by_pixel, strip, strips)];
            let [ranking, by_pixel] = error_strips.map(Parts::par);
            let source = Source { grid, canvas, target, background, channel };
            let parts = (e.par_chunks_mut(strip), y.par_chunks_mut(strip));
            let tasks = parts.into_par_iter().enumerate();
            threads.each("loss lines", tasks, |(i, (e, y))| {
                arch.dispatch(Lines { source, first: i * STRIP, stride, e, y });
            });
            if l1_alone {
                let scale = (1.0 - SSIM_WEIGHT) * (1.0 / samples as f32);
                let tiles = gradient.par_chunks_mut(grid.columns);
                let tasks = tiles.zip(e.par_chunks_mut(strip)).enumerate();
                let parts = threads.collect("loss", tasks, |(i, (tiles, e))| {
                    let mask = target.mask.as_deref();
                    let first = i * STRIP;
                    arch.dispatch(Absolute { grid, channel, first, stride, e, scale, mask, tiles })
                });
                l1 += parts.into_iter().sum::<f64>();
                continue;
            }
            let parts = (
                p1.par_chunks_mut(strip),
                p2.par_chunks_mut(strip),
                p3.par_chunks_mut(strip),
                ranking,
                by_pixel,
            );
            let tasks = parts.into_par_iter().enumerate();
            let sums = threads.collect_with(
                "loss similarity",
                tasks,
                Vec::new,
                |scratch, (i, (p1, p2, p3, ranking, by_pixel))| {
                    arch.dispatch(Similarity {
                        grid,
                        first: i * STRIP,
                        stride,
                        scratch,
                        e,
                        y,
                        derivatives: [p1, p2, p3],
                        errors: [ranking, by_pixel],
                        error_weights: error_weights.map(|weights| weights.map(|w| w / 3.0)),
                    })
                },
            );
            for part in sums {
                l1 += part.l1;
                ssim += part.ssim;
            }
            let [e, y, p1, p2, p3] = &self.planes;
            let tasks = gradient.par_chunks_mut(grid.columns).enumerate();
            threads.each_with("loss gradient", tasks, Vec::new, |scratch, (i, tiles)| {
                arch.dispatch(Gradient {
                    grid,
                    channel,
                    first: i * STRIP,
                    stride,
                    scratch,
                    e,
                    y,
                    derivatives: [p1, p2, p3],
                    scale: 1.0 / samples as f32,
                    ssim_weight,
                    mask: target.mask.as_deref(),
                    tiles,
                });
            });
        }
        if by_pixel {
            self.spread_over_tiles(threads, grid, gradient);
        }
        let ssim = if ssim_weight == 0.0 { f64::NAN } else { ssim / samples };
        LossValue { l1: l1 / samples, ssim }
    }

    /// Writes the second error to the last plane of the gradient.
    fn spread_over_tiles(&self, threads: &Threads, grid: &Grid, gradient: &mut [TileGradient]) {
        let stride = self.stride;
        let tasks = gradient.par_chunks_mut(grid.columns).enumerate();
        threads.each("loss by pixel", tasks, |(i, tiles)| {
            for tile in tiles.iter_mut() {
                tile.planes[4] = DARK;
            }
            let lines = self.errors[1][i * TILE * stride..].chunks_exact(stride);
            for (row, line) in lines.take(TILE).enumerate() {
                for (tile, errors) in tiles.iter_mut().zip(line[PAD..].as_chunks::<TILE>().0) {
                    set_row_of_plane(&mut tile.planes[4], row, errors);
                }
            }
        });
    }

    /// Error of a pixel after a run with error weights.
    pub(super) fn error_at(&self, x: usize, y: usize) -> f32 {
        self.errors[0][y * self.stride + PAD + x]
    }
}

/// Multiplies a line by the weights of a mask's row.
#[inline(always)]
fn masked(line: &mut [f32], mask: &[u8]) {
    for (x, &m) in line.iter_mut().zip(mask) {
        *x *= f32::from(m) * (1.0 / 255.0);
    }
}

/// One channel of rendering and target.
#[derive(Clone, Copy)]
struct Source<'a> {
    grid: &'a Grid,
    canvas: &'a [TileCanvas],
    target: &'a Image8,
    background: [f32; 3],
    channel: usize,
}

/// The planes' lines of one strip of one channel: e = rendering − target and y = target, 0 where
/// masked and in the pads.
struct Lines<'a> {
    source: Source<'a>,
    first: usize,
    stride: usize,
    /// The strip's lines.
    e: &'a mut [f32],
    y: &'a mut [f32],
}

impl WithSimd for Lines<'_> {
    type Output = ();

    /// Plain loops, which the compiler turns into vectors of the dispatched instruction set.
    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        let Self { source, first, stride, e, y } = self;
        let Source { grid, canvas, target, background, channel } = source;
        let width = grid.width;
        let inner = PAD..PAD + width;
        let lines = e.chunks_exact_mut(stride).zip(y.chunks_exact_mut(stride));
        for (row, (e, y)) in (first..).zip(lines) {
            e.fill(0.0);
            y.fill(0.0);
            let pixels = row * width..(row + 1) * width;
            let bytes = &target.rgb[3 * pixels.start..3 * pixels.end];
            for (y, rgb) in y[inner.clone()].iter_mut().zip(bytes.as_chunks::<3>().0) {
                *y = f32::from(rgb[channel]) * (1.0 / 255.0);
            }
            if let Some(alpha) = &target.alpha {
                for (y, &a) in y[inner.clone()].iter_mut().zip(&alpha[pixels.clone()]) {
                    let a = f32::from(a) * (1.0 / 255.0);
                    *y = a * *y + (1.0 - a) * background[channel];
                }
            }
            let tiles = &canvas[row / TILE * grid.columns..][..grid.columns];
            for (tile, e) in tiles.iter().zip(e[PAD..].as_chunks_mut::<TILE>().0) {
                *e = row_of_plane(&tile.planes[channel], row % TILE);
            }
            e[PAD + width..].fill(0.0);
            for (e, &y) in e[inner.clone()].iter_mut().zip(&y[inner.clone()]) {
                *e -= y;
            }
            if let Some(mask) = &target.mask {
                masked(&mut e[inner.clone()], &mask[pixels]);
            }
        }
    }
}

/// `A` lines of scratch of `stride` numbers, and `B` for each of some rows: zero where nothing was
/// written since the first call.
fn scratch_lines<const A: usize, const B: usize>(
    scratch: &mut Vec<f32>,
    stride: usize,
) -> ([&mut [f32]; A], [LinePerRow<'_>; B]) {
    scratch.resize((A + B * ROWS) * stride, 0.0);
    let mut lines = scratch.chunks_exact_mut(stride);
    let mut next = || lines.next().unwrap_or_default();
    (std::array::from_fn(|_| next()), std::array::from_fn(|_| std::array::from_fn(|_| next())))
}

/// First pass over one strip of one channel: SSIM and its derivatives by μₑ, E[e²] and E[e·y].
struct Similarity<'a> {
    grid: &'a Grid,
    first: usize,
    stride: usize,
    scratch: &'a mut Vec<f32>,
    e: &'a [f32],
    y: &'a [f32],
    /// The strip's lines.
    derivatives: [&'a mut [f32]; 3],
    /// The strip's lines; empty unless asked for.
    errors: [&'a mut [f32]; 2],
    /// Weights of |e| and of 1 − SSIM in each of them.
    error_weights: [[f32; 2]; 2],
}

impl WithSimd for Similarity<'_> {
    /// Sums over the strip's pixels.
    type Output = LossValue;

    #[inline(always)]
    fn with_simd<S: Simd>(self, s: S) -> LossValue {
        let Self { grid, first, stride, scratch, e, y, derivatives, .. } = self;
        let Self { mut errors, error_weights, .. } = self;
        let [p1, p2, p3] = derivatives;
        let width = grid.width;
        let rows = p1.len() / stride;
        let ([zeros], [mut of_e, mut of_y, mut of_ee, mut of_yy, mut of_ey]) =
            scratch_lines::<1, CONVOLVED>(scratch, stride);
        let columns = (PAD..PAD + width.next_multiple_of(WIDTH)).step_by(S::F32_LANES);
        let c = |x: f32| V::splat(s, x);
        let mut total = LossValue::default();
        for row in 0..rows {
            if row % ROWS == 0 {
                let near_e = Near::new(e, zeros, first + row);
                let near_y = Near::new(y, zeros, first + row);
                // One after the other: all five sums of four rows would not stay in the registers.
                vertical_with_square(s, &near_e, columns.clone(), [&mut of_e, &mut of_ee]);
                vertical_with_square(s, &near_y, columns.clone(), [&mut of_y, &mut of_yy]);
                vertical_of_product(s, [&near_e, &near_y], columns.clone(), &mut of_ey);
            }
            let (mut row_l1, mut row_ssim) = (V::zero(s), V::zero(s));
            for at in columns.clone() {
                let n = row % ROWS;
                let (mu_e, mu_y) = (horizontal(s, of_e[n], at), horizontal(s, of_y[n], at));
                let (mean_ee, mean_yy) = (horizontal(s, of_ee[n], at), horizontal(s, of_yy[n], at));
                let mean_ey = horizontal(s, of_ey[n], at);
                let mu_x = mu_e + mu_y;
                let var_e = (mean_ee - mu_e * mu_e).max(V::zero(s));
                let var_y = (mean_yy - mu_y * mu_y).max(V::zero(s));
                let cov = mean_ey - mu_e * mu_y;
                let var_x = (var_y + cov * 2.0 + var_e).max(V::zero(s));
                // One division for both inverses: at least C₁·C₂ = 9e-8 is far from f32's least.
                let (a, b) = (mu_x * mu_x + mu_y * mu_y + C1, var_x + var_y + C2);
                let inv_ab = c(1.0) / (a * b);
                let (inv_a, inv_b) = (inv_ab * b, inv_ab * a);
                let luminance = c(1.0) - mu_e * mu_e * inv_a;
                let contrast = c(1.0) - var_e * inv_b;
                let by_luminance = mu_e * inv_a * -2.0 * (c(1.0) - mu_e * mu_x * inv_a);
                let two_ve_bb = var_e * inv_b * inv_b * 2.0;
                let by_contrast = mu_e * contrast * inv_b * 2.0 - mu_y * two_ve_bb;
                let inside = V::load(s, &LANES[..]).lt(c((PAD + width).saturating_sub(at) as f32));
                let to = row * stride + at;
                inside.keep(contrast * by_luminance + luminance * by_contrast).store(&mut p1[to..]);
                inside.keep(-(luminance * contrast * inv_b)).store(&mut p2[to..]);
                inside.keep(luminance * two_ve_bb).store(&mut p3[to..]);
                let abs = V::load(s, &e[first * stride + to..]).abs();
                let ssim = inside.keep(luminance * contrast);
                row_l1 = row_l1 + abs;
                row_ssim = row_ssim + ssim;
                for (error, [by_abs, by_dssim]) in errors.iter_mut().zip(error_weights) {
                    if !error.is_empty() {
                        let dssim = inside.keep(c(1.0) - ssim);
                        let add = abs * by_abs + dssim * by_dssim;
                        (V::load(s, &error[to..]) + add).store(&mut error[to..]);
                    }
                }
            }
            total.l1 += f64::from(row_l1.sum());
            total.ssim += f64::from(row_ssim.sum());
        }
        total
    }
}

/// 0, 1, 2, …
const LANES: [f32; WIDTH] = {
    let mut lanes = [0.0; WIDTH];
    let mut i = 0;
    while i < WIDTH {
        lanes[i] = i as f32;
        i += 1;
    }
    lanes
};

/// One strip of one channel, of L1 alone: its sum, and dL/dpixel.
struct Absolute<'a> {
    grid: &'a Grid,
    channel: usize,
    first: usize,
    stride: usize,
    /// The strip's lines; they are used up.
    e: &'a mut [f32],
    /// L1's weight / number of samples.
    scale: f32,
    mask: Option<&'a [u8]>,
    /// The strip's tiles.
    tiles: &'a mut [TileGradient],
}

impl WithSimd for Absolute<'_> {
    /// Σ|e| over the strip's pixels.
    type Output = f64;

    #[inline(always)]
    fn with_simd<S: Simd>(self, s: S) -> f64 {
        let Self { grid, channel, first, stride, e, scale, mask, tiles } = self;
        let zero = V::zero(s);
        let mut total = 0.0;
        for tile in tiles.iter_mut() {
            tile.planes[channel] = DARK;
        }
        for (row, line) in e.chunks_exact_mut(stride).enumerate() {
            let mut sum = zero;
            for at in (PAD..PAD + grid.width.next_multiple_of(WIDTH)).step_by(S::F32_LANES) {
                let e = V::load(s, &line[at..]);
                sum = sum + e.abs();
                let positive = zero.lt(e).keep(V::splat(s, scale));
                let negative = e.lt(zero).keep(V::splat(s, scale));
                (positive - negative).store(&mut line[at..]);
            }
            total += f64::from(sum.sum());
            // The loss sees e·mask, so the chain rule has the mask once more.
            if let Some(mask) = mask {
                let mask = &mask[(first + row) * grid.width..][..grid.width];
                masked(&mut line[PAD..PAD + grid.width], mask);
            }
            let tiles = &mut tiles[row / TILE * grid.columns..][..grid.columns];
            for (tile, g) in tiles.iter_mut().zip(line[PAD..].as_chunks::<TILE>().0) {
                set_row_of_plane(&mut tile.planes[channel], row % TILE, g);
            }
        }
        total
    }
}

/// Second pass over one strip of one channel: dL/dpixel.
struct Gradient<'a> {
    grid: &'a Grid,
    channel: usize,
    first: usize,
    stride: usize,
    scratch: &'a mut Vec<f32>,
    e: &'a [f32],
    y: &'a [f32],
    derivatives: [&'a [f32]; 3],
    /// 1 / number of samples.
    scale: f32,
    ssim_weight: f32,
    mask: Option<&'a [u8]>,
    /// The strip's tiles.
    tiles: &'a mut [TileGradient],
}

impl WithSimd for Gradient<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, s: S) {
        let Self { grid, channel, first, stride, scratch, e, y, derivatives, scale, .. } = self;
        let Self { ssim_weight, mask, tiles, .. } = self;
        let rows = STRIP.min(grid.height - first);
        let ([zeros, out], mut lines) = scratch_lines::<2, 3>(scratch, stride);
        let columns = (PAD..PAD + grid.width.next_multiple_of(WIDTH)).step_by(S::F32_LANES);
        let l1_scale = (1.0 - SSIM_WEIGHT) * scale;
        let ssim_scale = -SSIM_WEIGHT * scale * ssim_weight;
        let zero = V::zero(s);
        for tile in tiles.iter_mut() {
            tile.planes[channel] = DARK;
        }
        for row in 0..rows {
            if row % ROWS == 0 {
                for (plane, lines) in derivatives.into_iter().zip(&mut lines) {
                    let near = Near::new(plane, zeros, first + row);
                    vertical(s, &near, columns.clone(), lines);
                }
            }
            for at in columns.clone() {
                let [by_mu_e, by_ee, by_ey] =
                    each!(k in 3 => horizontal(s, lines[k][row % ROWS], at));
                let from = (first + row) * stride + at;
                let (e, y) = (V::load(s, &e[from..]), V::load(s, &y[from..]));
                let by_ssim = by_mu_e + e * 2.0 * by_ee + y * by_ey;
                let positive = zero.lt(e).keep(V::splat(s, l1_scale));
                let negative = e.lt(zero).keep(V::splat(s, l1_scale));
                let g = by_ssim * ssim_scale + (positive - negative);
                g.store(&mut out[at..]);
            }
            // The loss sees e·mask, so the chain rule has the mask once more.
            if let Some(mask) = mask {
                let mask = &mask[(first + row) * grid.width..][..grid.width];
                masked(&mut out[PAD..PAD + grid.width], mask);
            }
            let tiles = &mut tiles[row / TILE * grid.columns..][..grid.columns];
            for (tile, g) in tiles.iter_mut().zip(out[PAD..].as_chunks::<TILE>().0) {
                set_row_of_plane(&mut tile.planes[channel], row % TILE, g);
            }
        }
    }
}

#[cfg(test)]
mod tests;
