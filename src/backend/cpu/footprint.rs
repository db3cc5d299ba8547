//! Which tiles a splat's ellipse (where alpha is at least what is blended, 1/255 by default) touches.
//!
//! Per row of tiles, the ellipse's leftmost and rightmost points within that row bound the tiles: no
//! tile is listed whose pixels it does not come near. The answer is kept as a few bits, since it is
//! needed twice, to count the entries and to emit them.

use std::ops::Range;

use super::project::Splat;
use super::tiles::{Grid, TILE};

/// Slack for the bounds of an ellipse [px]: their rounding errors, f32's at 16,384 px, are far less
/// relative to the ellipse's size, and a pixel missed at the bound has the least alpha that is blended.
const SLACK: f32 = 0.02;

/// The tiles of a band that a row touches, as a number of the first and a bit for each of those to
/// its right and below, [`REACH_X`] × [`REACH_Y`] of them; or [`FAR`](Self::FAR).
#[derive(Clone, Copy, PartialEq, Eq)]
pub(super) struct Footprint(pub(super) [u32; 2]);

const REACH_X: usize = 8;
const REACH_Y: usize = 4;

impl Footprint {
    /// The row reaches farther than the bits do: its ellipse must be evaluated again.
    const FAR: Self = Self([u32::MAX, 0]);

    /// Calls `f` with the number, relative to the band, of every tile of the band that the splat's
    /// ellipse touches, in ascending order.
    #[inline]
    pub(super) fn new(
        splat: &Splat,
        grid: &Grid,
        band: &Range<usize>,
        mut f: impl FnMut(usize),
    ) -> Self {
        let reach = Reach::new(splat, grid, band);
        let fits = reach.x1 - reach.x0 < REACH_X && reach.y1 - reach.y0 <= REACH_Y;
        let corner = reach.y0 * grid.columns + reach.x0;
        let mut bits = 0_u32;
        reach.for_each_tile(splat, grid, band, |tx, ty| {
            if fits {
                bits |= 1 << ((ty - reach.y0) * REACH_X + tx - reach.x0);
            }
            f(ty * grid.columns + tx - band.start);
        });
        if fits { Self([corner as u32, bits]) } else { Self::FAR }
    }

    /// Does the same again.
    #[inline]
    pub(super) fn for_each_tile(
        self,
        splat: &Splat,
        grid: &Grid,
        band: &Range<usize>,
        mut f: impl FnMut(usize),
    ) {
        if self == Self::FAR {
            Self::new(splat, grid, band, f);
            return;
        }
        let Self([corner, mut bits]) = self;
        while bits != 0 {
            let bit = bits.trailing_zeros() as usize;
            bits &= bits - 1;
            f(corner as usize + bit / REACH_X * grid.columns + bit % REACH_X - band.start);
        }
    }
}

/// The rectangle of tiles around a splat's ellipse: columns `x0..=x1`, and rows `y0..y1` of those
/// that the band has.
struct Reach {
    x0: usize,
    x1: usize,
    y0: usize,
    y1: usize,
    /// Whether the rectangle is one tile wide or high, and so without corners to cut.
    narrow: bool,
}

impl Reach {
    #[inline]
    fn new(splat: &Splat, grid: &Grid, band: &Range<usize>) -> Self {
        let [mx, my] = splat.mean;
        let [hw, hh] = half_sides(splat);
        let (x0, x1) = (tile_of(mx - hw - 0.5, grid.columns), tile_of(mx + hw - 0.5, grid.columns));
        let (y0, y1) = (tile_of(my - hh - 0.5, grid.rows), tile_of(my + hh - 0.5, grid.rows));
        let (first_row, last_row) = (band.start / grid.columns, band.end.div_ceil(grid.columns));
        let narrow = x0 == x1 || y0 == y1;
        let y0 = y0.max(first_row);
        Self { x0, x1, y0, y1: (y1 + 1).min(last_row).max(y0), narrow }
    }

    /// Calls `f` with column and row of every tile of the band that the ellipse touches, row by row.
    #[inline]
    fn for_each_tile(
        &self,
        splat: &Splat,
        grid: &Grid,
        band: &Range<usize>,
        mut f: impl FnMut(usize, usize),
    ) {
        let Self { x0, x1, y0, y1, narrow } = *self;
        // In folded units the ellipse is u² + z² <= reach, u = l1·(dx − shear·dy), z = l3·dy. Its
        // rightmost point is at dy = peak, its leftmost at dy = −peak.
        let Splat { mean: [mx, my], shear, l3, inv_l1, peak, reach, .. } = *splat;
        let [hw, hh] = half_sides(splat);
        for ty in y0..y1 {
            let (mut from, mut to) = (x0, x1);
            if !narrow {
                let top = ((ty * TILE) as f32 + 0.5 - my).max(-hh);
                let bottom = ((ty * TILE + TILE) as f32 - 0.5 - my).min(hh);
                let half = |dy: f32| (reach - (l3 * dy) * (l3 * dy)).max(0.0).sqrt() * inv_l1;
                let right_at = peak.max(top).min(bottom);
                let left_at = (-peak).max(top).min(bottom);
                let right = (shear * right_at + half(right_at)).min(hw);
                let left = (shear * left_at - half(left_at)).max(-hw);
                let (right, left) =
                    (right + 1e-4 * right.abs() + SLACK, left - 1e-4 * left.abs() - SLACK);
                from = tile_of(mx + left - 0.5, grid.columns).max(x0);
                to = tile_of(mx + right - 0.5, grid.columns).min(x1);
            }
            for tx in from..=to {
                if band.contains(&(ty * grid.columns + tx)) {
                    f(tx, ty);
                }
            }
        }
    }
}

/// Half the sides of the rectangle around a splat's ellipse [px], with slack.
#[inline(always)]
fn half_sides(splat: &Splat) -> [f32; 2] {
    [splat.half_width * 1.0001 + SLACK, splat.half_height * 1.0001 + SLACK]
}

/// Index of the tile whose pixel centres are the first at or after (last at or before) a bound.
/// `as` saturates, and makes NaN 0.
#[inline(always)]
fn tile_of(x: f32, most: usize) -> usize {
    ((x * (1.0 / TILE as f32)).max(0.0) as usize).min(most - 1)
}
