//! Stage 4: the image loss 0.8·L1 + 0.2·(1 − SSIM) (Kerbl et al. 2023, section 5.1; SSIM of Wang et al. 2004 with an
//! 11×11 Gaussian window of σ = 1.5 and zero padding), and the gradient that training follows: that of the loss with the
//! [pixel term](PixelLoss) of the policy in place of L1.
//!
//! SSIM is written in terms of the difference e = x − y of rendering x and target y, by an exact identity:
//! SSIM = (1 − μₑ²/A)·(1 − Var(e)/B), A = μₓ² + μᵧ² + C₁, B = Var(x) + Var(y) + C₂.
//! Where the images agree, this form is exactly 1; the usual form is off by up to 4e-7 there, and
//! its gradient is noise. The identity holds for any linear window, also where zero padding takes
//! part of the window's weight. Var(x) + Var(y) is 2·Cov(x, y) + Var(e), so that four means under the
//! window are enough: of e, y, e² and x·y.
//!
//! Subtracting a constant from y, padding included, leaves the variances unchanged. Computed from y − ½, they lose two
//! bits fewer to rounding.
//!
//! All passes are in one file because they share their planes and their strips. A task of a pass
//! processes one strip of image rows, and writes nothing that another task of the pass reads. Image rows are
//! convolved vertically from the planes into a few lines that stay in the cache, and then
//! horizontally; nothing is computed twice, whatever the division into strips. [`Segments`] documents the
//! arrangement of a line's pixels.

mod pixel_weights;
mod window;

use densify_policies::policy::{ErrorScore, PixelLoss};
use pulp::{Arch, Simd, WithSimd};
use rayon::prelude::*;

use super::blocks::parts;
use super::rasterize::{TileCanvas, ZERO_PLANE, copy_row_of_plane, set_row_of_plane};
use super::rasterize_bwd::{ERROR, TileGradient};
use super::simd::{V, WIDTH, each};
use super::threads::Threads;
use super::tiles::{Grid, TILE};
use densify_core::image::Image8;
use pixel_weights::PixelWeights;
use window::{
    Line, LinePerRow, Near, Segments, TOGETHER, horizontal, vertical, vertical_with_product,
    vertical_with_square,
};

const C1: f32 = 0.01 * 0.01;
const C2: f32 = 0.03 * 0.03;
/// Weight of 1 − SSIM; L1 has the rest.
pub(crate) const SSIM_WEIGHT: f32 = 0.2;
/// Stands for the bound 0 of L1: smaller than any difference of colours, and a power of two, so that scaling is exact.
const LEAST_BOUND: f32 = 1.0 / (1_u64 << 40) as f32;
/// The constant subtracted from y.
const MIDDLE: f32 = 0.5;
/// Image rows per strip in passes that write whole tiles.
const STRIP: usize = TILE;
/// Image rows per strip in the other passes.
const SHORT_STRIP: usize = TOGETHER;
/// Lines convolved vertically per image row: e, y, e² and x·y.
const CONVOLVED: usize = 4;
/// Maximum number of scratch lines of a pass: the convolved ones, and one each for e and y outside the image.
const MAX_LINES: usize = CONVOLVED * TOGETHER + 2;

/// The buffers of the loss.
#[derive(Debug)]
pub(super) struct LossBuffers {
    /// e, y − ½, and three derivatives. Shape: `[image rows, pitch]` each.
    planes: [Vec<[f32; WIDTH]>; 5],
    /// Errors per pixel (means over the channels), if requested: those that select candidates, and those that rows
    /// accumulate. Shape as above.
    errors: [Vec<[f32; WIDTH]>; 2],
    segments: Segments,
    weights: PixelWeights,
    pixel_loss: PixelLoss,
}

/// The pixel errors requested from a loss.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct ErrorRequests {
    /// Weights of |e| and 1 − SSIM in the errors that select candidates, if these are requested.
    pub(super) for_candidates: Option<[f32; 2]>,
    /// Weighting of the errors that rows accumulate, if these are requested; they are written to their plane of the
    /// gradient.
    pub(super) for_rows: Option<ErrorScore>,
}

