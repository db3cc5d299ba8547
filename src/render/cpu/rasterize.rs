//! Stage 3: from tile lists to pixels. Front-to-back alpha blending (Kerbl et al. 2023, section 3 and
//! appendix C): alpha = min(0.99, o·G), with o the opacity and G the projected Gaussian; a splat with alpha below 1/255
//! is skipped. A pixel is finished before the first splat that would reduce its transmittance to 1e-4 or below. The
//! thresholds 1/255 and 1e-4 can be set ([`Blending`]).
//!
//! A task renders one tile. It processes one batch of splats after another, and for each batch one patch of 4×4 pixels
//! after another. A patch is a vector that stays in registers while the batch is blended into it. Most splats are a
//! few pixels wide, and patches cover them with a third fewer vectors than rows of sixteen pixels do. In
//! the coordinates (u, z) = Lᵀ·d the exponent is e = log₂o − u² − z²; from patch to patch u and z only
//! change by a constant each. One bit per patch marks whether the splat reaches it, another whether any of
//! its pixels is unfinished.

use std::sync::atomic::{AtomicU32, AtomicU64, Ordering::Relaxed};

use pulp::{Simd, WithSimd};

use super::batch::{BATCH, Batch};
use super::project::Splat;
use super::simd::{V, WIDTH, exp2_of, load_of, store_of};
use super::tiles::{Entry, Grid, TILE};
use crate::Shortcuts;
use crate::depth::DepthLoss;

/// The largest alpha. It keeps 1 − alpha above 0, so that the backward pass can recover transmittances by division.
pub(super) const ALPHA_MAX: f32 = 0.99;
/// The thresholds of blending, which must be the same in the forward and the backward pass.
#[derive(Debug, Clone, Copy)]
pub(super) struct Blending {
    /// A splat is blended where its exponent is at least minus this value.
    pub(super) log2_reach: f32,
    /// A pixel is finished before the first splat that would reduce its transmittance to this value or below.
    pub(super) transmittance_min: f32,
}

impl From<Shortcuts> for Blending {
    fn from(shortcuts: Shortcuts) -> Self {
        let transmittance_min = shortcuts.transmittance_min;
        Self { log2_reach: shortcuts.log2_reach(), transmittance_min }
    }
}

/// The quantity accumulated in the depth plane.
#[derive(Debug, Clone, Copy)]
pub(super) enum DepthPlane<'a> {
    /// Nothing.
    Unused,
    /// Depth, weighted as in blending.
    Depth,
    /// The number of Gaussians blended into the pixel.
    BlendedCount,
    /// Inverse depth, weighted as in blending.
    Inverse,
    /// The distance of inverse depth from the given one, weighted as in blending; where none is given, as
    /// [`Inverse`](Self::Inverse).
    Distance(DepthLoss<'a>),
}

/// Planes of a rendered tile: red, green, blue, final transmittance, depth. Before the backward pass of a step with
/// depth in its loss, [`depth_gradient`](super::depth_gradient) replaces red, green and depth.
pub(super) const CANVAS_PLANES: usize = 5;
pub(super) const TRANSMITTANCE: usize = 3;
pub(super) const DEPTH: usize = 4;

/// Side of a patch `[px]`: its pixels are one vector, row by row.
pub(super) const PATCH: usize = 4;
/// Patches along a tile's side. A tile has as many patches as a patch has pixels.
const ACROSS: usize = TILE / PATCH;
pub(super) const PATCHES: usize = ACROSS * ACROSS;
const _: () = assert!(PATCH * PATCH == WIDTH && PATCHES == WIDTH);

/// The pixels of a tile by patch and lane, both row-major; see [`in_plane`].
pub(super) type Plane = [[f32; WIDTH]; PATCHES];

/// Patch and lane of a tile's pixel.
#[inline(always)]
pub(super) const fn in_plane(x: usize, y: usize) -> (usize, usize) {
    (y / PATCH * ACROSS + x / PATCH, y % PATCH * PATCH + x % PATCH)
}

