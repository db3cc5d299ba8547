//! Stage 5: from pixel gradients to splat gradients, one record per (row, tile) entry.
//!
//! Each tile's list is walked back to front. With g = dL/dC for a pixel's colour C, and for a splat of colour c and
//! blend weight w = α·T, the derivative is dL/dα = T·(c·g − b), where b is the gradient-weighted colour of
//! everything behind the splat, background included, normalised by the transmittance there. b is
//! a running convex combination, b ← b + α(c·g − b): nothing is subtracted from a total, so that
//! nothing cancels however little transmittance is left.
//!
//! A batch of splats is walked twice. The first walk goes front to back, one patch at a time as in the forward
//! pass. It computes each alpha, its weight as if nothing were in front of the batch, and the product of all 1 − α;
//! the transmittance behind the batch, divided by this product, is that in front of the batch. The second walk goes
//! back to front, one splat at a time, and computes the gradients, whose sums then stay in registers; where there are few
//! registers, the sums of moments get a walk of their own.
//!
//! In the whitened coordinates (u, z) = Lᵀ·d of the forward pass, the parameters' gradients need only the sums, over
//! the pixels of a tile, of q, q·u, q·z, q·u², q·u·z, q·z² with q = α·dL/dα, and of w·g for the colour. The
//! covariance's gradient is ½·L·M·Lᵀ with M the matrix of second moments; it is never formed, see `project_bwd`.
//!
//! Depth is one more channel. The value of a splat with (inverse) depth x in a pixel is m·ρ(x − c) + n·(x − c)², where
//! ρ is the identity or the absolute value; see
//! [`depth_gradient`](super::depth_gradient). Nothing
//! is behind the last splat, so this channel adds nothing to the first b. A gradient with respect to alpha has the same
//! value for every splat, so it is subtracted from the first b instead.
//!
//! Records are summed per row in order of tile number, so that the sum does not depend on the number of threads.

use std::sync::atomic::AtomicU64;

use pulp::{Simd, WithSimd};

use super::batch::{BATCH, Batch};
use super::blended::{BlendedBatch, PAIRS};
use super::depth_channel::{BY_ALPHA, CENTRE, DepthChannel, SQUARE};
use super::project::Splat;
use super::rasterize::{
    ALPHA_MAX, Aligned, Blending, Plane, TRANSMITTANCE, TileCanvas, TilePlace, ZERO_PLANE,
};
use super::records::{TileRecords, write};
use super::simd::{V, WIDTH, each, sums_of_four};
use super::tiles::Entry;
use crate::signals::{Field, RecordLayout};

/// Indices of the values that every record has.
pub(super) mod field {
    pub(in super::super) const Q: usize = 0;
    pub(in super::super) const U: usize = 1;
    pub(in super::super) const Z: usize = 2;
    pub(in super::super) const UU: usize = 3;
    pub(in super::super) const UZ: usize = 4;
    pub(in super::super) const ZZ: usize = 5;
    pub(in super::super) const COLOUR: usize = 6;
}

/// The optional values for which the kernel is compiled, as a bit set.
mod extra {
    /// The absolute gradients.
    pub(super) const ABS: u8 = 1;
    /// The sum of weights and the number of pixels.
    pub(super) const WEIGHTS: u8 = 2;
    /// The largest weight.
    pub(super) const LARGEST: u8 = 4;
    /// The sum of the weighted error, together with [`WEIGHTS`] and [`LARGEST`].
    pub(super) const ERROR: u8 = 8 | WEIGHTS | LARGEST;
    pub(super) const ERROR_ABS: u8 = ERROR | ABS;
    /// The channel of depth without squares.
    pub(super) const DEPTH: u8 = 16;
    /// This channel, with the value that most policies need.
    pub(super) const DEPTH_LARGEST: u8 = DEPTH | LARGEST;
    /// The squares of the channel of depth.
    pub(super) const SQUARES: u8 = 32 | DEPTH;
    pub(super) const ALL: u8 = SQUARES | ERROR_ABS;
}

/// dL/dpixel of one tile: red, green, blue, depth; and the error of the pixels. The fourth plane is only read for
/// records with [`Field::Depth`], the fifth for those with [`Field::Error`].
#[derive(Debug, Clone)]
#[repr(C, align(64))]
pub(super) struct TileGradient {
    pub(super) planes: [Plane; 5],
}

