//! Batches of splats from a tile's list. A tile is divided into patches of 4×4 pixels. The coordinates (u, z) of a
//! pixel (see [`project`](super::project)) are stored per splat as two summands: one per patch, one per pixel in it.
//!
//! A batch is filled before any of its patches is rendered. Which splats reach a patch is then known before the loop
//! over these splats starts, so that the loop's exit depends on a finished bit mask, not on arithmetic in flight.

use std::sync::atomic::AtomicU64;

use pulp::Simd;

use super::project::Splat;
use super::rasterize::{PATCH, PATCHES, TilePlace};
use super::simd::{V, WIDTH};
use super::tiles::Entry;

/// Number of splats in a batch. They are copied before use, so that their cache misses overlap.
pub(super) const BATCH: usize = 32;

/// Pixel centres relative to their patch's upper left corner, and these corners relative to that of the tile `[px]`.
pub(super) const LANE_X: [f32; WIDTH] = grid(true, 1.0, 0.5);
pub(super) const LANE_Y: [f32; WIDTH] = grid(false, 1.0, 0.5);
pub(super) const CORNER_X: [f32; PATCHES] = grid(true, PATCH as f32, 0.0);
pub(super) const CORNER_Y: [f32; PATCHES] = grid(false, PATCH as f32, 0.0);

/// One coordinate (x or y) of the points of a 4×4 grid, row by row.
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

/// A batch of splats. The arrays per splat are valid up to the number of splats in the batch.
#[repr(C, align(64))]
pub(super) struct Batch {
    pub(super) splats: [Splat; BATCH],
    /// u and z of a patch's pixels minus those of its upper left corner, per splat.
    within_u: [[f32; WIDTH]; BATCH],
    within_z: [[f32; WIDTH]; BATCH],
    /// u and z of the patches' upper left corners, per splat.
    corner_u: [[f32; PATCHES]; BATCH],
    corner_z: [[f32; PATCHES]; BATCH],
    /// A bit per splat for each patch, set if the splat may be blended into one of the patch's pixels.
    pub(super) splats_of: [u32; PATCHES],
    /// The same information as a bit per patch, for each splat.
    pub(super) patches_of: [u32; BATCH],
}

impl Batch {
    pub(super) fn new() -> Self {
        Self {
            splats: [Splat::default(); BATCH],
            within_u: [[0.0; WIDTH]; BATCH],
            within_z: [[0.0; WIDTH]; BATCH],
            corner_u: [[0.0; PATCHES]; BATCH],
            corner_z: [[0.0; PATCHES]; BATCH],
            splats_of: [0; PATCHES],
            patches_of: [0; BATCH],
        }
    }

    /// Fills the batch with the splats of at most [`BATCH`] entries of the tile's list.
    #[inline(always)]
    pub(super) fn set<S: Simd>(
        &mut self,
        s: S,
        splats: &[Splat],
        entries: &[AtomicU64],
        place: &TilePlace,
    ) {
        let c = |x: f32| V::splat(s, x);
        for (splat, entry) in self.splats.iter_mut().zip(entries) {
            *splat = splats[Entry::load(entry).row];
        }
        // Distances from a patch's corner to its centre, and from there to the outermost pixel centres.
        let (middle, half) = (0.5 * PATCH as f32, 0.5 * (PATCH - 1) as f32);
        self.patches_of.fill(0);
        for at in (0..WIDTH).step_by(S::F32_LANES) {
            let (x, y) = (V::load(s, &LANE_X[at..]), V::load(s, &LANE_Y[at..]));
            let (patch_x, patch_y) = (V::load(s, &CORNER_X[at..]), V::load(s, &CORNER_Y[at..]));
            let mut reached = s.splat_u32s(0);
            for i in 0..entries.len().min(BATCH) {
                let Splat { mean, l1, shear, l3, reach, .. } = self.splats[i];
                let u_by_y = -l1 * shear;
                c(l1).mul_add(x, y * u_by_y).store(&mut self.within_u[i][at..]);
                (y * l3).store(&mut self.within_z[i][at..]);
                let dy = patch_y - (mean[1] - place.y);
                let dx = c(shear).neg_mul_add(dy, patch_x - (mean[0] - place.x));
                let (u, z) = (dx * l1, dy * l3);
                u.store(&mut self.corner_u[i][at..]);
                z.store(&mut self.corner_z[i][at..]);
                // The smallest |u| and |z| in the patch, with slack for rounding.
                let (u_middle, z_middle) = (c(l1 * (1.0 - shear) * middle), c(l3 * middle));
                let u_half = c(l1 * (1.0 + shear.abs()) * half * 1.0001 + 1e-3);
                let z_half = c(l3 * half * 1.0001 + 1e-3);
                let u = ((u + u_middle).abs() - u_half).max(V::zero(s));
                let z = ((z + z_middle).abs() - z_half).max(V::zero(s));
                let touched = u.mul_add(u, z * z).le(c(reach + 1e-3));
                reached = touched.or_bits(reached, 1 << i);
                self.patches_of[i] |= touched.bits() << at;
            }
            S::as_mut_simd_u32s(&mut self.splats_of[at..]).0[0] = reached;
        }
    }

    /// Removes splat `end` and all later splats from patch `p`.
    #[inline(always)]
    pub(super) fn cut(&mut self, p: usize, end: usize) {
        if end < BATCH {
            self.splats_of[p] &= (1 << end) - 1;
            for patches in &mut self.patches_of[end..] {
                *patches &= !(1 << p);
            }
        }
    }

    /// u and z at the pixels `at..` of patch `p`, for splat `i`.
    #[inline(always)]
    pub(super) fn u_and_z<S: Simd>(&self, s: S, i: usize, p: usize, at: usize) -> [V<S>; 2] {
        let u = V::load(s, &self.within_u[i][at..]) + self.corner_u[i][p];
        let z = V::load(s, &self.within_z[i][at..]) + self.corner_z[i][p];
        [u, z]
    }
}
