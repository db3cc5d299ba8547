//! Stage 6: from splat gradients to parameter gradients.
//!
//! The forward projection is evaluated again instead of stored. With the sums of stage 5 over pixels in
//! whitened coordinates, M = Σ q·[u z]ᵀ[u z] with q = α·dL/dα, the covariance's gradient is G = ½·L·M·Lᵀ. G is not
//! formed: for a needle 1,000 px long its entries cancel along the needle's axis. With
//! W = Lᵀ·V, whose entries are at most 1, and wₖ its columns (one per axis of the Gaussian),
//! - dL/d(log sₖ) = wₖᵀ·M·wₖ,
//! - the gradient with respect to a rotation about local axis x is nᵧᵀ·M·n_z·(sᵧ² − s_z²), wₖ = sₖ·nₖ, and cyclically
//!   for the others; this gradient g vanishes exactly for a sphere, and maps to the quaternion h as 2/|h|·ĥ⊗(0, g),
//!   which is orthogonal to h,
//! - dL/dV = L·M·W leads on to J and the mean.
//!
//! Derived from Σ = V·Vᵀ + κ·I, dL/dV = 2·G·V; checked against the float64 reference.
//!
//! Antialiasing adds the gradient through log ρ = ½ log det S − ½ log det Σ, S = V·Vᵀ. With q now summed over the
//! pixels, it is q·(S⁻¹ − Σ⁻¹)·V with respect to V, and Σ⁻¹·V = ρ²·S⁻¹·V + κ·V/det Σ. With n = v₀ × v₁, n̂ = n/|n| and
//! 1 − ρ² = κ·(tr S + κ)/det Σ, nothing cancels and nothing is divided by ρ:
//! - dL/dV = q·(1 − ρ²)·[v₁ × n; n × v₀]/|n|² − q·κ·V/det Σ,
//! - Vᵀ·S⁻¹·V = I − n̂·n̂ᵀ in the frame of the Gaussian's axes, for log-scales and rotations.

//!
//! The camera's pose moves by a twist (v, ω), p ← p + v + ω × p. Moving it by v is moving the mean by Wᵀ·v, and turning
//! it by ω is turning p and the Gaussian's axes, but not the direction from which its colour is seen. With dL/dp as it is
//! before the colour's share, rᵢ = dL/d(rotation about axis i), and dL/d(mean):
//! - dL/dv = W·dL/d(mean), dL/dω = p × dL/dp + W·Σ rᵢ·axisᵢ,
//! - dL/d(log f) = dL/d(projected mean)·(projected mean − principal point) + Σ dL/d(log sₖ), as V is proportional to f
//!   (where x/z is clamped, its bounds are held fixed).

use densify_core::pose::TWIST_VALUES;
use pulp::Simd;

use super::blocks::plane;
use super::project::{
    EXPONENT_SCALE, Geometry, ViewParams, conic, difference_of_products, direction, dot, geometry,
    lanes, raw_colour, rotation, sh_basis,
};
use super::rasterize_bwd::field;
use super::simd::{V, WIDTH, each};
use crate::signals::{BASE, Field, RecordLayout};
use densify_core::gaussians::sh_coefficients;
use densify_core::sh;

/// Gradients of the sixteen rows of a block for one view.
#[repr(align(64))]
pub(super) struct BlockGradient {
    /// dL/d(parameter), in the planes of the block.
    pub(super) params: [f32; plane::MOST * WIDTH],
    /// dL/d(projected mean) `[1/px]`, and the sum over pixels of its absolute value.
    pub(super) mean2d: [[f32; WIDTH]; 2],
    pub(super) mean2d_abs: [[f32; WIDTH]; 2],
    /// 1 / camera-space depth `[1/scene unit]`.
    pub(super) inv_z: [f32; WIDTH],
    /// The sum of the records, one line per value; undefined for values that the layout lacks.
    pub(super) sums: [[f32; WIDTH]; RecordLayout::MOST],
    /// 1 for visible rows, 0 for others.
    pub(super) visible: [f32; WIDTH],
    /// Number of pixels in which the row has the largest blend weight, if they are counted.
    pub(super) dominant: [f32; WIDTH],
    /// dL/d(twist of the camera), if the view asks for it.
    pub(super) twist: [[f32; WIDTH]; TWIST_VALUES],
}

impl BlockGradient {
    pub(super) const ZERO: Self = Self {
        params: [0.0; plane::MOST * WIDTH],
        mean2d: [[0.0; WIDTH]; 2],
        mean2d_abs: [[0.0; WIDTH]; 2],
        inv_z: [0.0; WIDTH],
        sums: [[0.0; WIDTH]; RecordLayout::MOST],
        visible: [0.0; WIDTH],
        dominant: [0.0; WIDTH],
        twist: [[0.0; WIDTH]; TWIST_VALUES],
    };

