//! Stage 5: pixel gradients to splat gradients, one record per (row, tile) entry.
//!
//! Each tile's list is walked back to front. For pixel x and splat i with blend weight w = α·T,
//! the derivative of Σ g·C is dL/dα = T·(c·g − b), where b is the gradient-weighted colour of
//! everything behind the splat, background included, normalised by the transmittance there. b is
//! a running convex combination, b ← b + α(c·g − b): nothing is subtracted from a total, so that
//! nothing cancels however little light is left. T comes back from the final transmittance as
//! T ← T/(1 − α), exact to one rounding per splat because α <= 0.99.
//!
//! In the whitened coordinates (u, z) = Lᵀ·d of the forward pass, all that the parameters need of
//! a tile are sums of q, q·u, q·z, q·u², q·u·z, q·z² with q = α·dL/dα (and of w·g for the colour):
//! the covariance's gradient is ½·L·M·Lᵀ with M the matrix of second moments, and it is never
//! formed; see `project_bwd`.
//!
//! Records are summed per row in order of tile number, so the sum does not depend on threads.

use std::sync::atomic::{AtomicU32, AtomicU64, Ordering::Relaxed};

use pulp::{Simd, WithSimd};

use super::project::Splat;
use super::rasterize::{
    ALPHA_MAX, Aligned, BATCH, Blending, DARK, Patches, Plane, TRANSMITTANCE, TileCanvas,
    TilePlace, Within,
};
use super::records::TileRecords;
use super::simd::{V, WIDTH, each, sums_of_four};
use super::tiles::Entry;

/// Fields of a record.
pub(super) mod field {
    pub(in super::super) const Q: usize = 0;
    pub(in super::super) const U: usize = 1;
    pub(in super::super) const Z: usize = 2;
    pub(in super::super) const UU: usize = 3;
    pub(in super::super) const UZ: usize = 4;
    pub(in super::super) const ZZ: usize = 5;
    pub(in super::super) const COLOUR: usize = 6;
    /// Σ|q·u| and Σ|q·(l3·z − l1·shear·u)|: the absolute gradients of the projected mean.
    pub(in super::super) const ABS_X: usize = 9;
    pub(in super::super) const ABS_Y: usize = 10;
    /// Σw, number of pixels, Σw·(gradient of depth), max w.
    pub(in super::super) const WEIGHT_SUM: usize = 11;
    pub(in super::super) const PIXELS: usize = 12;
    pub(in super::super) const DEPTH: usize = 13;
    pub(in super::super) const WEIGHT_MAX: usize = 14;
    /// Fields that are always there.
    pub(in super::super) const FEW: usize = 9;
    /// All fields.
    pub(in super::super) const ALL: usize = 15;
}

/// Which fields a record has.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Detail {
    /// What training needs.
    Gradients,
    /// That, and the largest blend weight.
    WeightMax,
    /// Every field, alpha and depth gradients included.
    All,
}

impl Detail {
    /// Numbers per record: with [`Detail::WeightMax`] the maximum takes the place after colour.
    pub(super) const fn stride(self) -> usize {
        match self {
            Self::Gradients => field::FEW,
            Self::WeightMax => field::FEW + 1,
            Self::All => field::ALL,
        }
    }

    /// Which field is a maximum; all others are sums.
    pub(super) const fn maximum(self) -> Option<usize> {
        match self {
            Self::Gradients => None,
            Self::WeightMax => Some(field::FEW),
            Self::All => Some(field::WEIGHT_MAX),
        }
    }
}

/// dL/dpixel of one tile: red, green, blue, alpha, depth. The last two are read for
/// [`Detail::All`] only.
#[derive(Debug, Clone)]
#[repr(C, align(64))]
pub(super) struct TileGradient {
    pub(super) planes: [Plane; 5],
}

/// Differentiates one tile.
pub(super) struct RasterizeBwd<'a> {
    pub(super) splats: &'a [Splat],
    /// Sorted.
    pub(super) list: &'a [AtomicU64],
    pub(super) place: TilePlace,
    pub(super) background: [f32; 3],
    /// Those of the forward pass.
    pub(super) blending: Blending,
    pub(super) canvas: &'a TileCanvas,
    pub(super) upstream: [&'a Plane; 3],
    /// Alpha and depth, for [`Detail::All`].
    pub(super) upstream_more: Option<[&'a Plane; 2]>,
    pub(super) detail: Detail,
    /// This tile writes the records of its own entries, those that are held.
    pub(super) records: TileRecords<'a>,
}

impl WithSimd for RasterizeBwd<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, s: S) {
        match self.detail {
            Detail::Gradients => self.run::<S, 0>(s),
            Detail::WeightMax => self.run::<S, 1>(s),
            Detail::All => self.run::<S, 2>(s),
        }
    }
}

