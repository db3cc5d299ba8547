//! The convolution with SSIM's window: vertically for a few image rows at a time, then horizontally for a
//! few vectors at a time. The window is symmetric, so pixels at equal distances are added before they are
//! weighted.
//!
//! A line is stored as sixteen segments side by side, one in each lane, so that the left and right neighbours of a
//! vector's pixels are vectors too, and no load is unaligned.

use glam::Mat4;
use pulp::Simd;

use super::super::simd::{V, WIDTH, each};

/// Number of pixels of the window on each side of its centre.
pub(super) const REACH: usize = 5;
/// The Gaussian window, normalised: exp(−k²/(2·1.5²))/Σ for k = −5..=5.
const WINDOW: [f32; 2 * REACH + 1] = [
    0.001_028_380_2,
    0.007_598_758,
    0.036_000_773,
    0.109_360_69,
    0.213_005_53,
    0.266_011_74,
    0.213_005_53,
    0.109_360_69,
    0.036_000_773,
    0.007_598_758,
    0.001_028_380_2,
];
/// Number of rows, or vectors of a row, that are convolved together. They share most of their neighbours, so that 3.5
/// loads per result suffice instead of eleven. More would not fit into the registers.
pub(super) const TOGETHER: usize = 4;
/// Number of rows or vectors within reach of [`TOGETHER`] adjacent ones.
const NEAR: usize = TOGETHER + 2 * REACH;
/// Number of pixels per run. The pixels of four runs are transposed together; a segment consists of whole runs.
const RUN: usize = 4;

/// The arrangement of a line's pixels: lane l of vector i is pixel i of segment l.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Segments {
    /// Pixels per segment, which is also the number of vectors per line.
    pub(super) length: usize,
}

impl Segments {
    /// The segments of lines of `width` pixels. They are whole runs and longer than half the window, so that the
    /// window never reaches beyond the next lane.
    pub(super) const fn new(width: usize) -> Self {
        let length = width.div_ceil(WIDTH).next_multiple_of(RUN);
        Self { length: if length < 2 * RUN { 2 * RUN } else { length } }
    }

    /// Numbers per line.
    pub(super) const fn stride(self) -> usize {
        self.length * WIDTH
    }

    /// Vectors from one line of a plane to the next: an odd number, as lines at a distance of a power of two
    /// evict each other from the cache.
    pub(super) const fn pitch(self) -> usize {
        self.length + 1
    }

    /// Row `row` of a plane.
    pub(super) fn line(self, plane: &Line, row: usize) -> &Line {
        &plane[row * self.pitch()..][..self.length]
    }

    /// Vectors of a line with padding at both ends, for horizontal convolution.
    pub(super) const fn padded(self) -> usize {
        self.length + 2 * REACH
    }

    /// Vector and lane of a pixel.
    pub(super) fn place(self, x: usize) -> [usize; 2] {
        [x % self.length, x / self.length]
    }

    /// The first pixel of the segment in each lane.
    pub(super) fn firsts(self) -> [f32; WIDTH] {
        std::array::from_fn(|lane| (lane * self.length) as f32)
    }

    /// Arranges consecutive pixels in segments. `pixels` and `line` have [`stride`](Self::stride) numbers each.
    #[inline(always)]
    pub(super) fn arrange(self, pixels: &[f32], line: &mut Line) {
        for lane in (0..WIDTH).step_by(RUN) {
            let segments = |l: usize| &pixels[(lane + l) * self.length..][..self.length];
            let segments = [segments(0), segments(1), segments(2), segments(3)];
            let segments = segments.map(|segment| segment.as_chunks::<RUN>().0);
            for (run, vectors) in line.as_chunks_mut::<RUN>().0.iter_mut().enumerate() {
                let columns = transposed(segments.map(|segment| segment[run]));
                for (vector, part) in vectors.iter_mut().zip(columns) {
                    vector[lane..lane + RUN].copy_from_slice(&part);
                }
            }
        }
    }

    /// The inverse of [`arrange`](Self::arrange).
    #[inline(always)]
    pub(super) fn restore(self, line: &Line, pixels: &mut [f32]) {
        let pixels = pixels.as_chunks_mut::<RUN>().0;
        let runs = self.length / RUN;
        for lane in (0..WIDTH).step_by(RUN) {
            for (run, vectors) in line.as_chunks::<RUN>().0.iter().enumerate() {
                let part =
                    |i: usize| -> [f32; RUN] { std::array::from_fn(|l| vectors[i][lane + l]) };
                let columns = transposed([part(0), part(1), part(2), part(3)]);
                for (l, part) in columns.into_iter().enumerate() {
                    pixels[(lane + l) * runs + run] = part;
                }
            }
        }
    }