    /// Adds the derivatives with respect to the camera's twist, which have been computed.
    pub(super) fn add_twist(&self, sums: &mut [f64; TWIST_VALUES]) {
        for (sum, lanes) in sums.iter_mut().zip(&self.twist) {
            *sum += lanes.iter().map(|&x| f64::from(x)).sum::<f64>();
        }
    }

    /// Differentiates the rows of `block` that are set in `visible`; other rows get 0.
    ///
    /// `sums` has one record per row. Shape: `[WIDTH, layout.stride()]`.
    #[inline(always)]
    pub(super) fn compute<S: Simd>(
        &mut self,
        s: S,
        block: &[f32],
        sums: &[f32],
        layout: RecordLayout,
        visible: u16,
        view: &ViewParams,
    ) {
        if visible == 0 {
            *self = Self::ZERO;
            return;
        }
        for (lane, record) in sums.chunks_exact(layout.stride()).enumerate() {
            let seen = visible >> lane & 1 == 1;
            self.visible[lane] = f32::from(u8::from(seen));
            let (base, extras) = record.split_at(BASE);
            for (line, &x) in self.sums.iter_mut().zip(base) {
                line[lane] = if seen { x } else { 0.0 };
            }
            for (&number, &x) in layout.extras().iter().zip(extras) {
                self.sums[usize::from(number)][lane] = if seen { x } else { 0.0 };
            }
        }
        for at in (0..WIDTH).step_by(S::F32_LANES) {
            self.compute_lanes(s, block, at, layout, view);
        }
    }

    #[inline(always)]
    fn compute_lanes<S: Simd>(
        &mut self,
        s: S,
        block: &[f32],
        at: usize,
        layout: RecordLayout,
        view: &ViewParams,
    ) {
        let degree = view.sh_degree;
        let c = |x: f32| V::splat(s, x);
        let zero = V::zero(s);
        let seen = zero.lt(V::load(s, &self.visible[at..]));
        let params = &mut self.params;
        macro_rules! put {
            ($p:expr, $x:expr) => {{
                let p = $p;
                seen.keep($x).store(&mut params[p * WIDTH + at..(p + 1) * WIDTH]);
            }};
        }
        macro_rules! sum {
            ($field:expr) => {
                V::load(s, &self.sums[$field][at..])
            };
        }

        let g = geometry(s, block, at, view);
        let [l1, shear, l3] = conic(&g);
        // Undo the scaling of the conic in the rasteriser's sums.
        let unscale = 1.0 / EXPONENT_SCALE;
        let (q, qu, qz) = (sum!(field::Q), sum!(field::U) * unscale, sum!(field::Z) * unscale);
        let unscale2 = unscale * unscale;
        let (muu, muz, mzz) =
            (sum!(field::UU) * unscale2, sum!(field::UZ) * unscale2, sum!(field::ZZ) * unscale2);

        seen.keep(g.inv_z).store(&mut self.inv_z[at..]);
        // Projected mean: L·Σ q·(u, z).
        let dm = [l1 * qu, l3 * qz - l1 * shear * qu];
        for (line, x) in self.mean2d.iter_mut().zip(dm) {
            seen.keep(x).store(&mut line[at..]);
        }
        if layout.has(Field::AbsX) {
            // The sums hold Σ|q·u'| and Σ|q·(l3'·z' − l1'·shear·u')| with scaled u', z', l'.
            let abs =
                [l1 * sum!(Field::AbsX.number()) * unscale, sum!(Field::AbsY.number()) * unscale2];
            for (line, x) in self.mean2d_abs.iter_mut().zip(abs) {
                seen.keep(x).store(&mut line[at..]);
            }
        }
        // Columns of W without their scales, and their products with M.
        let n0 = each!(k in 3 => l1 * (g.n[0][k] - shear * g.n[1][k]));
        let n1 = each!(k in 3 => l3 * g.n[1][k]);
        let mn0 = each!(k in 3 => muu * n0[k] + muz * n1[k]);
        let mn1 = each!(k in 3 => muz * n0[k] + mzz * n1[k]);
        let scale2 = each!(k in 3 => g.scale[k] * g.scale[k]);
        let mut by_log_scale = each!(k in 3 => (n0[k] * mn0[k] + n1[k] * mn1[k]) * scale2[k]);
        let mut turn = each!(i in 3 => {
            let (j, k) = ((i + 1) % 3, (i + 2) % 3);
            (n0[j] * mn0[k] + n1[j] * mn1[k]) * (scale2[j] - scale2[k])
        });
        // dL/d(row i of J·W) = Σ_k (L·M·n)[i][k]·sₖ²·axisₖ.
        let mut d0 = each!(k in 3 => l1 * mn0[k] * scale2[k]);
        let mut d1 = each!(k in 3 => (l3 * mn1[k] - l1 * shear * mn0[k]) * scale2[k]);
        if view.lowers_opacity {
            RhoGradient::new(s, &g, scale2, q, view.blur).add_to(
                &mut by_log_scale,
                &mut turn,
                [&mut d0, &mut d1],
            );
        }
        let by_quat = by_quat(&g, turn);
        for (p, &x) in (plane::LOG_SCALE..).zip(&by_log_scale).chain((plane::QUAT..).zip(&by_quat))
        {
            put!(p, x);
        }

        let rot = rotation(s, view);
        let focal = [c(view.focal[0]), c(view.focal[1])];
        let by_depth = if layout.has(Field::Depth) { sum!(Field::Depth.number()) } else { zero };
        let dp = by_position(&g, &rot, [d0, d1], (dm, focal), by_depth);

        // Colour: through the clamp at 0 to the coefficients, and through the direction to the mean.
        let (dir, inv_distance) = direction(s, block, at, view);
        let basis = sh_basis(s, degree, dir);
        let raw = raw_colour(s, block, at, degree, &basis);
        let dc = each!(i in 3 => zero.lt(raw[i]).keep(sum!(field::COLOUR + i)));
        let mut weights = [zero; 16];
        for k in 0..sh_coefficients(degree) {
            for (channel, &dc) in dc.iter().enumerate() {
                let p = plane::SH + 3 * k + channel;
                weights[k] = dc.mul_add(lanes(s, block, p, at), weights[k]);
                put!(p, basis[k] * dc);
            }
        }
        let by_dir = sh::basis_gradient(degree, dir, &weights, zero);
        let radial = dot(by_dir, dir);
        let from_dir = each!(i in 3 => (by_dir[i] - radial * dir[i]) * inv_distance);
        for i in 0..3 {
            let from_p = rot[0][i] * dp[0] + rot[1][i] * dp[1] + rot[2][i] * dp[2];
            put!(plane::MEAN + i, from_p + from_dir[i]);
        }
        if view.differentiates_pose {
            let by_position = (dp, from_dir);
            let twist = by_twist(&g, &rot, by_position, turn, (dm, focal), by_log_scale);
            for (line, x) in self.twist.iter_mut().zip(twist) {
                seen.keep(x).store(&mut line[at..]);
            }
        }

        // dα/d(logit) = α(1 − o); 1 − o = σ(−logit) keeps its precision near o = 1.
        let logit = lanes(s, block, plane::OPACITY, at);
        put!(plane::OPACITY, q / (c(1.0) + logit.exp()));
    }
}

