//! Stage 3: tile lists to pixels. Front to back alpha blending (Kerbl et al. 2023, section 3 and
//! appendix C): alpha = min(0.99, o·exp(−p)), skipped below 1/255; a pixel stops, without that
//! splat, where its transmittance would fall to 1e-4 or below. Both limits are knobs ([`Blending`]).
//!
//! One tile at a time, and within it one patch of 4×4 pixels per splat at a time: a vector. Most
//! splats are a few pixels wide, and patches cover them with a third fewer vectors than rows of
//! sixteen pixels do. In the coordinates (u, z) = Lᵀ·d the exponent is e = log₂o − u² − z²; from
//! patch to patch u and z only move by a constant each. A bit per patch says whether the splat
//! reaches it, another whether any of its pixels still takes light.

use std::sync::atomic::AtomicU64;

use pulp::{Simd, WithSimd};

use super::project::Splat;
use super::simd::{V, WIDTH, each};
use super::tiles::{Entry, Grid, TILE};
use crate::backend::Shortcuts;

/// Largest alpha: keeps 1 − alpha, and so the transmittance, recoverable.
pub(super) const ALPHA_MAX: f32 = 0.99;
/// What blending takes and where it ends; forward and backward pass must have the same.
#[derive(Debug, Clone, Copy)]
pub(super) struct Blending {
    /// A splat is blended where its exponent is at least minus this.
    pub(super) log2_reach: f32,
    /// A pixel stops before its transmittance reaches this.
    pub(super) transmittance_min: f32,
}

impl From<Shortcuts> for Blending {
    fn from(shortcuts: Shortcuts) -> Self {
        let transmittance_min = shortcuts.transmittance_min;
        Self { log2_reach: shortcuts.log2_reach(), transmittance_min }
    }
}

/// Splats copied side by side before use, so that their cache misses overlap.
pub(super) const BATCH: usize = 32;

/// Planes of a rendered tile: red, green, blue, final transmittance, depth.
pub(super) const CANVAS_PLANES: usize = 5;
pub(super) const TRANSMITTANCE: usize = 3;
pub(super) const DEPTH: usize = 4;

/// Side of a patch `[px]`: its pixels are one vector, row by row.
const PATCH: usize = 4;
/// Patches along a tile's side, and, as it happens, in a vector: a tile has as many patches as a
/// patch has pixels.
const ACROSS: usize = TILE / PATCH;
pub(super) const PATCHES: usize = ACROSS * ACROSS;
const _: () = assert!(PATCH * PATCH == WIDTH && PATCHES == WIDTH);

/// The pixels of one tile, patch by patch, both row by row; see [`in_plane`].
pub(super) type Plane = [[f32; WIDTH]; PATCHES];

/// Patch and lane of a tile's pixel.
#[inline(always)]
pub(super) const fn in_plane(x: usize, y: usize) -> (usize, usize) {
    (y / PATCH * ACROSS + x / PATCH, y % PATCH * PATCH + x % PATCH)
}

/// Copies row `y` of a tile out of its plane.
#[inline(always)]
pub(super) fn row_of_plane(plane: &Plane, y: usize) -> [f32; TILE] {
    let mut row = [0.0; TILE];
    for (x, pixels) in (0..TILE).step_by(PATCH).zip(row.as_chunks_mut::<PATCH>().0) {
        let (patch, lane) = in_plane(x, y);
        pixels.copy_from_slice(&plane[patch][lane..lane + PATCH]);
    }
    row
}

/// Copies row `y` of a tile into its plane.
#[inline(always)]
pub(super) fn set_row_of_plane(plane: &mut Plane, y: usize, row: &[f32; TILE]) {
    for (x, pixels) in (0..TILE).step_by(PATCH).zip(row.as_chunks::<PATCH>().0) {
        let (patch, lane) = in_plane(x, y);
        plane[patch][lane..lane + PATCH].copy_from_slice(pixels);
    }
}

/// A plane of zeros.
pub(super) const DARK: Plane = [[0.0; WIDTH]; PATCHES];

/// One rendered tile.
#[derive(Debug, Clone)]
#[repr(C, align(64))]
pub(super) struct TileCanvas {
    /// Red, green, blue (background included), final transmittance, depth.
    pub(super) planes: [Plane; CANVAS_PLANES],
    /// Place in the tile's list at which each pixel stopped; `u32::MAX` if it did not, 0 outside the
    /// image.
    pub(super) stop: [[u32; WIDTH]; PATCHES],
}

impl TileCanvas {
    pub(super) const EMPTY: Self =
        Self { planes: [DARK; CANVAS_PLANES], stop: [[u32::MAX; WIDTH]; PATCHES] };
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

