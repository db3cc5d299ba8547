//! The tiles that a splat's ellipse covers. The ellipse is the region where alpha is at least the blending threshold,
//! 1/255 by default.
//!
//! In each row of tiles, the ellipse's leftmost and rightmost points bound the tiles, so that only tiles with pixels
//! near the ellipse are listed. The result is stored as a few bits, which the projection computes for a
//! vector of splats at a time. If an ellipse is too large for these bits, its tiles are found one by one, by the same
//! function on one lane.

use std::ops::Range;

use pulp::{Scalar, Simd};

use super::project::Splat;
use super::simd::{Mask, V};
use super::tiles::{Grid, TILE};

/// Slack for the bounds of an ellipse `[px]`. The rounding errors of f32 are far smaller, even at 16,384 px, and a
/// pixel missed at the bound would have the smallest alpha that is blended.
const SLACK: f32 = 0.02;

/// The tiles of a band (consecutive tiles whose lists are in memory) that a splat covers: the number of a tile, and a
/// bit for each of the [`REACH_X`] × [`REACH_Y`] tiles from it to the right and down; or
/// [`TOO_LARGE`](Self::TOO_LARGE).
#[derive(Clone, Copy, PartialEq, Eq)]
pub(super) struct Footprint(pub(super) [u32; 2]);

const REACH_X: usize = 8;
const REACH_Y: usize = 4;
const _: () = assert!(REACH_X * REACH_Y == 32, "bits of a footprint");

impl Footprint {
    /// The splat is larger than the bits allow: its ellipse must be evaluated again.
    const TOO_LARGE: Self = Self([u32::MAX, 0]);

    /// Finds the footprint, and calls `f` with the number, relative to the band, of every tile that the splat covers,
    /// in ascending order.
    #[inline]
    pub(super) fn new(
        splat: &Splat,
        grid: &Grid,
        band: &Range<usize>,
        f: impl FnMut(usize),
    ) -> Self {
        if splat.tiles == 0 {
            tiles_of_large_splat(splat, grid, band, f);
            return Self::TOO_LARGE;
        }
        let [x, y] =
            Ellipse::<Scalar>::new(splat).first_tile(grid).map(|first| first.lane() as usize);
        let corner = y * grid.columns + x;
        let mut bits = splat.tiles;
        if band.len() < grid.tiles() {
            for bit in 0..u32::BITS as usize {
                if !band.contains(&(corner + bit / REACH_X * grid.columns + bit % REACH_X)) {
                    bits &= !(1 << bit);
                }
            }
        }
        let footprint = Self([corner as u32, bits]);
        footprint.for_each_tile(splat, grid, band, f);
        footprint
    }

