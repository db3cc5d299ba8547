//! Stage 3: tile lists to pixels. Front to back alpha blending (Kerbl et al. 2023, section 3 and
//! appendix C): alpha = min(0.99, o·exp(−p)), skipped below 1/255; a pixel stops, without that
//! splat, where its transmittance would fall to 1e-4 or below.
//!
//! One tile at a time, and within it one row of sixteen pixels per splat at a time. Per row the
//! exponent is a parabola in x: u = l1·x + c, e = e₀ − u² (base 2, opacity folded in), so that a
//! pixel costs two operations before its exp2. A bit per row says whether any of its pixels still
//! takes light.

use std::sync::atomic::AtomicU64;

use pulp::{Simd, WithSimd};

use super::project::{LOG2_255, Splat};
use super::simd::{V, WIDTH, each};
use super::tiles::{Entry, Grid, TILE};

/// Largest alpha: keeps 1 − alpha, and so the transmittance, recoverable.
pub(super) const ALPHA_MAX: f32 = 0.99;
/// A pixel stops before its transmittance reaches this.
const TRANSMITTANCE_MIN: f32 = 1e-4;
/// Splats copied side by side before use, so that their cache misses overlap.
pub(super) const BATCH: usize = 32;

/// Planes of a rendered tile: red, green, blue, final transmittance, depth.
pub(super) const CANVAS_PLANES: usize = 5;
pub(super) const TRANSMITTANCE: usize = 3;
pub(super) const DEPTH: usize = 4;

/// The pixels of one tile, row by row.
pub(super) type Plane = [[f32; WIDTH]; TILE];
/// A plane of zeros.
pub(super) const DARK: Plane = [[0.0; WIDTH]; TILE];

/// One rendered tile.
#[derive(Debug, Clone)]
#[repr(C, align(64))]
pub(super) struct TileCanvas {
    /// Red, green, blue (background included), final transmittance, depth.
    pub(super) planes: [Plane; CANVAS_PLANES],
    /// Place in the tile's list at which each pixel stopped; `u32::MAX` if it did not.
    pub(super) stop: [[u32; WIDTH]; TILE],
}

impl TileCanvas {
    pub(super) const EMPTY: Self =
        Self { planes: [DARK; CANVAS_PLANES], stop: [[u32::MAX; WIDTH]; TILE] };
}

/// Where a tile lies in the image.
#[derive(Debug, Clone, Copy)]
pub(super) struct TilePlace {
    /// Its upper left corner `[px]`.
    pub(super) x: f32,
    pub(super) y: f32,
    /// Its pixels inside the image.
    pub(super) width: usize,
    pub(super) height: usize,
}

impl TilePlace {
    pub(super) fn new(grid: &Grid, tile: usize) -> Self {
        let (x, y) = (tile % grid.columns * TILE, tile / grid.columns * TILE);
        Self {
            x: x as f32,
            y: y as f32,
            width: TILE.min(grid.width - x),
            height: TILE.min(grid.height - y),
        }
    }
}

/// A splat in one tile: everything that is constant along a row of pixels.
#[repr(align(64))]
pub(super) struct Rows {
    /// Bit y: row y may hold a pixel with alpha >= 1/255.
    pub(super) mask: u32,
    /// e₀ per row.
    pub(super) top: [f32; WIDTH],
    /// c per row.
    pub(super) offset: [f32; WIDTH],
    /// z = l3·dy per row.
    pub(super) z: [f32; WIDTH],
}

impl Rows {
    pub(super) const EMPTY: Self =
        Self { mask: 0, top: [0.0; WIDTH], offset: [0.0; WIDTH], z: [0.0; WIDTH] };

    #[inline(always)]
    pub(super) fn set<S: Simd>(&mut self, s: S, splat: &Splat, place: &TilePlace) {
        let c = |x: f32| V::splat(s, x);
        let (mx, my) = (splat.mean[0] - place.x, splat.mean[1] - place.y);
        self.mask = 0;
        for at in (0..WIDTH).step_by(S::F32_LANES) {
            let dy = V::load(s, &CENTRES[at..]) - my;
            let z = dy * splat.l3;
            let top = z.neg_mul_add(z, c(splat.log2_opacity));
            let shift = c(splat.shear).mul_add(dy, c(mx));
            z.store(&mut self.z[at..]);
            top.store(&mut self.top[at..]);
            (shift * -splat.l1).store(&mut self.offset[at..]);
            // Least |x − shift| of the tile's pixel centres, ½ … 15½, with slack for rounding.
            let nearest = ((shift - 8.0).abs() * 0.9999 - 7.51).max(V::zero(s)) * splat.l1;
            let reached = (nearest * nearest).le(top + (LOG2_255 + 1e-3));
            self.mask |= reached.bits() << at;
        }
    }
}

/// Pixel centres within a tile.
pub(super) const CENTRES: [f32; WIDTH] = {
    let mut centres = [0.5; WIDTH];
    let mut i = 0;
    while i < WIDTH {
        centres[i] = i as f32 + 0.5;
        i += 1;
    }
    centres
};

/// Renders one tile.
pub(super) struct Rasterize<'a> {
    pub(super) splats: &'a [Splat],
    /// Sorted.
    pub(super) list: &'a [AtomicU64],
    pub(super) place: TilePlace,
    pub(super) background: [f32; 3],
    pub(super) with_depth: bool,
    pub(super) canvas: &'a mut TileCanvas,
}