/// Copies row `y` of a tile directly to its destination, patch by patch. Returning the row by value would stall: the
/// whole row would be loaded right after the four stores that assemble it.
#[inline(always)]
pub(super) fn copy_row_of_plane(plane: &Plane, y: usize, row: &mut [f32; TILE]) {
    for (x, pixels) in (0..TILE).step_by(PATCH).zip(row.as_chunks_mut::<PATCH>().0) {
        let (patch, lane) = in_plane(x, y);
        pixels.copy_from_slice(&plane[patch][lane..lane + PATCH]);
    }
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
pub(super) const ZERO_PLANE: Plane = [[0.0; WIDTH]; PATCHES];

/// One rendered tile.
#[derive(Debug, Clone)]
#[repr(C, align(64))]
pub(super) struct TileCanvas {
    /// Red, green, blue (background included), final transmittance, depth.
    pub(super) planes: [Plane; CANVAS_PLANES],
    /// The index in the tile's list at which each pixel was finished; `u32::MAX` if it was not, 0 outside the
    /// image.
    pub(super) stop: [[u32; WIDTH]; PATCHES],
}

impl TileCanvas {
    pub(super) const EMPTY: Self =
        Self { planes: [ZERO_PLANE; CANVAS_PLANES], stop: [[u32::MAX; WIDTH]; PATCHES] };
}

/// The position of a tile in the image.
#[derive(Debug, Clone, Copy)]
pub(super) struct TilePlace {
    /// Upper left corner `[px]`.
    pub(super) x: f32,
    pub(super) y: f32,
    /// Size of the part inside the image `[px]`.
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

    /// Calls `f(patch, lane, pixel of the image)` for every pixel inside an image of this width.
    #[inline(always)]
    pub(super) fn for_each_pixel(&self, width: usize, mut f: impl FnMut(usize, usize, usize)) {
        for y in 0..self.height {
            for x in 0..self.width {
                let at = (self.y as usize + y) * width + self.x as usize + x;
                let (patch, lane) = in_plane(x, y);
                f(patch, lane, at);
            }
        }
    }

    /// A plane with 1 inside the image and 0 outside, and a bit for each patch with a pixel inside.
    pub(super) fn inside(&self) -> (Plane, u32) {
        if self.width == TILE && self.height == TILE {
            return ([[1.0; WIDTH]; PATCHES], (1 << PATCHES) - 1);
        }
        let (mut plane, mut patches) = (ZERO_PLANE, 0);
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

/// Renders one tile.
pub(super) struct Rasterize<'a> {
    pub(super) splats: &'a [Splat],
    /// The tile's entries, sorted front to back.
    pub(super) list: &'a [AtomicU64],
    pub(super) place: TilePlace,
    pub(super) background: [f32; 3],
    pub(super) depth_plane: DepthPlane<'a>,
    /// Inverse depths from which [distances](DepthPlane::Distance) are taken; 0 where none is given.
    pub(super) given: Option<&'a Plane>,
    /// The number of pixels in which each row has the largest blend weight, to which the tile adds its pixels; empty
    /// if they are not counted. The counts are integers, so that the order of tiles does not matter.
    pub(super) dominant: &'a [AtomicU32],
    pub(super) blending: Blending,
    pub(super) canvas: &'a mut TileCanvas,
    /// Scratch.
    pub(super) batch: &'a mut Batch,
}

impl WithSimd for Rasterize<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, s: S) {
        // Halves or quarters of a patch are processed in pairs, so that common values are loaded once.
        if const { matches!(S::F32_LANES, 4 | 8) } {
            self.blend_by::<S, 2>(s);
        } else {
            self.blend_by::<S, 1>(s);
        }
    }
}

/// What [`Rasterize::blend`] accumulates besides colour. Dominant pixels, which are rarely needed, come with depth.
const COLOUR: u8 = 0;
const WITH_DEPTH: u8 = 1;
const WITH_DOMINANT: u8 = 2;