/// Planes of a [`TileGradient`].
pub(super) const BY_DEPTH: usize = 3;
pub(super) const ERROR: usize = 4;

/// Differentiates one tile.
pub(super) struct RasterizeBwd<'a> {
    pub(super) splats: &'a [Splat],
    /// The tile's entries, sorted front to back.
    pub(super) list: &'a [AtomicU64],
    pub(super) place: TilePlace,
    pub(super) background: [f32; 3],
    /// The settings of the forward pass.
    pub(super) blending: Blending,
    pub(super) canvas: &'a TileCanvas,
    pub(super) upstream: &'a TileGradient,
    pub(super) layout: RecordLayout,
    /// The meaning of the depth channel, for records with [`Field::Depth`].
    pub(super) depth: DepthChannel,
    /// The records of this tile's entries; only entries in the current [`Part`](super::records::Part) have one.
    pub(super) records: TileRecords<'a>,
    /// Scratch.
    pub(super) batch: &'a mut Batch,
    pub(super) blended: &'a mut BlendedBatch,
}

impl WithSimd for RasterizeBwd<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, s: S) {
        let has = |field| self.layout.has(field);
        // For the scalar instruction set only two kernels are compiled: all twelve, unrolled lane by lane, would be a
        // tenth of the program. Values that are not requested are computed, but not written.
        if const { S::F32_LANES == 1 } {
            if has(Field::Depth) {
                self.backpropagate::<S, { extra::ALL }>(s);
            } else {
                self.backpropagate::<S, { extra::ERROR_ABS }>(s);
            }
            return;
        }
        let mut extras = 0;
        if has(Field::AbsX) {
            extras |= extra::ABS;
        }
        if has(Field::WeightSum) || has(Field::PixelCount) {
            extras |= extra::WEIGHTS;
        }
        if has(Field::WeightMax) {
            extras |= extra::LARGEST;
        }
        if has(Field::Error) {
            extras |= extra::ERROR;
        }
        if has(Field::Depth) {
            extras |= if self.depth.has_squares { extra::SQUARES } else { extra::DEPTH };
        }
        match extras {
            0 => self.backpropagate::<S, 0>(s),
            1 => self.backpropagate::<S, 1>(s),
            2 => self.backpropagate::<S, 2>(s),
            3 => self.backpropagate::<S, 3>(s),
            4 => self.backpropagate::<S, 4>(s),
            5 => self.backpropagate::<S, 5>(s),
            6 => self.backpropagate::<S, 6>(s),
            7 => self.backpropagate::<S, 7>(s),
            extra::ERROR => self.backpropagate::<S, { extra::ERROR }>(s),
            extra::ERROR_ABS => self.backpropagate::<S, { extra::ERROR_ABS }>(s),
            extra::DEPTH | extra::DEPTH_LARGEST => {
                self.backpropagate::<S, { extra::DEPTH_LARGEST }>(s);
            }
            _ => self.backpropagate::<S, { extra::ALL }>(s),
        }
    }
}

/// Sums of one entry over the pixels, lane by lane, that the colours of the pixels lead to.
struct ColourSums<S: Simd> {
    colour: [V<S>; 3],
    weight: V<S>,
    pixels: V<S>,
    /// Weights times the error of the pixel.
    error: V<S>,
    /// Weights times the derivative of the depth channel.
    by_depth: V<S>,
    weight_max: V<S>,
}

/// Sums of one entry over the pixels, lane by lane, that its place and shape lead to.
struct Moments<S: Simd> {
    /// Sums of q, q·u, q·z, q·u², q·u·z, q·z².
    q: [V<S>; field::COLOUR],
    abs: [V<S>; 2],
}

impl<S: Simd> Moments<S> {
    /// Adds the pixels with these values of q, u and z. `y2_u` and `l3` are the derivatives of u and z with respect to
    /// the pixel's row.
    #[inline(always)]
    fn add<const EXTRAS: u8>(&mut self, q: V<S>, [u, z]: [V<S>; 2], y2_u: V<S>, l3: f32) {
        let qu = q * u;
        let qz = q * z;
        let sums = &mut self.q;
        sums[field::Q] = sums[field::Q] + q;
        sums[field::U] = sums[field::U] + qu;
        sums[field::Z] = sums[field::Z] + qz;
        sums[field::UU] = qu.mul_add(u, sums[field::UU]);
        sums[field::UZ] = qu.mul_add(z, sums[field::UZ]);
        sums[field::ZZ] = qz.mul_add(z, sums[field::ZZ]);
        if EXTRAS & extra::ABS != 0 {
            self.abs[0] = self.abs[0] + qu.abs();
            let y2 = y2_u.mul_add(qu, qz * l3);
            self.abs[1] = self.abs[1] + y2.abs();
        }
    }
}

