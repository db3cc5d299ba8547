//! One splat's blending into a patch, front to back, with the arithmetic of the forward pass: for measurements that need
//! every weight once more.

use pulp::Simd;

use super::batch::Batch;
use super::rasterize::{ALPHA_MAX, Blending};
use super::simd::{Mask, V, WIDTH};

/// A splat blended into the pixels of a vector.
pub(super) struct Blended<S: Simd> {
    /// The pixels that it is blended into.
    pub(super) blends: Mask<S>,
    /// The blend weight α·T; 0 in all other pixels.
    pub(super) weight: V<S>,
    /// The transmittance in front of the splat.
    pub(super) before: V<S>,
    /// The transmittance behind the splat, if it is blended.
    pub(super) after: V<S>,
}

/// Blends splat `i` of a batch into the pixels `at..` of patch `p`, whose transmittances it updates: that of finished
/// pixels becomes 0.
#[inline(always)]
pub(super) fn blend<S: Simd>(
    s: S,
    batch: &Batch,
    blending: Blending,
    [i, p, at]: [usize; 3],
    transmittance: &mut [f32; WIDTH],
) -> Blended<S> {
    let c = |x: f32| V::splat(s, x);
    let min_transmittance = c(blending.transmittance_min);
    let [u, z] = batch.u_and_z(s, i, p, at);
    let e = u.neg_mul_add(u, z.neg_mul_add(z, c(batch.splats[i].log2_opacity)));
    let seen = c(-blending.log2_reach).le(e);
    let alpha = e.exp2().min(c(ALPHA_MAX));
    let before = V::load(s, &transmittance[at..]);
    let after = alpha.neg_mul_add(before, before);
    let blends = min_transmittance.lt(after).and(seen);
    let stopped = after.le(min_transmittance).and(seen);
    let remaining = stopped.select(V::zero(s), blends.select(after, before));
    remaining.store(&mut transmittance[at..]);
    Blended { blends, weight: blends.keep(alpha * before), before, after }
}

/// True if all pixels of a patch are finished.
#[expect(clippy::float_cmp, reason = "finished pixels have exactly 0")]
pub(super) fn is_finished(transmittance: &[f32; WIDTH]) -> bool {
    *transmittance == [0.0; WIDTH]
}