/// The scalars of a loss.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct LossValue {
    pub(super) l1: f64,
    pub(super) ssim: f64,
}

impl LossValue {
    pub(super) fn loss(self) -> f64 {
        (1.0 - f64::from(SSIM_WEIGHT)) * self.l1 + f64::from(SSIM_WEIGHT) * (1.0 - self.ssim)
    }
}

impl LossBuffers {
    /// Bytes for an image of the given size, and for the scratch memory of `threads` threads.
    pub(super) fn bytes(
        width: usize,
        height: usize,
        threads: usize,
        for_rows: Option<ErrorScore>,
    ) -> u64 {
        let segments = Segments::new(width);
        let weights = for_rows.map_or(0, |score| PixelWeights::bytes(width * height, &score));
        let planes = (6 + usize::from(for_rows.is_some())) * segments.pitch() * WIDTH * height;
        let lines = threads * MAX_LINES * segments.padded() * WIDTH;
        ((planes + lines) * size_of::<f32>()) as u64 + weights
    }

    pub(super) fn new(pixel_loss: PixelLoss) -> Self {
        Self {
            pixel_loss,
            planes: Default::default(),
            errors: Default::default(),
            segments: Segments::new(0),
            weights: PixelWeights::default(),
        }
    }

    /// Makes room for an image and returns the number of vectors per plane. Only a larger image allocates. Old contents
    /// are not cleared, which would be serial work; everything is written before it is read.
    fn resize(&mut self, grid: &Grid, requested: [bool; 2]) -> usize {
        self.segments = Segments::new(grid.width);
        let vectors = self.segments.pitch() * grid.height;
        let errors = self
            .errors
            .iter_mut()
            .zip(requested)
            .filter_map(|(e, requested)| requested.then_some(e));
        for plane in self.planes.iter_mut().chain(errors) {
            if plane.len() < vectors {
                plane.resize(vectors, [0.0; WIDTH]);
            }
        }
        vectors
    }

    /// Computes the loss of `canvas` against `target`, writes dL/dpixel to `gradient`, and computes the requested
    /// errors of each pixel: means over the channels of a weighted sum of |e| and 1 − SSIM.
    #[expect(clippy::too_many_arguments, reason = "a kernel: each argument is a buffer of its own")]
    pub(super) fn run(
        &mut self,
        threads: &Threads,
        arch: Arch,
        grid: &Grid,
        canvas: &[TileCanvas],
        target: &Image8,
        background: [f32; 3],
        gradient: &mut [TileGradient],
        requests: ErrorRequests,
    ) -> LossValue {
        let ErrorRequests { for_candidates, for_rows } = requests;
        let requested = [for_candidates.is_some(), for_rows.is_some()];
        let vectors = self.resize(grid, requested);
        let Self { planes, errors, segments, .. } = self;
        let segments = *segments;
        let bound = self.pixel_loss.bound().max(LEAST_BOUND);
        let [e, y, p1, p2, p3] = planes.each_mut().map(|plane| &mut plane[..vectors]);
        let [candidate_errors, row_errors] = errors;
        // Empty unless requested.
        let candidate_errors = &mut candidate_errors[..if requested[0] { vectors } else { 0 }];
        let row_errors = &mut row_errors[..if requested[1] { vectors } else { 0 }];
        let row_weights = for_rows.map(|score| score.map.weights());
        let error_weights = [for_candidates, row_weights].map(Option::unwrap_or_default);
        let short = SHORT_STRIP * segments.pitch();
        let samples = (3 * grid.width * grid.height) as f64;
        let (mut l1, mut ssim) = (0.0_f64, 0.0_f64);
        for channel in 0..3 {
            let source = Source { grid, canvas, target, background, channel };
            let tasks = (e.par_chunks_mut(short), y.par_chunks_mut(short));
            let tasks = tasks.into_par_iter().enumerate();
            threads.each_with("loss lines", tasks, Vec::new, |scratch, (i, (e, y))| {
                arch.dispatch(Lines { source, segments, first: i * SHORT_STRIP, scratch, e, y });
            });
            let strips = grid.height.div_ceil(SHORT_STRIP);
            let tasks = (
                p1.par_chunks_mut(short),
                p2.par_chunks_mut(short),
                p3.par_chunks_mut(short),
                parts(candidate_errors, short, strips),
                parts(row_errors, short, strips),
            );
            let sums = threads.collect_with(
                "loss similarity",
                tasks.into_par_iter().enumerate(),
                Vec::new,
                |scratch, (i, (p1, p2, p3, candidate_errors, row_errors))| {
                    arch.dispatch(Similarity {
                        width: grid.width,
                        segments,
                        first: i * SHORT_STRIP,
                        scratch,
                        e,
                        y,
                        derivatives: [p1, p2, p3],
                        errors: [candidate_errors, row_errors],
                        first_channel: channel == 0,
                        error_weights: error_weights.map(|weights| weights.map(|w| w / 3.0)),
                    })
                },
            );
            for part in sums {
                l1 += part.l1;
                ssim += part.ssim;
            }
            let tasks = gradient.par_chunks_mut(grid.columns).enumerate();
            threads.each_with("loss gradient", tasks, Vec::new, |scratch, (i, tiles)| {
                arch.dispatch(Gradient {
                    grid,
                    segments,
                    channel,
                    first: i * STRIP,
                    scratch,
                    e,
                    y,
                    derivatives: [p1, p2, p3],
                    scale: 1.0 / samples as f32,
                    bound,
                    mask: target.mask.as_deref(),
                    tiles,
                });
            });
        }
        if let Some(score) = for_rows {
            self.weights.measure(threads, target, background, &score);
            self.write_row_errors(threads, grid, gradient, &score);
        }
        LossValue { l1: l1 / samples, ssim: ssim / samples }
    }