impl RasterizeBwd<'_> {
    #[inline(always)]
    #[expect(clippy::too_many_lines, reason = "a numeric kernel")]
    fn backpropagate<S: Simd, const EXTRAS: u8>(self, s: S) {
        let Self { splats, list, place, background, blending, canvas, upstream, layout, .. } = self;
        let Self { records, batch, blended, depth, .. } = self;
        let c = |x: f32| V::splat(s, x);
        // The sixteen registers of AVX2 do not hold all sums of an entry, so they are added up in two walks over its
        // patches.
        let one_walk = const { S::F32_LANES != 8 };
        let [gr, gg, gb, by_depth, errors] = &upstream.planes;
        let [centre, square, by_alpha] =
            [CENTRE, SQUARE, BY_ALPHA].map(|plane| &canvas.planes[plane]);

        // State per pixel behind the current splat.
        let mut transmittance = Aligned(canvas.planes[TRANSMITTANCE]);
        let mut behind = Aligned(ZERO_PLANE);
        let (transmittance, behind) = (&mut transmittance.0, &mut behind.0);
        // One past the last list entry that is blended into any pixel of the patch.
        let mut patch_end = [0_u32; WIDTH];
        for (p, end) in patch_end.iter_mut().enumerate() {
            for at in (0..WIDTH).step_by(S::F32_LANES) {
                let b = V::load(s, &gr[p][at..]) * background[0]
                    + V::load(s, &gg[p][at..]) * background[1]
                    + V::load(s, &gb[p][at..]) * background[2];
                let has_depth = EXTRAS & extra::DEPTH != 0;
                let b = if has_depth { b - V::load(s, &by_alpha[p][at..]) } else { b };
                b.store(&mut behind[p][at..]);
            }
            *end = canvas.stop[p].iter().copied().max().unwrap_or(0).min(list.len() as u32);
        }
        let list_end = patch_end.iter().copied().max().unwrap_or(0) as usize;
        for (i, entry) in list[list_end..].iter().enumerate() {
            let record = records.record(Entry::load(entry), list_end + i);
            write(record, &[0.0; RecordLayout::MOST], layout);
        }

        let batches = list_end.div_ceil(BATCH);
        for n in (0..batches).rev() {
            let first = n * BATCH;
            let chunk = &list[first..list_end.min(first + BATCH)];
            batch.set(s, splats, chunk, &place);
            for (p, &end) in patch_end.iter().enumerate() {
                batch.cut(p, (end as usize).saturating_sub(first));
            }
            // Halves or quarters of a patch are computed in pairs, so that constants are loaded once.
            let mut ends = if const { matches!(S::F32_LANES, 4 | 8) } {
                blended.fill::<S, 2>(s, batch, first, blending, canvas, transmittance)
            } else {
                blended.fill::<S, 1>(s, batch, first, blending, canvas, transmittance)
            };
            for (i, splat) in batch.splats[..chunk.len()].iter().enumerate().rev() {
                let mut todo = batch.patches_of[i];
                let colour = each!(i in 3 => c(splat.colour[i]));
                let at_depth = c(depth.value(splat.depth));
                let y2_u = c(-splat.l1 * splat.shear);
                let zero = V::zero(s);
                let mut moments = Moments { q: [zero; field::COLOUR], abs: [zero; 2] };
                let mut sums = ColourSums {
                    colour: [zero; 3],
                    weight: zero,
                    pixels: zero,
                    error: zero,
                    by_depth: zero,
                    weight_max: zero,
                };
                while todo != 0 {
                    // The mask has sixteen bits; the remainder removes the bounds check of every load.
                    let p = todo.trailing_zeros() as usize % WIDTH;
                    todo &= todo - 1;
                    ends[p] -= 1;
                    let pair = ends[p] % PAIRS;
                    for at in (0..WIDTH).step_by(S::F32_LANES) {
                        let alpha = V::load(s, &blended.alpha[pair][at..]);
                        let part = V::load(s, &blended.weight[pair][at..]);
                        let w = part * V::load(s, &transmittance[p][at..]);
                        let (r, g, b) = (
                            V::load(s, &gr[p][at..]),
                            V::load(s, &gg[p][at..]),
                            V::load(s, &gb[p][at..]),
                        );
                        let mut cg = colour[0].mul_add(r, colour[1].mul_add(g, colour[2] * b));
                        if EXTRAS & extra::ERROR == extra::ERROR {
                            let error = V::load(s, &errors[p][at..]);
                            sums.error = w.mul_add(error, sums.error);
                        }
                        if EXTRAS & extra::DEPTH != 0 {
                            let x = at_depth - V::load(s, &centre[p][at..]);
                            let m = V::load(s, &by_depth[p][at..]);
                            let slope = m.with_sign_of(x, depth.sign_bit);
                            let (mut chord, mut tangent) = (slope, slope);
                            if EXTRAS & extra::SQUARES == extra::SQUARES {
                                let n = V::load(s, &square[p][at..]);
                                chord = n.mul_add(x, slope);
                                tangent = n.mul_add(x, chord);
                            }
                            cg = x.mul_add(chord, cg);
                            sums.by_depth = w.mul_add(tangent, sums.by_depth);
                        }
                        let old_b = V::load(s, &behind[p][at..]);
                        let cg_minus_b = cg - old_b;
                        alpha.mul_add(cg_minus_b, old_b).store(&mut behind[p][at..]);
                        // Alpha has no gradient at its clamp.
                        let q = alpha.lt(c(ALPHA_MAX)).keep(w * cg_minus_b);
                        sums.colour[0] = w.mul_add(r, sums.colour[0]);
                        sums.colour[1] = w.mul_add(g, sums.colour[1]);
                        sums.colour[2] = w.mul_add(b, sums.colour[2]);
                        if EXTRAS & extra::LARGEST != 0 {
                            sums.weight_max = sums.weight_max.max(w);
                        }
                        if EXTRAS & extra::WEIGHTS != 0 {
                            sums.weight = sums.weight + w;
                            sums.pixels = sums.pixels + zero.lt(w).keep(c(1.0));
                        }
                        if one_walk {
                            let at_pixel = batch.u_and_z(s, i, p, at);
                            moments.add::<EXTRAS>(q, at_pixel, y2_u, splat.l3);
                        } else {
                            q.store(&mut blended.alpha[pair][at..]);
                        }
                    }
                }
                let mut todo = if one_walk { 0 } else { batch.patches_of[i] };
                while todo != 0 {
                    let p = todo.trailing_zeros() as usize % WIDTH;
                    todo &= todo - 1;
                    let pair = ends[p] % PAIRS;
                    for at in (0..WIDTH).step_by(S::F32_LANES) {
                        let q = V::load(s, &blended.alpha[pair][at..]);
                        let at_pixel = batch.u_and_z(s, i, p, at);
                        moments.add::<EXTRAS>(q, at_pixel, y2_u, splat.l3);
                    }
                }
                let mut record = [0.0; RecordLayout::MOST];
                let [q, u, z, uu, uz, zz] = moments.q;
                let [red, green, blue] = sums.colour;
                record[..4].copy_from_slice(&sums_of_four([q, u, z, uu]));
                record[4..8].copy_from_slice(&sums_of_four([uz, zz, red, green]));
                record[field::COLOUR + 2] = blue.sum();
                if EXTRAS & extra::ABS != 0 {
                    record[Field::AbsX.number()] = moments.abs[0].sum();
                    record[Field::AbsY.number()] = moments.abs[1].sum();
                }
                if EXTRAS & extra::WEIGHTS != 0 {
                    record[Field::WeightSum.number()] = sums.weight.sum();
                    record[Field::PixelCount.number()] = sums.pixels.sum();
                }
                if EXTRAS & extra::ERROR == extra::ERROR {
                    record[Field::Error.number()] = sums.error.sum();
                }
                if EXTRAS & extra::DEPTH != 0 {
                    record[Field::Depth.number()] =
                        sums.by_depth.sum() * depth.derivative(splat.depth);
                }
                if EXTRAS & extra::LARGEST != 0 {
                    record[Field::WeightMax.number()] = sums.weight_max.max_lane();
                }
                write(records.record(Entry::load(&chunk[i]), first + i), &record, layout);
            }
        }
    }
}
