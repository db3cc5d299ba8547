//! The first walk of the backward pass over a batch of splats: alphas and weights, front to back.

use bytemuck::Zeroable;
use pulp::Simd;

use super::batch::{BATCH, Batch};
use super::rasterize::{ALPHA_MAX, Blending, PATCHES, Plane, TileCanvas};
use super::simd::{V, WIDTH, before, exp2_of};

/// Maximum number of (splat, patch) pairs in a batch.
pub(super) const PAIRS: usize = BATCH * PATCHES;

/// Results of the first walk over a batch, one for each (splat, patch) pair, patch by patch.
#[derive(Zeroable)]
#[repr(C, align(64))]
pub(super) struct BlendedBatch {
    /// The second walk may replace it by α·dL/dα.
    pub(super) alpha: [[f32; WIDTH]; PAIRS],
    /// α·Π(1 − α); the product is over the splats of the batch in front of this one.
    pub(super) weight: [[f32; WIDTH]; PAIRS],
}

impl BlendedBatch {
    /// The first walk over a batch, whose first splat is entry `first` of the list. Changes `transmittance` from the
    /// transmittance behind the batch to the one in front. Returns the end of each patch's pairs. `N` vectors of a patch
    /// are computed at a time.
    #[inline(always)]
    pub(super) fn fill<S: Simd, const N: usize>(
        &mut self,
        s: S,
        batch: &Batch,
        first: usize,
        blending: Blending,
        canvas: &TileCanvas,
        transmittance: &mut Plane,
    ) -> [usize; PATCHES] {
        let c = |x: f32| V::splat(s, x);
        let e_min = c(-blending.log2_reach);
        let Self { alpha: alphas, weight: weights } = self;
        let mut ends = [0; PATCHES];
        let mut start = 0;
        for p in 0..PATCHES {
            let reached = batch.splats_of[p];
            if reached == 0 {
                continue;
            }
            for at in (0..WIDTH).step_by(N * S::F32_LANES) {
                let mut product = [c(1.0); N];
                let (mut pair, mut todo) = (start, reached);
                while todo != 0 {
                    // The mask has 32 bits; the remainder removes the bounds check of every load.
                    let i = todo.trailing_zeros() as usize % BATCH;
                    todo &= todo - 1;
                    let log2_opacity = c(batch.splats[i].log2_opacity);
                    let mut e = product;
                    for (n, e) in e.iter_mut().enumerate() {
                        let [u, z] = batch.u_and_z(s, i, p, at + n * S::F32_LANES);
                        *e = u.neg_mul_add(u, z.neg_mul_add(z, log2_opacity));
                    }
                    let power = exp2_of(e);
                    let here = s.splat_u32s((first + i) as u32);
                    for n in 0..N {
                        let at = at + n * S::F32_LANES;
                        let stop = S::as_simd_u32s(&canvas.stop[p][at..]).0[0];
                        let seen = e_min.le(e[n]).and(before(s, here, stop));
                        let alpha = seen.keep(power[n].min(c(ALPHA_MAX)));
                        alpha.store(&mut alphas[pair % PAIRS][at..]);
                        (alpha * product[n]).store(&mut weights[pair % PAIRS][at..]);
                        product[n] = alpha.neg_mul_add(product[n], product[n]);
                    }
                    pair += 1;
                }
                for (n, product) in product.into_iter().enumerate() {
                    // Where the product underflows, the transmittance behind has underflowed too.
                    let behind = &mut transmittance[p][at + n * S::F32_LANES..];
                    let t = V::load(s, behind) / product.max(c(f32::MIN_POSITIVE));
                    t.store(behind);
                }
            }
            start += reached.count_ones() as usize;
            ends[p] = start;
        }
        ends
    }
}