    /// Writes the errors that rows accumulate, weighted by `score`, to their plane of the gradient.
    fn write_row_errors(
        &self,
        threads: &Threads,
        grid: &Grid,
        gradient: &mut [TileGradient],
        score: &ErrorScore,
    ) {
        let segments = self.segments;
        let tasks = gradient.par_chunks_mut(grid.columns).enumerate();
        let line = || vec![0.0; segments.stride()];
        threads.each_with("loss by pixel", tasks, line, |pixels, (i, tiles)| {
            for tile in tiles.iter_mut() {
                tile.planes[ERROR] = ZERO_PLANE;
            }
            for row in 0..TILE.min(grid.height - i * TILE) {
                let y = i * TILE + row;
                segments.restore(segments.line(&self.errors[1], y), pixels);
                self.weights.apply(score, y, &mut pixels[..grid.width]);
                for (tile, errors) in tiles.iter_mut().zip(pixels.as_chunks::<TILE>().0) {
                    set_row_of_plane(&mut tile.planes[ERROR], row, errors);
                }
            }
        });
    }

    /// The error of a pixel, after a run that requested errors for candidates.
    pub(super) fn error_at(&self, x: usize, y: usize) -> f32 {
        let [vector, lane] = self.segments.place(x);
        self.segments.line(&self.errors[0], y)[vector][lane]
    }
}

/// Multiplies a line by a row of the mask.
#[inline(always)]
fn apply_mask(line: &mut [f32], mask: &[u8]) {
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

/// First pass over one strip of one channel: the lines of e and y − ½; e is (rendering − target)·mask. The padding to
/// the right has the values of pixels outside the image.
struct Lines<'a> {
    source: Source<'a>,
    segments: Segments,
    first: usize,
    scratch: &'a mut Vec<f32>,
    /// The strip's lines.
    e: &'a mut Line,
    y: &'a mut Line,
}