/// Sums of one entry, lane by lane.
struct Sums<S: Simd> {
    few: [V<S>; field::FEW],
    abs: [V<S>; 2],
    weight: V<S>,
    pixels: V<S>,
    depth: V<S>,
    weight_max: V<S>,
}

impl RasterizeBwd<'_> {
    #[inline(always)]
    fn run<S: Simd, const DETAIL: u8>(self, s: S) {
        let Self { splats, list, place, background, canvas, upstream, records, .. } = self;
        let faintest = V::splat(s, -self.blending.log2_reach);
        let c = |x: f32| V::splat(s, x);
        let [gr, gg, gb] = upstream;
        let [ga, gd] = self.upstream_more.unwrap_or([&DARK, &DARK]);

        // State per pixel, as it is behind the splat at hand.
        let mut light = Aligned(canvas.planes[TRANSMITTANCE]);
        let mut behind = Aligned(DARK);
        let (light, behind) = (&mut light.0, &mut behind.0);
        // One past the last list entry that any pixel of the patch takes.
        let mut patch_end = [0_u32; WIDTH];
        for (p, end) in patch_end.iter_mut().enumerate() {
            for at in (0..WIDTH).step_by(S::F32_LANES) {
                let b = V::load(s, &gr[p][at..]) * background[0]
                    + V::load(s, &gg[p][at..]) * background[1]
                    + V::load(s, &gb[p][at..]) * background[2];
                b.store(&mut behind[p][at..]);
            }
            *end = canvas.stop[p].iter().copied().max().unwrap_or(0).min(list.len() as u32);
        }
        let list_end = patch_end.iter().copied().max().unwrap_or(0) as usize;
        for (i, entry) in list[list_end..].iter().enumerate() {
            write(records.of(Entry::load(entry), list_end + i), &[0.0; field::ALL]);
        }

        let mut batch = [Splat::default(); BATCH];
        let mut patches = Patches::EMPTY;
        let batches = list_end.div_ceil(BATCH);
        for n in (0..batches).rev() {
            let first = n * BATCH;
            let chunk = &list[first..list_end.min(first + BATCH)];
            for (splat, entry) in batch.iter_mut().zip(chunk) {
                *splat = splats[Entry::load(entry).row];
            }
            let mut alive = 0_u32;
            for (p, &end) in patch_end.iter().enumerate() {
                alive |= u32::from(end as usize > first) << p;
            }
            for (i, splat) in batch[..chunk.len()].iter().enumerate().rev() {
                patches.set(s, splat, &place);
                let mut todo = patches.mask & alive;
                let within = Within::new(s, splat);
                let log2_opacity = c(splat.log2_opacity);
                let colour = each!(i in 3 => c(splat.colour[i]));
                let at_depth = c(splat.depth);
                let here = s.splat_u32s((first + i) as u32);
                let y2_u = c(-splat.l1 * splat.shear);
                let zero = V::zero(s);
                let mut sums = Sums {
                    few: [zero; field::FEW],
                    abs: [zero; 2],
                    weight: zero,
                    pixels: zero,
                    depth: zero,
                    weight_max: zero,
                };
                while todo != 0 {
                    // The mask has sixteen bits; saying so again spares every load its bounds check.
                    let p = todo.trailing_zeros() as usize % WIDTH;
                    todo &= todo - 1;
                    let (to_u, to_z) = (c(patches.u[p]), c(patches.z[p]));
                    for at in (0..WIDTH).step_by(S::F32_LANES) {
                        let (u, z) = (within.u(s, at) + to_u, within.z(s, at) + to_z);
                        let e = u.neg_mul_add(u, z.neg_mul_add(z, log2_opacity));
                        let stop = S::as_simd_u32s(&canvas.stop[p][at..]).0[0];
                        let seen = faintest.le(e).and(super::simd::before(s, here, stop));
                        let unclamped = e.exp2();
                        let alpha = seen.keep(unclamped.min(c(ALPHA_MAX)));
                        let t = V::load(s, &light[p][at..]) / (c(1.0) - alpha);
                        t.store(&mut light[p][at..]);
                        let w = alpha * t;
                        let (r, g, b) = (
                            V::load(s, &gr[p][at..]),
                            V::load(s, &gg[p][at..]),
                            V::load(s, &gb[p][at..]),
                        );
                        let mut own = colour[0].mul_add(r, colour[1].mul_add(g, colour[2] * b));
                        if DETAIL == 2 {
                            let d = V::load(s, &gd[p][at..]);
                            own = at_depth.mul_add(d, own + V::load(s, &ga[p][at..]));
                            sums.depth = w.mul_add(d, sums.depth);
                        }
                        let was = V::load(s, &behind[p][at..]);
                        let ahead = own - was;
                        alpha.mul_add(ahead, was).store(&mut behind[p][at..]);
                        // No gradient where alpha is at its clamp.
                        let q = unclamped.le(c(ALPHA_MAX)).keep(w * ahead);
                        let qu = q * u;
                        let qz = q * z;
                        let few = &mut sums.few;
                        few[field::Q] = few[field::Q] + q;
                        few[field::U] = few[field::U] + qu;
                        few[field::Z] = few[field::Z] + qz;
                        few[field::UU] = qu.mul_add(u, few[field::UU]);
                        few[field::UZ] = qu.mul_add(z, few[field::UZ]);
                        few[field::ZZ] = qz.mul_add(z, few[field::ZZ]);
                        few[field::COLOUR] = w.mul_add(r, few[field::COLOUR]);
                        few[field::COLOUR + 1] = w.mul_add(g, few[field::COLOUR + 1]);
                        few[field::COLOUR + 2] = w.mul_add(b, few[field::COLOUR + 2]);
                        if DETAIL >= 1 {
                            sums.weight_max = sums.weight_max.max(w);
                        }
                        if DETAIL == 2 {
                            sums.abs[0] = sums.abs[0] + qu.abs();
                            let y2 = y2_u.mul_add(qu, qz * splat.l3);
                            sums.abs[1] = sums.abs[1] + y2.abs();
                            sums.weight = sums.weight + w;
                            sums.pixels = sums.pixels + zero.lt(w).keep(c(1.0));
                        }
                    }
                }
                let mut record = [0.0; field::ALL];
                let [q, u, z, uu, uz, zz, red, green, blue] = sums.few;
                record[..4].copy_from_slice(&sums_of_four([q, u, z, uu]));
                record[4..8].copy_from_slice(&sums_of_four([uz, zz, red, green]));
                record[field::COLOUR + 2] = blue.sum();
                match DETAIL {
                    1 => record[field::FEW] = sums.weight_max.max_lane(),
                    2 => {
                        record[field::ABS_X] = sums.abs[0].sum();
                        record[field::ABS_Y] = sums.abs[1].sum();
                        record[field::WEIGHT_SUM] = sums.weight.sum();
                        record[field::PIXELS] = sums.pixels.sum();
                        record[field::DEPTH] = sums.depth.sum();
                        record[field::WEIGHT_MAX] = sums.weight_max.max_lane();
                    }
                    _ => {}
                }
                write(records.of(Entry::load(&chunk[i]), first + i), &record);
            }
        }
    }
}