impl WithSimd for Rasterize<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, s: S) {
        if self.with_depth { self.run::<S, true>(s) } else { self.run::<S, false>(s) }
    }
}

impl Rasterize<'_> {
    #[inline(always)]
    fn run<S: Simd, const WITH_DEPTH: bool>(self, s: S) {
        let Self { splats, list, place, background, canvas, .. } = self;
        let c = |x: f32| V::splat(s, x);
        let TileCanvas { planes, stop } = canvas;
        let [red, green, blue, finished, depth] = planes;
        for plane in [&mut *red, &mut *green, &mut *blue, &mut *finished, &mut *depth] {
            *plane = DARK;
        }
        *stop = [[u32::MAX; WIDTH]; TILE];
        // Transmittance while the pixel takes light; 0 once it has stopped (its last value is then
        // in `finished`) and from the start outside the image.
        let mut light = Aligned(DARK);
        let light = &mut light.0;
        for row in &mut light[..place.height] {
            row[..place.width].fill(1.0);
        }
        let mut alive = (1_u32 << place.height) - 1;
        let mut batch = [Splat::default(); BATCH];
        let mut rows = Rows::EMPTY;

        'list: for (n, chunk) in list.chunks(BATCH).enumerate() {
            for (splat, entry) in batch.iter_mut().zip(chunk) {
                *splat = splats[Entry::load(entry).row];
            }
            for (i, splat) in batch[..chunk.len()].iter().enumerate() {
                rows.set(s, splat, &place);
                let mut todo = rows.mask & alive;
                let l1 = c(splat.l1);
                let colour = each!(i in 3 => c(splat.colour[i]));
                let z = c(splat.depth);
                while todo != 0 {
                    // The mask has sixteen bits; saying so again spares every load its bounds check.
                    let y = todo.trailing_zeros() as usize % TILE;
                    todo &= todo - 1;
                    let (top, offset) = (c(rows.top[y]), c(rows.offset[y]));
                    for at in (0..WIDTH).step_by(S::F32_LANES) {
                        let u = l1.mul_add(V::load(s, &CENTRES[at..]), offset);
                        let e = u.neg_mul_add(u, top);
                        let seen = c(-LOG2_255).le(e);
                        let alpha = e.exp2().min(c(ALPHA_MAX));
                        let t = V::load(s, &light[y][at..]);
                        let next = alpha.neg_mul_add(t, t);
                        let goes_on = c(TRANSMITTANCE_MIN).lt(next).and(seen);
                        let w = goes_on.keep(alpha * t);
                        blend(s, w, colour[0], &mut red[y][at..]);
                        blend(s, w, colour[1], &mut green[y][at..]);
                        blend(s, w, colour[2], &mut blue[y][at..]);
                        if WITH_DEPTH {
                            blend(s, w, z, &mut depth[y][at..]);
                        }
                        goes_on.select(next, t).store(&mut light[y][at..]);
                        let stops = next.le(c(TRANSMITTANCE_MIN)).and(seen).and(V::zero(s).lt(t));
                        if stops.any() {
                            let place_in_list = (n * BATCH + i) as u32;
                            stop_pixels(
                                &mut light[y][at..at + S::F32_LANES],
                                &mut finished[y][at..],
                                &mut stop[y][at..],
                                stops.keep(c(1.0)),
                                place_in_list,
                            );
                            #[expect(
                                clippy::float_cmp,
                                reason = "who has stopped has exactly none"
                            )]
                            let all_stopped = light[y] == [0.0; WIDTH];
                            if all_stopped {
                                alive &= !(1 << y);
                            }
                        }
                    }
                }
                if alive == 0 {
                    break 'list;
                }
            }
        }
        for y in 0..TILE {
            for at in (0..WIDTH).step_by(S::F32_LANES) {
                let t = V::load(s, &light[y][at..]).max(V::load(s, &finished[y][at..]));
                t.store(&mut finished[y][at..]);
                blend(s, t, c(background[0]), &mut red[y][at..]);
                blend(s, t, c(background[1]), &mut green[y][at..]);
                blend(s, t, c(background[2]), &mut blue[y][at..]);
            }
        }
    }
}

/// plane += w·x.
#[inline(always)]
fn blend<S: Simd>(s: S, w: V<S>, x: V<S>, plane: &mut [f32]) {
    w.mul_add(x, V::load(s, plane)).store(plane);
}

#[repr(align(64))]
pub(super) struct Aligned(pub(super) Plane);

/// Takes the pixels marked in `stops` out of the light: at most once per pixel, so a plain loop.
#[cold]
#[inline(never)]
fn stop_pixels_cold(
    light: &mut [f32],
    finished: &mut [f32],
    stop: &mut [u32],
    stops: &[f32; WIDTH],
    place_in_list: u32,
) {
    for (lane, t) in light.iter_mut().enumerate() {
        if stops[lane] != 0.0 {
            finished[lane] = std::mem::take(t);
            stop[lane] = place_in_list;
        }
    }
}

#[inline(always)]
fn stop_pixels<S: Simd>(
    light: &mut [f32],
    finished: &mut [f32],
    stop: &mut [u32],
    stops: V<S>,
    place_in_list: u32,
) {
    let mut lanes = [0.0; WIDTH];
    stops.store(&mut lanes);
    stop_pixels_cold(light, finished, stop, &lanes, place_in_list);
}