/// dL/dp through the projection, from d0 and d1 = dL/d(rows of J·W)·axes, dL/d(projected mean) with the focal lengths, and
/// dL/d(depth).
#[inline(always)]
fn by_position<S: Simd>(
    g: &Geometry<S>,
    rot: &[[V<S>; 3]; 3],
    [d0, d1]: [[V<S>; 3]; 2],
    (dm, focal): ([V<S>; 2], [V<S>; 2]),
    by_depth: V<S>,
) -> [V<S>; 3] {
    let [a0, a1, a2] = g.axes;
    let db0 = each!(i in 3 => d0[0] * a0[i] + d0[1] * a1[i] + d0[2] * a2[i]);
    let db1 = each!(i in 3 => d1[0] * a0[i] + d1[1] * a1[i] + d1[2] * a2[i]);
    let (j00, j02) = (dot(db0, rot[0]), dot(db0, rot[2]));
    let (j11, j12) = (dot(db1, rot[1]), dot(db1, rot[2]));
    let Geometry { inv_z, ratio, clamped, .. } = *g;
    // J = f/z·[1, 0, −x/z; 0, 1, −y/z], its x/z and y/z constant where clamped.
    let by_inv_z = focal[0] * (j00 - clamped[0] * j02) + focal[1] * (j11 - clamped[1] * j12);
    let j_2 = [j02, j12];
    let by_ratio = each!(i in 2 => {
        let free = clamped[i].le(ratio[i]).and(ratio[i].le(clamped[i]));
        focal[i] * (dm[i] - free.keep(inv_z * j_2[i]))
    });
    [
        by_ratio[0] * inv_z,
        by_ratio[1] * inv_z,
        by_depth - inv_z * (by_ratio[0] * ratio[0] + by_ratio[1] * ratio[1] + inv_z * by_inv_z),
    ]
}