    /// 1 for the pixels inside the image, 0 for others, and a bit for each patch that has any.
    pub(super) fn inside(&self) -> (Plane, u32) {
        if self.width == TILE && self.height == TILE {
            return ([[1.0; WIDTH]; PATCHES], (1 << PATCHES) - 1);
        }
        let (mut plane, mut patches) = (DARK, 0);
        for y in 0..self.height {
            for x in 0..self.width {
                let (patch, lane) = in_plane(x, y);
                plane[patch][lane] = 1.0;
                patches |= 1 << patch;
            }
        }
        (plane, patches)
    }
}

/// A splat in one tile: everything that is constant over a patch.
#[repr(align(64))]
pub(super) struct Patches {
    /// Bit per patch: whether it may hold a pixel that the splat is blended into.
    pub(super) mask: u32,
    /// What to add to [`Within::u`] and [`Within::z`], per patch.
    pub(super) u: [f32; PATCHES],
    pub(super) z: [f32; PATCHES],
}

/// u and z of a patch's pixels relative to its upper left corner.
pub(super) struct Within<S: Simd> {
    l1: V<S>,
    /// Derivative of u by y.
    u_by_y: V<S>,
    l3: V<S>,
}

impl<S: Simd> Within<S> {
    #[inline(always)]
    pub(super) fn new(s: S, splat: &Splat) -> Self {
        let c = |x: f32| V::splat(s, x);
        Self { l1: c(splat.l1), u_by_y: c(-splat.l1 * splat.shear), l3: c(splat.l3) }
    }

    #[inline(always)]
    pub(super) fn u(&self, s: S, at: usize) -> V<S> {
        self.l1.mul_add(V::load(s, &LANE_X[at..]), self.u_by_y * V::load(s, &LANE_Y[at..]))
    }

    #[inline(always)]
    pub(super) fn z(&self, s: S, at: usize) -> V<S> {
        self.l3 * V::load(s, &LANE_Y[at..])
    }
}

impl Patches {
    pub(super) const EMPTY: Self = Self { mask: 0, u: [0.0; PATCHES], z: [0.0; PATCHES] };

    #[inline(always)]
    pub(super) fn set<S: Simd>(&mut self, s: S, splat: &Splat, place: &TilePlace) {
        let c = |x: f32| V::splat(s, x);
        let Splat { l1, shear, l3, .. } = *splat;
        let (mx, my) = (splat.mean[0] - place.x, splat.mean[1] - place.y);
        // From a patch's corner to the middle of its pixels' centres, and on to the outermost.
        let (middle, half) = (0.5 * PATCH as f32, 0.5 * (PATCH - 1) as f32);
        let (u_middle, z_middle) = (c(l1 * (1.0 - shear) * middle), c(l3 * middle));
        // With slack for rounding.
        let u_half = c(l1 * (1.0 + shear.abs()) * half * 1.0001 + 1e-3);
        let z_half = c(l3 * half * 1.0001 + 1e-3);
        self.mask = 0;
        for at in (0..WIDTH).step_by(S::F32_LANES) {
            let dy = V::load(s, &CORNER_Y[at..]) - my;
            let dx = c(shear).neg_mul_add(dy, V::load(s, &CORNER_X[at..]) - mx);
            let (u, z) = (dx * l1, dy * l3);
            u.store(&mut self.u[at..]);
            z.store(&mut self.z[at..]);
            // The least |u| and |z| of the patch.
            let u = ((u + u_middle).abs() - u_half).max(V::zero(s));
            let z = ((z + z_middle).abs() - z_half).max(V::zero(s));
            let reached = u.mul_add(u, z * z).le(c(splat.reach + 1e-3));
            self.mask |= reached.bits() << at;
        }
    }
}

/// Pixel centres within a patch, and corners of a tile's patches.
pub(super) const LANE_X: [f32; WIDTH] = grid(true, 1.0, 0.5);
pub(super) const LANE_Y: [f32; WIDTH] = grid(false, 1.0, 0.5);
pub(super) const CORNER_X: [f32; PATCHES] = grid(true, PATCH as f32, 0.0);
pub(super) const CORNER_Y: [f32; PATCHES] = grid(false, PATCH as f32, 0.0);

/// One coordinate of the points of a 4×4 grid, row by row.
const fn grid(x: bool, step: f32, first: f32) -> [f32; WIDTH] {
    let mut values = [0.0; WIDTH];
    let mut i = 0;
    while i < WIDTH {
        let index = if x { i % PATCH } else { i / PATCH };
        values[i] = index as f32 * step + first;
        i += 1;
    }
    values
}

