//! The window of SSIM: down the columns for a few rows of the image together, then along each row.

use std::iter::StepBy;
use std::ops::Range;

use pulp::Simd;

use super::super::simd::V;

/// Half the window.
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
/// Rows convolved vertically together: they share most of the lines within their reach, so that each
/// line is loaded 3.5 times in all, not eleven. More rows would not stay in the registers.
pub(super) const ROWS: usize = 4;
/// Lines within reach of so many rows.
const NEAR: usize = ROWS + 2 * REACH;

/// The columns of a line that are convolved, one vector after the other.
pub(super) type Columns = StepBy<Range<usize>>;
/// A line of scratch for each of the rows.
pub(super) type LinePerRow<'a> = [&'a mut [f32]; ROWS];

/// The lines of a plane within reach of `ROWS` rows; `zeros` outside the image.
pub(super) struct Near<'a>([&'a [f32]; NEAR]);

impl<'a> Near<'a> {
    /// The rows from `row` on.
    #[inline(always)]
    pub(super) fn new(plane: &'a [f32], zeros: &'a [f32], row: usize) -> Self {
        let stride = zeros.len();
        let mut lines = [zeros; NEAR];
        for (i, line) in lines.iter_mut().enumerate() {
            let from = (row + i).checked_sub(REACH).map(|y| y * stride);
            if let Some(inside) = from.and_then(|from| plane.get(from..from + stride)) {
                *line = inside;
            }
        }
        Self(lines)
    }
}

/// Does the same for each line within reach, with its number as a constant.
macro_rules! for_each_line {
    ($d:ident => $body:block) => {
        for_each_line!(@ $d 0 1 2 3 4 5 6 7 8 9 10 11 12 13 => $body)
    };
    (@ $d:ident $($value:literal)* => $body:block) => { $({ const $d: usize = $value; $body })* };
}
const _: () = assert!(NEAR == 14, "`for_each_line` has them all");

/// The weight of a line for a row; `None` beyond its reach.
const fn weight(line: usize, row: usize) -> Option<f32> {
    match line.checked_sub(row) {
        Some(at) if at < WINDOW.len() => Some(WINDOW[at]),
        _ => None,
    }
}

/// Adds `x` of line `D` to the sums of those rows that reach it.
#[inline(always)]
fn add<S: Simd, const D: usize>(s: S, sums: &mut [V<S>; ROWS], x: V<S>) {
    for (row, sum) in sums.iter_mut().enumerate() {
        if let Some(weight) = weight(D, row) {
            *sum = V::splat(s, weight).mul_add(x, *sum);
        }
    }
}

#[inline(always)]
fn store<S: Simd>(sums: [V<S>; ROWS], to: &mut LinePerRow<'_>, at: usize) {
    for row in 0..ROWS {
        sums[row].store(&mut to[row][at..]);
    }
}

/// Convolves a plane vertically.
#[inline(always)]
pub(super) fn vertical<S: Simd>(s: S, plane: &Near<'_>, columns: Columns, to: &mut LinePerRow<'_>) {
    for at in columns {
        let mut sums = [V::zero(s); ROWS];
        for_each_line!(D => { add::<S, D>(s, &mut sums, V::load(s, &plane.0[D][at..])) });
        store(sums, to, at);
    }
}

/// Convolves a plane, and its square, vertically.
#[inline(always)]
pub(super) fn vertical_with_square<S: Simd>(
    s: S,
    plane: &Near<'_>,
    columns: Columns,
    [to, square]: [&mut LinePerRow<'_>; 2],
) {
    for at in columns {
        let mut sums = [V::zero(s); ROWS];
        let mut squares = [V::zero(s); ROWS];
        for_each_line!(D => {
            let x = V::load(s, &plane.0[D][at..]);
            for (row, (sum, square)) in sums.iter_mut().zip(&mut squares).enumerate() {
                if let Some(weight) = weight(D, row) {
                    // Not w·(x·x): in a flat image that product would be off by the same at every line.
                    let weighted = x * weight;
                    *sum = *sum + weighted;
                    *square = weighted.mul_add(x, *square);
                }
            }
        });
        store(sums, to, at);
        store(squares, square, at);
    }
}

/// Convolves the product of two planes vertically.
#[inline(always)]
pub(super) fn vertical_of_product<S: Simd>(
    s: S,
    [a, b]: [&Near<'_>; 2],
    columns: Columns,
    to: &mut LinePerRow<'_>,
) {
    for at in columns {
        let mut sums = [V::zero(s); ROWS];
        for_each_line!(D => {
            let x = V::load(s, &a.0[D][at..]) * V::load(s, &b.0[D][at..]);
            add::<S, D>(s, &mut sums, x);
        });
        store(sums, to, at);
    }
}

/// Σ_k WINDOW[k]·line[at + k − 5], for one vector. The window is symmetric: pairs are added first. It is
/// cut out once, so that its eleven loads need no bounds check each.
#[inline(always)]
pub(super) fn horizontal<S: Simd>(s: S, line: &[f32], at: usize) -> V<S> {
    let around = &line[at - REACH..at + S::F32_LANES + REACH];
    let mut sum = V::load(s, &around[REACH..REACH + S::F32_LANES]) * WINDOW[REACH];
    for k in 0..REACH {
        let left = V::load(s, &around[k..k + S::F32_LANES]);
        let right = V::load(s, &around[2 * REACH - k..2 * REACH - k + S::F32_LANES]);
        sum = V::splat(s, WINDOW[k]).mul_add(left + right, sum);
    }
    sum
}