    /// Fills the padding at both ends of a line: with the pixels of the neighbouring lane, and with `outside` beyond
    /// the image.
    #[inline(always)]
    pub(super) fn pad(self, line: &mut Line, outside: f32) {
        let line = line.as_flattened_mut();
        for i in 0..REACH {
            // The neighbouring lane is one number to the left or to the right.
            let before = (self.length + i) * WIDTH - 1;
            copy_vector(line, before, i * WIDTH);
            line[i * WIDTH] = outside;
            let (after, to) = ((REACH + i) * WIDTH + 1, (REACH + self.length + i) * WIDTH);
            copy_vector(line, after, to);
            line[to + WIDTH - 1] = outside;
        }
    }
}

#[inline(always)]
fn copy_vector(line: &mut [f32], from: usize, to: usize) {
    if let Some(&vector) = line[from..].first_chunk::<WIDTH>() {
        line[to..to + WIDTH].copy_from_slice(&vector);
    }
}

/// Transposes a matrix by means of `Mat4`, which uses vector instructions; a plain loop would be compiled to one load
/// and one store per number.
#[inline(always)]
fn transposed(rows: [[f32; RUN]; RUN]) -> [[f32; RUN]; RUN] {
    Mat4::from_cols_array_2d(&rows).transpose().to_cols_array_2d()
}

/// A line as consecutive vectors.
pub(super) type Line = [[f32; WIDTH]];
/// A padded scratch line for each of [`TOGETHER`] rows.
pub(super) type LinePerRow<'a> = [&'a mut Line; TOGETHER];

/// The lines of a plane within reach of [`TOGETHER`] rows; for rows outside the image, a constant line.
pub(super) struct Near<'a>([&'a Line; NEAR]);

impl<'a> Near<'a> {
    /// The lines within reach of the rows from `row` on.
    #[inline(always)]
    pub(super) fn new(segments: Segments, plane: &'a Line, outside: &'a Line, row: usize) -> Self {
        let rows = plane.len() / segments.pitch();
        let mut lines = [outside; NEAR];
        for (i, line) in lines.iter_mut().enumerate() {
            if let Some(row) = (row + i).checked_sub(REACH).filter(|row| *row < rows) {
                *line = segments.line(plane, row);
            }
        }
        Self(lines)
    }
}

/// An array of the values of an expression, one for each row or vector within reach.
macro_rules! near {
    ($d:ident => $e:expr) => {
        near!(@ $d 0 1 2 3 4 5 6 7 8 9 10 11 12 13 => $e)
    };
    (@ $d:ident $($value:literal)* => $e:expr) => { [$({ let $d: usize = $value; $e }),*] };
}
const _: () =
    assert!(NEAR == 14 && TOGETHER == 4, "`near`, `cut` and `convolved` list all indices");

/// The convolution at each of [`TOGETHER`] rows or vectors.
#[inline(always)]
fn convolved<S: Simd>(s: S, x: &[V<S>; NEAR]) -> [V<S>; TOGETHER] {
    each!(n in 4 => convolved_at(s, x, n))
}

#[inline(always)]
fn convolved_at<S: Simd>(s: S, x: &[V<S>; NEAR], n: usize) -> V<S> {
    let mut sum = x[n + REACH] * WINDOW[REACH];
    for k in 0..REACH {
        sum = V::splat(s, WINDOW[k]).mul_add(x[n + k] + x[n + 2 * REACH - k], sum);
    }
    sum
}

/// Slices lines to a common length once, so that loads and stores need no bounds checks.
macro_rules! cut {
    ($near:expr, $length:expr) => {
        near!(d => &$near.0[d][..$length])
    };
    (mut $lines:expr, $length:expr) => {{
        let [a, b, c, d] = $lines;
        [a, b, c, d].map(|line| &mut line[REACH..][..$length])
    }};
}

/// Convolves a plane vertically.
#[inline(always)]
pub(super) fn vertical<S: Simd>(s: S, plane: &Near<'_>, to: &mut LinePerRow<'_>) {
    let length = plane.0[0].len();
    let plane = cut!(plane, length);
    let to = cut!(mut to, length);
    for i in 0..length {
        for lane in (0..WIDTH).step_by(S::F32_LANES) {
            let x = near!(d => V::load(s, &plane[d][i][lane..]));
            let sums = convolved(s, &x);
            for row in 0..TOGETHER {
                sums[row].store(&mut to[row][i][lane..]);
            }
        }
    }
}