/// dL/d(twist of the camera), from dL/dp, the colour's part of dL/d(mean), dL/d(rotation about each local axis),
/// dL/d(projected mean) with the focal lengths, and dL/d(log-scale); see the module's comment.
#[inline(always)]
fn by_twist<S: Simd>(
    g: &Geometry<S>,
    rot: &[[V<S>; 3]; 3],
    (dp, from_dir): ([V<S>; 3], [V<S>; 3]),
    turn: [V<S>; 3],
    (dm, focal): ([V<S>; 2], [V<S>; 2]),
    by_log_scale: [V<S>; 3],
) -> [V<S>; TWIST_VALUES] {
    let [a0, a1, a2] = g.axes;
    let turned = each!(i in 3 => turn[0] * a0[i] + turn[1] * a1[i] + turn[2] * a2[i]);
    let translation = each!(i in 3 => dp[i] + dot(rot[i], from_dir));
    let rotation = each!(i in 3 => {
        let (j, k) = ((i + 1) % 3, (i + 2) % 3);
        g.p[j] * dp[k] - g.p[k] * dp[j] + dot(rot[i], turned)
    });
    let by_scales = by_log_scale[0] + by_log_scale[1] + by_log_scale[2];
    let by_means = dm[0] * focal[0] * g.ratio[0] + dm[1] * focal[1] * g.ratio[1];
    let ([x, y, z], [a, b, c]) = (translation, rotation);
    [x, y, z, a, b, c, by_means + by_scales]
}

/// dL/d(quaternion), from dL/d(rotation about each local axis).
#[inline(always)]
fn by_quat<S: Simd>(g: &Geometry<S>, turn: [V<S>; 3]) -> [V<S>; 4] {
    let ([w, x, y, z], [tx, ty, tz]) = (g.quat, turn);
    let two = g.quat_inv_norm * 2.0;
    [
        -(x * tx + y * ty + z * tz) * two,
        (w * tx + y * tz - z * ty) * two,
        (w * ty + z * tx - x * tz) * two,
        (w * tz + x * ty - y * tx) * two,
    ]
}

/// The gradient through ρ, the factor of opacities with antialiasing; see the module's comment.
struct RhoGradient<S: Simd> {
    /// dL/d(log-scale).
    log_scale: [V<S>; 3],
    /// dL/d(rotation about local axis).
    turn: [V<S>; 3],
    /// dL/d(n[i][k]) = dL/d(V[i][k])·sₖ.
    rows: [[V<S>; 3]; 2],
}

impl<S: Simd> RhoGradient<S> {
    /// `q` is dL/d(log ρ), which equals dL/d(log opacity).
    #[inline(always)]
    fn new(s: S, g: &Geometry<S>, scale2: [V<S>; 3], q: V<S>, blur: f32) -> Self {
        let [r0, r1] = g.n;
        let per_det = q * blur / g.det;
        let by_sharp = per_det * (g.cov[0] + g.cov[2] - blur);
        let inv_norm = V::splat(s, 1.0) / g.sharp_det.sqrt();
        let next = |i: usize| ((i + 1) % 3, (i + 2) % 3);
        // n̂ᵢ = sⱼ·sₖ·hᵢ: h stays finite where a scale is 0.
        let h = each!(i in 3 => {
            let (j, k) = next(i);
            difference_of_products(r0[j], r1[k], r0[k], r1[j]) * inv_norm
        });
        let unit2 = each!(i in 3 => {
            let (j, k) = next(i);
            let unit = g.scale[j] * g.scale[k] * h[i];
            unit * unit
        });
        let log_scale = each!(i in 3 => {
            let (j, k) = next(i);
            let length2 = (r0[i] * r0[i] + r1[i] * r1[i]) * scale2[i];
            by_sharp * (unit2[j] + unit2[k]) - per_det * length2
        });
        let turn = each!(i in 3 => {
            let (j, k) = next(i);
            let sharp = (g.scale[i] * h[j]) * (g.scale[i] * h[k]);
            let both = by_sharp * sharp + per_det * (r0[j] * r0[k] + r1[j] * r1[k]);
            (scale2[k] - scale2[j]) * both
        });
        let across = by_sharp * inv_norm;
        let rows = [
            each!(i in 3 => {
                let (j, k) = next(i);
                let cross = scale2[j] * r1[j] * h[k] - scale2[k] * r1[k] * h[j];
                scale2[i] * (across * cross - per_det * r0[i])
            }),
            each!(i in 3 => {
                let (j, k) = next(i);
                let cross = scale2[k] * r0[k] * h[j] - scale2[j] * r0[j] * h[k];
                scale2[i] * (across * cross - per_det * r1[i])
            }),
        ];
        Self { log_scale, turn, rows }
    }

    #[inline(always)]
    fn add_to(&self, log_scale: &mut [V<S>; 3], turn: &mut [V<S>; 3], rows: [&mut [V<S>; 3]; 2]) {
        let [row0, row1] = rows;
        for k in 0..3 {
            log_scale[k] = log_scale[k] + self.log_scale[k];
            turn[k] = turn[k] + self.turn[k];
            row0[k] = row0[k] + self.rows[0][k];
            row1[k] = row1[k] + self.rows[1][k];
        }
    }
}