impl WithSimd for Lines<'_> {
    type Output = ();

    /// Scalar loops, which the compiler vectorises for the dispatched instruction set.
    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        let Self { source, segments, first, scratch, e: to_e, y: to_y } = self;
        let Source { grid, canvas, target, background, channel } = source;
        let (width, stride, length) = (grid.width, segments.stride(), segments.length);
        let pitch = segments.pitch();
        scratch.resize(2 * stride, 0.0);
        let (e, y) = scratch.split_at_mut(stride);
        let lines = to_e.chunks_exact_mut(pitch).zip(to_y.chunks_exact_mut(pitch));
        for (row, (to_e, to_y)) in (first..).zip(lines) {
            let pixels = row * width..(row + 1) * width;
            let bytes = &target.rgb[3 * pixels.start..3 * pixels.end];
            for (y, rgb) in y.iter_mut().zip(bytes.as_chunks::<3>().0) {
                *y = f32::from(rgb[channel]) * (1.0 / 255.0);
            }
            if let Some(alpha) = &target.alpha {
                for (y, &a) in y.iter_mut().zip(&alpha[pixels.clone()]) {
                    let a = f32::from(a) * (1.0 / 255.0);
                    *y = a * *y + (1.0 - a) * background[channel];
                }
            }
            let tiles = &canvas[row / TILE * grid.columns..][..grid.columns];
            for (tile, e) in tiles.iter().zip(e.as_chunks_mut::<TILE>().0) {
                copy_row_of_plane(&tile.planes[channel], row % TILE, e);
            }
            for (e, y) in e.iter_mut().zip(&mut *y).take(width) {
                *e -= *y;
                *y -= MIDDLE;
            }
            e[width..].fill(0.0);
            y[width..].fill(-MIDDLE);
            if let Some(mask) = &target.mask {
                apply_mask(&mut e[..width], &mask[pixels]);
            }
            segments.arrange(e, &mut to_e[..length]);
            segments.arrange(y, &mut to_y[..length]);
        }
    }
}