/// Convolves a plane and its square vertically.
#[inline(always)]
pub(super) fn vertical_with_square<S: Simd>(
    s: S,
    plane: &Near<'_>,
    [to, square]: [&mut LinePerRow<'_>; 2],
) {
    let length = plane.0[0].len();
    let plane = cut!(plane, length);
    let (to, square) = (cut!(mut to, length), cut!(mut square, length));
    for i in 0..length {
        for lane in (0..WIDTH).step_by(S::F32_LANES) {
            let x = near!(d => V::load(s, &plane[d][i][lane..]));
            let sums = convolved(s, &x);
            let x = near!(d => x[d] * x[d]);
            let squares = convolved(s, &x);
            for row in 0..TOGETHER {
                sums[row].store(&mut to[row][i][lane..]);
                squares[row].store(&mut square[row][i][lane..]);
            }
        }
    }
}

/// Convolves p and p·(p + q) vertically, for two planes p and q.
#[inline(always)]
pub(super) fn vertical_with_product<S: Simd>(
    s: S,
    [plane, other]: [&Near<'_>; 2],
    [to, product]: [&mut LinePerRow<'_>; 2],
) {
    let length = plane.0[0].len();
    let (plane, other) = (cut!(plane, length), cut!(other, length));
    let (to, product) = (cut!(mut to, length), cut!(mut product, length));
    for i in 0..length {
        for lane in (0..WIDTH).step_by(S::F32_LANES) {
            let x = near!(d => V::load(s, &plane[d][i][lane..]));
            let sums = convolved(s, &x);
            let x = near!(d => x[d] * (x[d] + V::load(s, &other[d][i][lane..])));
            let products = convolved(s, &x);
            for row in 0..TOGETHER {
                sums[row].store(&mut to[row][i][lane..]);
                products[row].store(&mut product[row][i][lane..]);
            }
        }
    }
}

/// Convolves `N` vectors of a padded line horizontally, at most [`TOGETHER`], in the lanes from
/// `lane` on. `around` are the `M` = `N` + 2·[`REACH`] vectors within reach.
#[inline(always)]
pub(super) fn horizontal<S: Simd, const N: usize, const M: usize>(
    s: S,
    around: &[[f32; WIDTH]; M],
    lane: usize,
) -> [V<S>; N] {
    const { assert!(N <= TOGETHER && M == N + 2 * REACH) };
    // Vectors from index M on are not within reach.
    let x = near!(d => V::load(s, &around[if d < M { d } else { 0 }][lane..]));
    let mut sums = [V::zero(s); N];
    for (n, sum) in sums.iter_mut().enumerate() {
        *sum = convolved_at(s, &x, n);
    }
    sums
}

#[cfg(test)]
#[expect(clippy::float_cmp, reason = "pixels are only moved")]
mod tests {
    use super::*;

    #[test]
    fn pixels_are_arranged_and_restored() {
        for width in [1, 17, 64, 100, 128, 200, 256, 257, 1000] {
            let segments = Segments::new(width);
            let stride = segments.stride();
            assert!(stride >= width.next_multiple_of(WIDTH) && segments.length > REACH);
            let pixels: Vec<f32> = (0..stride).map(|i| i as f32).collect();
            let mut line = vec![[-1.0; WIDTH]; segments.padded()];
            segments.arrange(&pixels, &mut line[REACH..][..segments.length]);
            let inner = line[REACH..][..segments.length].to_vec();
            for (x, &pixel) in pixels.iter().enumerate() {
                let [vector, lane] = segments.place(x);
                assert_eq!(inner[vector][lane], pixel);
            }
            let mut restored = vec![-1.0; stride];
            segments.restore(&inner, &mut restored);
            assert_eq!(restored, pixels);
            // In each lane, the vector `d` places farther on has the pixel `d` places to the right.
            segments.pad(&mut line, 0.5);
            for (d, vector) in line.iter().enumerate() {
                for (lane, first) in segments.firsts().into_iter().enumerate() {
                    let x = first + d as f32 - REACH as f32;
                    let inside = x >= 0.0 && x < stride as f32;
                    let expected = if inside { x } else { 0.5 };
                    assert_eq!(vector[lane], expected, "{width} px: {d}, lane {lane}");
                }
            }
        }
    }
}