    /// Calls `f` with the same tiles as [`new`](Self::new).
    #[inline]
    pub(super) fn for_each_tile(
        self,
        splat: &Splat,
        grid: &Grid,
        band: &Range<usize>,
        mut f: impl FnMut(usize),
    ) {
        if self == Self::TOO_LARGE {
            tiles_of_large_splat(splat, grid, band, f);
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

/// Calls `f` with the tiles of a splat that is too large for the bits of a footprint.
#[inline(never)]
fn tiles_of_large_splat(splat: &Splat, grid: &Grid, band: &Range<usize>, mut f: impl FnMut(usize)) {
    let ellipse = Ellipse::<Scalar>::new(splat);
    let bounds = ellipse.bounds(grid);
    let (first, last) = (band.start / grid.columns, band.end.div_ceil(grid.columns));
    let [_, [y0, y1]] = bounds.sides;
    for ty in first.max(y0.lane() as usize)..last.min(y1.lane() as usize + 1) {
        let [from, to] = ellipse.columns_in(&bounds, V::splat(Scalar, ty as f32), grid);
        for tx in from.lane() as usize..=to.lane() as usize {
            let tile = ty * grid.columns + tx;
            if band.contains(&tile) {
                f(tile - band.start);
            }
        }
    }
}

/// The ellipses of several splats. With the scaled conic an ellipse is u² + z² <= reach, u = l1·(dx − shear·dy),
/// z = l3·dy. Its rightmost point is at dy = peak, its leftmost at dy = −peak. See [`Splat`].
pub(super) struct Ellipse<S: Simd> {
    pub(super) s: S,
    pub(super) mean: [V<S>; 2],
    pub(super) half_sides: [V<S>; 2],
    pub(super) shear: V<S>,
    pub(super) l3: V<S>,
    pub(super) inv_l1: V<S>,
    pub(super) peak: V<S>,
    pub(super) reach: V<S>,
}

/// The bounding rectangle of an ellipse, in tiles.
struct Bounds<S: Simd> {
    /// First and last column, first and last row: whole numbers.
    sides: [[V<S>; 2]; 2],
    /// True if the rectangle is more than one tile wide and high, so that its corners may be outside the ellipse.
    wide: Mask<S>,
}

impl Ellipse<Scalar> {
    #[inline(always)]
    fn new(splat: &Splat) -> Self {
        let c = |x| V::splat(Scalar, x);
        Self {
            s: Scalar,
            mean: [c(splat.mean[0]), c(splat.mean[1])],
            half_sides: [c(splat.half_width), c(splat.half_height)],
            shear: c(splat.shear),
            l3: c(splat.l3),
            inv_l1: c(splat.inv_l1),
            peak: c(splat.peak),
            reach: c(splat.reach),
        }
    }
}

impl<S: Simd> Ellipse<S> {
    /// Half the sides of the bounding rectangle `[px]`, with slack.
    #[inline(always)]
    fn half(&self) -> [V<S>; 2] {
        let [w, h] = self.half_sides;
        [w * 1.0001 + SLACK, h * 1.0001 + SLACK]
    }

    /// Column and row of the first tile of the bounding rectangle.
    #[inline(always)]
    fn first_tile(&self, grid: &Grid) -> [V<S>; 2] {
        let ([x, y], [hw, hh]) = (self.mean, self.half());
        [tile_of(x - hw - 0.5, grid.columns), tile_of(y - hh - 0.5, grid.rows)]
    }

    #[inline(always)]
    fn bounds(&self, grid: &Grid) -> Bounds<S> {
        let ([x, y], [hw, hh]) = (self.mean, self.half());
        let [x0, y0] = self.first_tile(grid);
        let x1 = tile_of(x + hw - 0.5, grid.columns);
        let y1 = tile_of(y + hh - 0.5, grid.rows);
        Bounds { sides: [[x0, x1], [y0, y1]], wide: x0.lt(x1).and(y0.lt(y1)) }
    }

    /// First and last tile that the ellipse covers in row `ty` of tiles; none if the first is greater.
    #[inline(always)]
    fn columns_in(&self, bounds: &Bounds<S>, ty: V<S>, grid: &Grid) -> [V<S>; 2] {
        let Self { mean: [mx, my], shear, peak, .. } = *self;
        let Bounds { sides: [[x0, x1], _], wide } = *bounds;
        let [hw, hh] = self.half();
        let top = (ty * TILE as f32 + 0.5 - my).max(-hh);
        let bottom = (ty * TILE as f32 + (TILE as f32 - 0.5) - my).min(hh);
        let right_at = peak.max(top).min(bottom);
        let left_at = (-peak).max(top).min(bottom);
        let right = (shear * right_at + self.half_width_at(right_at)).min(hw);
        let left = (shear * left_at - self.half_width_at(left_at)).max(-hw);
        let right = right + right.abs() * 1e-4 + SLACK;
        let left = left - left.abs() * 1e-4 - SLACK;
        let from = tile_of(mx + left - 0.5, grid.columns).max(x0);
        let to = tile_of(mx + right - 0.5, grid.columns).min(x1);
        [wide.select(from, x0), wide.select(to, x1)]
    }

    #[inline(always)]
    fn half_width_at(&self, dy: V<S>) -> V<S> {
        let z = self.l3 * dy;
        (self.reach - z * z).max(V::zero(self.s)).sqrt() * self.inv_l1
    }

    /// The bits of a [`Footprint`] per lane; 0 if it is too large for them.
    #[inline(always)]
    pub(super) fn tiles(&self, grid: &Grid) -> S::u32s {
        let s = self.s;
        let bounds = self.bounds(grid);
        let [[x0, x1], [y0, y1]] = bounds.sides;
        let fits = (x1 - x0).lt(V::splat(s, REACH_X as f32));
        let fits = fits.and((y1 - y0).lt(V::splat(s, REACH_Y as f32)));
        let mut bits = s.splat_u32s(0);
        for row in 0..REACH_Y {
            let ty = y0 + row as f32;
            let within = fits.and(ty.le(y1));
            if !within.any() {
                break;
            }
            let [from, to] = self.columns_in(&bounds, ty, grid);
            let touched = within.and(from.le(to));
            // One bit per tile, starting at the first.
            let above = s.wrapping_dyn_shl_u32s(s.splat_u32s(2), (to - x0).whole());
            let below = s.wrapping_dyn_shl_u32s(s.splat_u32s(1), (from - x0).whole());
            let ones = s.sub_u32s(above, below);
            let ones = s.wrapping_dyn_shl_u32s(ones, s.splat_u32s((row * REACH_X) as u32));
            bits = s.or_u32s(bits, touched.select_u32s(ones, s.splat_u32s(0)));
        }
        bits
    }
}

/// The index of the tile that contains a bound, clamped to `tiles`; `x` is relative to the first pixel centre `[px]`.
///
/// Rounds down by adding 2²³, above which f32 has only whole numbers.
#[inline(always)]
fn tile_of<S: Simd>(x: V<S>, tiles: usize) -> V<S> {
    let c = |number| V::splat_like(x, number);
    let x = (x * (1.0 / TILE as f32)).max(c(0.0)).min(c((tiles - 1) as f32));
    let nearest = (x + 8_388_608.0) - 8_388_608.0;
    x.lt(nearest).select(nearest - 1.0, nearest)
}

#[cfg(test)]
mod tests {
    use pulp::WithSimd;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::super::InstructionSet;
    use super::super::simd::WIDTH;
    use super::*;

    /// Computes the footprint bits of sixteen splats.
    struct Tiles<'a>(&'a [Splat], &'a Grid);

    impl WithSimd for Tiles<'_> {
        type Output = [u32; WIDTH];

        #[inline(always)]
        fn with_simd<S: Simd>(self, s: S) -> [u32; WIDTH] {
            let Self(splats, grid) = self;
            let lanes = |at: usize, field: fn(&Splat) -> f32| {
                let values: Vec<f32> = splats.iter().map(field).collect();
                V::load(s, &values[at..])
            };
            let mut bits = [0.0; WIDTH];
            for at in (0..WIDTH).step_by(S::F32_LANES) {
                let ellipse = Ellipse {
                    s,
                    mean: [lanes(at, |splat| splat.mean[0]), lanes(at, |splat| splat.mean[1])],
                    half_sides: [
                        lanes(at, |splat| splat.half_width),
                        lanes(at, |splat| splat.half_height),
                    ],
                    shear: lanes(at, |splat| splat.shear),
                    l3: lanes(at, |splat| splat.l3),
                    inv_l1: lanes(at, |splat| splat.inv_l1),
                    peak: lanes(at, |splat| splat.peak),
                    reach: lanes(at, |splat| splat.reach),
                };
                V::of_bits(s, ellipse.tiles(grid)).store(&mut bits[at..]);
            }
            bits.map(f32::to_bits)
        }
    }

    /// A needle or a disc near the image, of up to `size` `[px]`.
    fn splat(rng: &mut ChaCha8Rng, grid: &Grid, size: f32) -> Splat {
        let mut between = |from: f32, to: f32| rng.random_range(from..to);
        let mean = [grid.width, grid.height].map(|side| between(-40.0, side as f32 + 40.0));
        let (long, short) = (between(0.5, size), between(0.5, 0.3 * size));
        let (sin, cos) = between(0.0, 6.3).sin_cos();
        let a = (long * cos).powi(2) + (short * sin).powi(2);
        let b = (long * long - short * short) * sin * cos;
        let d = (long * sin).powi(2) + (short * cos).powi(2);
        let reach = between(0.1, 8.0);
        let (l1, half_width) = ((d / (a * d - b * b)).sqrt(), (reach * a).sqrt());
        Splat {
            mean,
            l1,
            shear: b / d,
            l3: 1.0 / d.sqrt(),
            half_height: (reach * d).sqrt(),
            half_width,
            inv_l1: 1.0 / l1,
            peak: b / a * half_width,
            reach,
            ..Splat::default()
        }
    }

    fn listed(splat: &Splat, grid: &Grid, band: Range<usize>) -> Vec<usize> {
        let (mut once, mut again) = (Vec::new(), Vec::new());
        let footprint = Footprint::new(splat, grid, &band, |tile| once.push(tile + band.start));
        footprint.for_each_tile(splat, grid, &band, |tile| again.push(tile + band.start));
        assert_eq!(once, again, "{splat:?}");
        once
    }

    #[test]
    fn footprint_bits_list_the_tiles_that_are_found_one_by_one() {
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        let (mut large, mut cut) = (0, 0);
        for (width, height, size) in
            [(200, 300, 12.0), (200, 300, 60.0), (17, 3, 30.0), (900, 40, 20.0)]
        {
            let grid = Grid::new(width, height);
            for _ in 0..200 {
                let mut splats: Vec<Splat> =
                    (0..WIDTH).map(|_| splat(&mut rng, &grid, size)).collect();
                let bits = InstructionSet::Scalar.arch().dispatch(Tiles(&splats, &grid));
                for set in InstructionSet::available() {
                    assert_eq!(set.arch().dispatch(Tiles(&splats, &grid)), bits, "{set}");
                }
                for (splat, bits) in splats.iter_mut().zip(bits) {
                    let one_by_one = listed(splat, &grid, 0..grid.tiles());
                    splat.tiles = bits;
                    assert_eq!(listed(splat, &grid, 0..grid.tiles()), one_by_one, "{splat:?}");
                    large += usize::from(bits == 0 && !one_by_one.is_empty());
                    let Bounds { sides: [[x0, x1], [y0, y1]], .. } =
                        Ellipse::<Scalar>::new(splat).bounds(&grid);
                    let rectangle = (x1.lane() - x0.lane() + 1.0) * (y1.lane() - y0.lane() + 1.0);
                    cut += usize::from(one_by_one.len() < rectangle as usize);
                    // Bands that begin and end within rows of tiles.
                    let (a, b) = (grid.tiles() / 3, grid.tiles() / 2);
                    let parts = [0..a, a..b, b..grid.tiles()];
                    let of_bands = parts.map(|band| listed(splat, &grid, band)).concat();
                    assert_eq!(of_bands, one_by_one, "{splat:?}");
                }
            }
        }
        assert!(large > 100 && cut > 1000, "{large} too large, {cut} with corners cut");
    }

    /// No tile with a pixel inside the ellipse is left out.
    #[test]
    fn every_tile_with_a_pixel_of_the_ellipse_is_listed() {
        let mut rng = ChaCha8Rng::seed_from_u64(4);
        let grid = Grid::new(130, 100);
        for size in [5.0, 50.0] {
            for _ in 0..200 {
                let splat = splat(&mut rng, &grid, size);
                let tiles = listed(&splat, &grid, 0..grid.tiles());
                for y in 0..grid.height {
                    for x in 0..grid.width {
                        let dx = x as f32 + 0.5 - splat.mean[0];
                        let dy = y as f32 + 0.5 - splat.mean[1];
                        let (u, z) = (splat.l1 * (dx - splat.shear * dy), splat.l3 * dy);
                        let tile = y / TILE * grid.columns + x / TILE;
                        let inside = u * u + z * z <= splat.reach;
                        assert!(!inside || tiles.contains(&tile), "pixel {x}, {y} of {splat:?}");
                    }
                }
            }
        }
    }
}