/// Renders one tile.
pub(super) struct Rasterize<'a> {
    pub(super) splats: &'a [Splat],
    /// Sorted.
    pub(super) list: &'a [AtomicU64],
    pub(super) place: TilePlace,
    pub(super) background: [f32; 3],
    pub(super) with_depth: bool,
    pub(super) blending: Blending,
    pub(super) canvas: &'a mut TileCanvas,
}

impl WithSimd for Rasterize<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, s: S) {
        match self.with_depth {
            true => self.run::<S, true>(s),
            false => self.run::<S, false>(s),
        }
    }
}

impl Rasterize<'_> {
    #[inline(always)]
    fn run<S: Simd, const WITH_DEPTH: bool>(self, s: S) {
        let Self { splats, list, place, background, canvas, blending, .. } = self;
        let c = |x: f32| V::splat(s, x);
        let (faintest, least_light) = (c(-blending.log2_reach), c(blending.transmittance_min));
        let TileCanvas { planes, stop } = canvas;
        let [red, green, blue, finished, depth] = planes;
        for plane in [&mut *red, &mut *green, &mut *blue, &mut *finished, &mut *depth] {
            *plane = DARK;
        }
        // Transmittance while the pixel takes light; 0 once it has stopped (its last value is then
        // in `finished`) and from the start outside the image.
        let (inside, mut alive) = place.inside();
        let mut light = Aligned(inside);
        let light = &mut light.0;
        for (stop, light) in stop.as_flattened_mut().iter_mut().zip(light.as_flattened()) {
            *stop = if *light > 0.0 { u32::MAX } else { 0 };
        }
        let mut batch = [Splat::default(); BATCH];
        let mut patches = Patches::EMPTY;

        'list: for (n, chunk) in list.chunks(BATCH).enumerate() {
            for (splat, entry) in batch.iter_mut().zip(chunk) {
                *splat = splats[Entry::load(entry).row];
            }
            for (i, splat) in batch[..chunk.len()].iter().enumerate() {
                patches.set(s, splat, &place);
                let mut todo = patches.mask & alive;
                let within = Within::new(s, splat);
                let log2_opacity = c(splat.log2_opacity);
                let colour = each!(i in 3 => c(splat.colour[i]));
                let at_depth = c(splat.depth);
                while todo != 0 {
                    // The mask has sixteen bits; saying so again spares every load its bounds check.
                    let p = todo.trailing_zeros() as usize % PATCHES;
                    todo &= todo - 1;
                    let (to_u, to_z) = (c(patches.u[p]), c(patches.z[p]));
                    for at in (0..WIDTH).step_by(S::F32_LANES) {
                        let (u, z) = (within.u(s, at) + to_u, within.z(s, at) + to_z);
                        let e = u.neg_mul_add(u, z.neg_mul_add(z, log2_opacity));
                        let seen = faintest.le(e);
                        let alpha = e.exp2().min(c(ALPHA_MAX));
                        let t = V::load(s, &light[p][at..]);
                        let next = alpha.neg_mul_add(t, t);
                        let goes_on = least_light.lt(next).and(seen);
                        let w = goes_on.keep(alpha * t);
                        blend(s, w, colour[0], &mut red[p][at..]);
                        blend(s, w, colour[1], &mut green[p][at..]);
                        blend(s, w, colour[2], &mut blue[p][at..]);
                        if WITH_DEPTH {
                            blend(s, w, at_depth, &mut depth[p][at..]);
                        }
                        goes_on.select(next, t).store(&mut light[p][at..]);
                        let stops = next.le(least_light).and(seen).and(V::zero(s).lt(t));
                        if stops.any() {
                            let place_in_list = (n * BATCH + i) as u32;
                            stop_pixels(
                                &mut light[p][at..at + S::F32_LANES],
                                &mut finished[p][at..],
                                &mut stop[p][at..],
                                stops.keep(c(1.0)),
                                place_in_list,
                            );
                            #[expect(
                                clippy::float_cmp,
                                reason = "who has stopped has exactly none"
                            )]
                            let all_stopped = light[p] == [0.0; WIDTH];
                            if all_stopped {
                                alive &= !(1 << p);
                            }
                        }
                    }
                }
                if alive == 0 {
                    break 'list;
                }
            }
        }
        for p in 0..PATCHES {
            for at in (0..WIDTH).step_by(S::F32_LANES) {
                let t = V::load(s, &light[p][at..]).max(V::load(s, &finished[p][at..]));
                t.store(&mut finished[p][at..]);
                blend(s, t, c(background[0]), &mut red[p][at..]);
                blend(s, t, c(background[1]), &mut green[p][at..]);
                blend(s, t, c(background[2]), &mut blue[p][at..]);
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