impl Rasterize<'_> {
    #[inline(always)]
    fn blend_by<S: Simd, const N: usize>(self, s: S) {
        if !self.dominant.is_empty() {
            self.blend::<S, WITH_DOMINANT, N>(s);
        } else if matches!(self.depth_plane, DepthPlane::Unused) {
            self.blend::<S, COLOUR, N>(s);
        } else {
            self.blend::<S, WITH_DEPTH, N>(s);
        }
    }

    /// Blends the list into the tile, `N` vectors of a patch at a time.
    #[inline(always)]
    #[expect(clippy::too_many_lines, reason = "a numeric kernel")]
    fn blend<S: Simd, const WITH: u8, const N: usize>(self, s: S) {
        let Self { splats, list, place, background, dominant, canvas, blending, batch, .. } = self;
        let counts = matches!(self.depth_plane, DepthPlane::BlendedCount);
        let is_inverse = matches!(self.depth_plane, DepthPlane::Inverse | DepthPlane::Distance(_));
        // Differences from the given depth are added as they are, or as distances.
        let given = self.given.unwrap_or(const { &ZERO_PLANE });
        let sign = if matches!(self.depth_plane, DepthPlane::Distance(_)) { -1.0 } else { 1.0 };
        let c = |x: f32| V::splat(s, x);
        let (e_min, t_min) = (c(-blending.log2_reach), c(blending.transmittance_min));
        let (zero, never) = (V::zero(s), c(-1.0));
        let TileCanvas { planes, stop } = canvas;
        let [red, green, blue, finished, depth] = planes;
        for plane in [&mut *red, &mut *green, &mut *blue, &mut *finished, &mut *depth] {
            *plane = ZERO_PLANE;
        }
        // Transmittance of unfinished pixels; 0 for finished ones, whose last value is in `finished`, and outside
        // the image.
        let (inside, mut unfinished) = place.inside();
        let mut transmittance = Aligned(inside);
        let transmittance = &mut transmittance.0;
        for (stop, t) in stop.as_flattened_mut().iter_mut().zip(transmittance.as_flattened()) {
            *stop = if *t > 0.0 { u32::MAX } else { 0 };
        }
        // The largest weight of each pixel, and the index of its splat in the list.
        let mut largest = Aligned(ZERO_PLANE);
        let mut largest_at = [[0_u32; WIDTH]; PATCHES];
        for (first, chunk) in (0..).step_by(BATCH).zip(list.chunks(BATCH)) {
            if unfinished == 0 {
                break;
            }
            batch.set(s, splats, chunk, &place);
            if WITH != COLOUR && is_inverse {
                for splat in &mut batch.splats[..chunk.len()] {
                    splat.depth = 1.0 / splat.depth;
                }
            }
            for p in 0..PATCHES {
                let reached = batch.splats_of[p];
                if unfinished >> p & 1 == 0 || reached == 0 {
                    continue;
                }
                let mut is_unfinished = false;
                for at in (0..WIDTH).step_by(N * S::F32_LANES) {
                    let mut t = load_of::<S, N>(s, &transmittance[p][at..]);
                    // Pixels stop at this transmittance; finished ones must not be finished again.
                    let mut stop_at = t;
                    for n in 0..N {
                        stop_at[n] = zero.lt(t[n]).select(t_min, never);
                    }
                    let mut r = load_of::<S, N>(s, &red[p][at..]);
                    let mut g = load_of::<S, N>(s, &green[p][at..]);
                    let mut b = load_of::<S, N>(s, &blue[p][at..]);
                    let mut at_depth = load_of::<S, N>(s, &depth[p][at..]);
                    let given = load_of::<S, N>(s, &given[p][at..]);
                    let mut w_max = load_of::<S, N>(s, &largest.0[p][at..]);
                    let mut todo = reached;
                    while todo != 0 {
                        // The mask has 32 bits; the remainder removes the bounds check of every load.
                        let i = todo.trailing_zeros() as usize % BATCH;
                        todo &= todo - 1;
                        let splat = &batch.splats[i];
                        let mut e = t;
                        for (n, e) in e.iter_mut().enumerate() {
                            let [u, z] = batch.u_and_z(s, i, p, at + n * S::F32_LANES);
                            *e = u.neg_mul_add(u, z.neg_mul_add(z, c(splat.log2_opacity)));
                        }
                        let mut alpha = exp2_of(e);
                        let mut next = t;
                        for n in 0..N {
                            alpha[n] = e_min.le(e[n]).keep(alpha[n].min(c(ALPHA_MAX)));
                            next[n] = alpha[n].neg_mul_add(t[n], t[n]);
                        }
                        let mut some_stop = next[0].le(stop_at[0]);
                        for n in 1..N {
                            some_stop = some_stop.or(next[n].le(stop_at[n]));
                        }
                        if some_stop.any() {
                            let here = s.splat_u32s(first + i as u32);
                            let mut all_stopped = true;
                            for n in 0..N {
                                let stops = next[n].le(stop_at[n]);
                                let at = at + n * S::F32_LANES;
                                let finished = &mut finished[p][at..];
                                stops.select(t[n], V::load(s, finished)).store(finished);
                                let stop = &mut S::as_mut_simd_u32s(&mut stop[p][at..]).0[0];
                                *stop = stops.select_u32s(here, *stop);
                                t[n] = stops.select(zero, t[n]);
                                stop_at[n] = stops.select(never, stop_at[n]);
                                next[n] = alpha[n].neg_mul_add(t[n], t[n]);
                                all_stopped &= !zero.lt(t[n]).any();
                            }
                            if all_stopped {
                                todo = 0;
                            }
                        }
                        for n in 0..N {
                            let w = alpha[n] * t[n];
                            r[n] = w.mul_add(c(splat.colour[0]), r[n]);
                            g[n] = w.mul_add(c(splat.colour[1]), g[n]);
                            b[n] = w.mul_add(c(splat.colour[2]), b[n]);
                            if WITH != COLOUR {
                                at_depth[n] = if counts {
                                    at_depth[n] + zero.lt(w).keep(c(1.0))
                                } else {
                                    let difference = c(splat.depth) - given[n];
                                    w.mul_add(difference.max(difference * sign), at_depth[n])
                                };
                            }
                            if WITH == WITH_DOMINANT {
                                let here = s.splat_u32s(first + i as u32);
                                let largest_at = &mut largest_at[p][at + n * S::F32_LANES..];
                                let largest_at = &mut S::as_mut_simd_u32s(largest_at).0[0];
                                *largest_at = w_max[n].lt(w).select_u32s(here, *largest_at);
                                w_max[n] = w_max[n].max(w);
                            }
                        }
                        t = next;
                    }
                    store_of(t, &mut transmittance[p][at..]);
                    store_of(r, &mut red[p][at..]);
                    store_of(g, &mut green[p][at..]);
                    store_of(b, &mut blue[p][at..]);
                    if WITH != COLOUR {
                        store_of(at_depth, &mut depth[p][at..]);
                    }
                    if WITH == WITH_DOMINANT {
                        store_of(w_max, &mut largest.0[p][at..]);
                    }
                    for t in t {
                        is_unfinished |= zero.lt(t).any();
                    }
                }
                if !is_unfinished {
                    unfinished &= !(1 << p);
                }
            }
        }
        for p in 0..PATCHES {
            for at in (0..WIDTH).step_by(S::F32_LANES) {
                let t = V::load(s, &transmittance[p][at..]).max(V::load(s, &finished[p][at..]));
                t.store(&mut finished[p][at..]);
                add_product(s, t, c(background[0]), &mut red[p][at..]);
                add_product(s, t, c(background[1]), &mut green[p][at..]);
                add_product(s, t, c(background[2]), &mut blue[p][at..]);
            }
        }
        if WITH == WITH_DOMINANT {
            let pixels = largest.0.as_flattened().iter().zip(largest_at.as_flattened());
            for (_, &at) in pixels.filter(|(weight, _)| **weight > 0.0) {
                let row = Entry::load(&list[at as usize]).row;
                dominant[row].fetch_add(1, Relaxed);
            }
        }
    }
}

/// Adds w·x to a plane.
#[inline(always)]
fn add_product<S: Simd>(s: S, w: V<S>, x: V<S>, plane: &mut [f32]) {
    w.mul_add(x, V::load(s, plane)).store(plane);
}

/// A plane aligned to a cache line.
#[repr(align(64))]
pub(super) struct Aligned(pub(super) Plane);