#[inline(always)]
fn write(to: Option<&[AtomicU32]>, record: &[f32; field::ALL]) {
    for (to, x) in to.into_iter().flatten().zip(record) {
        to.store(x.to_bits(), Relaxed);
    }
}

/// The sums over the records of one row, which lie side by side, in order. `sums` has the shape of a
/// record.
pub(super) fn gather(sums: &mut [f32], detail: Detail, records: &[AtomicU32]) {
    match detail {
        Detail::Gradients => gather_all::<{ Detail::Gradients.stride() }>(sums, detail, records),
        Detail::WeightMax => gather_all::<{ Detail::WeightMax.stride() }>(sums, detail, records),
        Detail::All => gather_all::<{ Detail::All.stride() }>(sums, detail, records),
    }
}

/// Adds to what `sums` holds.
#[inline(always)]
fn gather_all<const STRIDE: usize>(sums: &mut [f32], detail: Detail, records: &[AtomicU32]) {
    let mut total: [f32; STRIDE] = std::array::from_fn(|i| sums[i]);
    for record in records.as_chunks::<STRIDE>().0 {
        for i in 0..STRIDE {
            let x = f32::from_bits(record[i].load(Relaxed));
            total[i] = if detail.maximum() == Some(i) { total[i].max(x) } else { total[i] + x };
        }
    }
    sums.copy_from_slice(&total);
}