/// `A` scratch lines, and `B` padded ones for each of [`TOGETHER`] rows.
fn scratch_lines<const A: usize, const B: usize>(
    scratch: &mut Vec<[f32; WIDTH]>,
    segments: Segments,
) -> ([&mut Line; A], [LinePerRow<'_>; B]) {
    let (length, padded) = (segments.length, segments.padded());
    scratch.resize(A * length + B * TOGETHER * padded, [0.0; WIDTH]);
    let (lines, per_row) = scratch.split_at_mut(A * length);
    let mut lines = lines.chunks_exact_mut(length);
    let mut per_row = per_row.chunks_exact_mut(padded);
    let mut next = || per_row.next().unwrap_or_default();
    (
        std::array::from_fn(|_| lines.next().unwrap_or_default()),
        std::array::from_fn(|_| std::array::from_fn(|_| next())),
    )
}

/// Second pass over one strip of one channel: SSIM and its derivatives with respect to μₑ, E[e²] and E[e·(y − ½)].
struct Similarity<'a> {
    width: usize,
    segments: Segments,
    first: usize,
    scratch: &'a mut Vec<[f32; WIDTH]>,
    e: &'a Line,
    y: &'a Line,
    /// The strip's lines.
    derivatives: [&'a mut Line; 3],
    /// The strip's lines; empty unless requested.
    errors: [&'a mut Line; 2],
    /// Weights of |e| and 1 − SSIM in each error.
    error_weights: [[f32; 2]; 2],
    /// True for the channel that overwrites the errors; the others add to them.
    first_channel: bool,
}

impl WithSimd for Similarity<'_> {
    /// Sums over the strip's pixels.
    type Output = LossValue;

    #[inline(always)]
    fn with_simd<S: Simd>(self, s: S) -> LossValue {
        let Self { width, segments, first, scratch, e, y, derivatives, .. } = self;
        let Self { mut errors, error_weights, first_channel, .. } = self;
        let [p1, p2, p3] = derivatives;
        let (length, pitch) = (segments.length, segments.pitch());
        let rows = p1.len() / pitch;
        let ([no_e, no_y], [mut of_e, mut of_y, mut of_ee, mut of_xy]) =
            scratch_lines::<2, CONVOLVED>(scratch, segments);
        no_e.fill([0.0; WIDTH]);
        no_y.fill([-MIDDLE; WIDTH]);
        let (firsts, width) = (segments.firsts(), V::splat(s, width as f32));
        let mut total = LossValue::default();
        for row in 0..rows {
            if row % TOGETHER == 0 {
                let near_e = Near::new(segments, e, no_e, first + row);
                let near_y = Near::new(segments, y, no_y, first + row);
                // In two calls, as all four sums of four rows would not fit into the registers.
                vertical_with_square(s, &near_e, [&mut of_e, &mut of_ee]);
                vertical_with_product(s, [&near_y, &near_e], [&mut of_y, &mut of_xy]);
                for row in 0..TOGETHER {
                    segments.pad(of_e[row], 0.0);
                    segments.pad(of_y[row], -MIDDLE);
                    segments.pad(of_ee[row], 0.0);
                    segments.pad(of_xy[row], MIDDLE * MIDDLE);
                }
            }
            let n = row % TOGETHER;
            let lines: [&Line; CONVOLVED] = [of_e[n], of_y[n], of_ee[n], of_xy[n]];
            let here = row * pitch;
            let of_row = p1[here..here + length].as_chunks_mut::<2>().0.iter_mut();
            let of_row = of_row.zip(p2[here..here + length].as_chunks_mut::<2>().0);
            let of_row = of_row.zip(p3[here..here + length].as_chunks_mut::<2>().0);
            let of_row = of_row.zip(segments.line(e, first + row).as_chunks::<2>().0);
            let (mut row_l1, mut row_ssim) = (V::zero(s), V::zero(s));
            for (pair, (((p1, p2), p3), e)) in of_row.enumerate() {
                for lane in (0..WIDTH).step_by(S::F32_LANES) {
                    let [mu_e, mu_y, ee, xy] = each!(k in 4 => {
                        horizontal::<S, 2, 12>(s, around(lines[k], 2 * pair), lane)
                    });
                    for n in 0..2 {
                        let means = [mu_e[n], mu_y[n], ee[n], xy[n]];
                        let Ssim { ssim, by_mu_e, by_ee, by_ey } = Ssim::new(s, means);
                        let i = 2 * pair + n;
                        let inside = (V::load(s, &firsts[lane..]) + i as f32).lt(width);
                        inside.keep(by_mu_e).store(&mut p1[n][lane..]);
                        inside.keep(by_ee).store(&mut p2[n][lane..]);
                        inside.keep(by_ey).store(&mut p3[n][lane..]);
                        let abs = V::load(s, &e[n][lane..]).abs();
                        let ssim = inside.keep(ssim);
                        row_l1 = row_l1 + abs;
                        row_ssim = row_ssim + ssim;
                        for (error, [by_abs, by_dssim]) in errors.iter_mut().zip(error_weights) {
                            if let Some(error) = error.get_mut(here + i) {
                                let dssim = inside.keep(V::splat(s, 1.0) - ssim);
                                let add = abs * by_abs + dssim * by_dssim;
                                let sum = if first_channel {
                                    add
                                } else {
                                    V::load(s, &error[lane..]) + add
                                };
                                sum.store(&mut error[lane..]);
                            }
                        }
                    }
                }
            }
            total.l1 += f64::from(row_l1.sum());
            total.ssim += f64::from(row_ssim.sum());
        }
        total
    }
}

/// SSIM of some pixels, and its derivatives with respect to μₑ, E[e²] and E[e·(y − ½)].
struct Ssim<S: Simd> {
    ssim: V<S>,
    by_mu_e: V<S>,
    by_ee: V<S>,
    by_ey: V<S>,
}

impl<S: Simd> Ssim<S> {
    /// Computes SSIM and its derivatives from the means of e, y − ½, e² and (x − ½)·(y − ½).
    #[inline(always)]
    fn new(s: S, [mu_e, shifted_y, mean_ee, mean_xy]: [V<S>; 4]) -> Self {
        let c = |x: f32| V::splat(s, x);
        let mu_y = shifted_y + MIDDLE;
        let mu_x = mu_e + mu_y;
        let var_e = (mean_ee - mu_e * mu_e).max(V::zero(s));
        let cov = mean_xy - (shifted_y + mu_e) * shifted_y;
        let variances = (cov * 2.0 + var_e).max(V::zero(s));
        // One division for both inverses; the divisor is at least C₁·C₂ = 9e-8, far from underflow.
        let (a, b) = (mu_x * mu_x + mu_y * mu_y + C1, variances + C2);
        let inv_ab = c(1.0) / (a * b);
        let (inv_a, inv_b) = (inv_ab * b, inv_ab * a);
        let luminance = c(1.0) - mu_e * mu_e * inv_a;
        let contrast = c(1.0) - var_e * inv_b;
        let by_luminance = mu_e * inv_a * -2.0 * (c(1.0) - mu_e * mu_x * inv_a);
        let two_ve_bb = var_e * inv_b * inv_b * 2.0;
        let by_contrast = mu_e * contrast * inv_b * 2.0 - shifted_y * two_ve_bb;
        Self {
            ssim: luminance * contrast,
            by_mu_e: contrast * by_luminance + luminance * by_contrast,
            by_ee: -(luminance * contrast * inv_b),
            by_ey: luminance * two_ve_bb,
        }
    }
}

/// The vectors of a padded line that the window covers, from vector `first` on.
#[inline(always)]
fn around<const M: usize>(line: &Line, first: usize) -> &[[f32; WIDTH]; M] {
    line[first..].first_chunk().expect("a padded line")
}

/// Third pass over one strip of one channel: dL/dpixel.
struct Gradient<'a> {
    grid: &'a Grid,
    segments: Segments,
    channel: usize,
    first: usize,
    scratch: &'a mut Vec<[f32; WIDTH]>,
    e: &'a Line,
    y: &'a Line,
    derivatives: [&'a Line; 3],
    /// 1 / number of samples.
    scale: f32,
    /// The pixel difference from which the gradient no longer grows, > 0.
    bound: f32,
    mask: Option<&'a [u8]>,
    /// The strip's tiles.
    tiles: &'a mut [TileGradient],
}

impl WithSimd for Gradient<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, s: S) {
        let Self { grid, segments, channel, first, scratch, e, y, derivatives, scale, .. } = self;
        let Self { bound, mask, tiles, .. } = self;
        let rows = STRIP.min(grid.height - first);
        let ([zeros, out, pixels], mut lines) = scratch_lines::<3, 3>(scratch, segments);
        zeros.fill([0.0; WIDTH]);
        let pixels = pixels.as_flattened_mut();
        let pixel_scale = (1.0 - SSIM_WEIGHT) * scale / bound;
        let ssim_scale = -SSIM_WEIGHT * scale;
        if rows < STRIP {
            for tile in tiles.iter_mut() {
                tile.planes[channel] = ZERO_PLANE;
            }
        }
        for row in 0..rows {
            if row % TOGETHER == 0 {
                for (plane, lines) in derivatives.into_iter().zip(&mut lines) {
                    vertical(s, &Near::new(segments, plane, zeros, first + row), lines);
                    for line in lines {
                        segments.pad(line, 0.0);
                    }
                }
            }
            let of_row = out.as_chunks_mut::<TOGETHER>().0.iter_mut();
            let of_row = of_row.zip(segments.line(e, first + row).as_chunks::<TOGETHER>().0);
            let of_row = of_row.zip(segments.line(y, first + row).as_chunks::<TOGETHER>().0);
            for (group, ((out, e), y)) in of_row.enumerate() {
                for lane in (0..WIDTH).step_by(S::F32_LANES) {
                    let [by_mu_e, by_ee, by_ey] = each!(k in 3 => {
                        let line = &*lines[k][row % TOGETHER];
                        horizontal::<S, TOGETHER, 14>(s, around(line, TOGETHER * group), lane)
                    });
                    for n in 0..TOGETHER {
                        let (e, y) = (V::load(s, &e[n][lane..]), V::load(s, &y[n][lane..]));
                        let by_ssim = by_mu_e[n] + e * 2.0 * by_ee[n] + y * by_ey[n];
                        let bounded = e.min(V::splat(s, bound)).max(V::splat(s, -bound));
                        let g = by_ssim * ssim_scale + bounded * pixel_scale;
                        g.store(&mut out[n][lane..]);
                    }
                }
            }
            segments.restore(out, pixels);
            // The loss is a function of e·mask, so the chain rule multiplies by the mask.
            if let Some(mask) = mask {
                apply_mask(pixels, &mask[(first + row) * grid.width..][..grid.width]);
            }
            for (tile, g) in tiles.iter_mut().zip(pixels.as_chunks::<TILE>().0) {
                set_row_of_plane(&mut tile.planes[channel], row % TILE, g);
            }
        }
    }
}

#[cfg(test)]
mod tests;
