//! Stage 1: from rows to splats. Each row's Gaussian is projected onto the image (EWA splatting; Zwicker
//! et al. 2001, Kerbl et al. 2023, section 4) and its colour evaluated for the view.
//!
//! Numerics. With V = J·W·R·S (2×3, rows v₀ and v₁) the projected covariance is Σ = V·Vᵀ + κ·I; κ is 0.3
//! px², or that of the model's antialiasing.
//! - Its determinant comes from the Lagrange identity |v₀ × v₁|² + κ(|v₀|² + |v₁|²) + κ²: all
//!   terms are positive, whereas a·c − b² loses all precision for needles with an aspect ratio above 1,000:1.
//! - Its inverse is stored as the Cholesky factor L, Σ⁻¹ = L·Lᵀ: with (u, z) = Lᵀ·d the exponent is
//!   −½(u² + z²), never positive. L = [[l₁, 0], `[−l₁·r, l₃]`], l₁ = √(c/det), r = b/c, l₃ = 1/√c.
//!   Inside a splat's footprint the error of u does not depend on which axis is eliminated; the
//!   choice here makes z constant along an image row.
//!
//! With antialiasing the opacity is multiplied by ρ = |v₀ × v₁|/√det Σ, which the backends do in log₂.
//!
//! The functions are in one file because the backward pass (`project_bwd`) reuses them and their results.

use bytemuck::{Pod, Zeroable};
use pulp::{Simd, WithSimd};

use super::blocks::{Scratch, plane, planes};
use super::footprint::Ellipse;
use super::parameters::ParameterView;
use super::simd::{Mask, V, WIDTH, each};
use super::tiles::Grid;
use densify_core::antialiasing::Antialiasing;
use densify_core::camera::Camera;
use densify_core::gaussians::sh_coefficients;
use densify_core::sh;

/// Margin around the image, as a fraction of its size, beyond which the direction used in J is clamped:
/// 0.15 = 0.3/2 (the original clamps at 1.3 tan(fov/2)).
const FOV_MARGIN: f64 = 0.15;
/// Rows with a larger colour are broken and are not rendered: added to a pixel, such a colour would leave no bits of
/// precision for the other rows.
const COLOUR_MAX: f32 = 1e6;
/// √(½·log₂ e): the conic factors are scaled by it, so that exp(−½(u² + z²)) becomes 2^(−u² − z²).
pub(crate) const EXPONENT_SCALE: f32 = 0.849_321_8;

/// A camera in the form that the kernels use.
#[derive(Debug, Clone, Copy)]
pub(crate) struct ViewParams {
    /// Rows of camera_from_world's rotation.
    pub(crate) rotation: [[f32; 3]; 3],
    pub(crate) translation: [f32; 3],
    pub(crate) centre: [f32; 3],
    pub(crate) focal: [f32; 2],
    pub(crate) principal: [f32; 2],
    /// Bounds of x/z and y/z in J.
    pub(crate) ratio_min: [f32; 2],
    pub(crate) ratio_max: [f32; 2],
    pub(crate) width: u32,
    pub(crate) height: u32,
    pub(crate) near: f32,
    pub(crate) sh_degree: u8,
    /// Variance added to both diagonal entries of a projected covariance `[px²]`.
    pub(crate) blur: f32,
    /// True if the blur lowers opacities.
    pub(crate) lowers_opacity: bool,
    /// True if the backward pass differentiates with respect to the pose.
    pub(crate) differentiates_pose: bool,
}

impl ViewParams {
    pub(crate) fn new(
        camera: &Camera,
        near: f32,
        sh_degree: u8,
        antialiasing: Antialiasing,
    ) -> Self {
        let c = camera;
        let low = |p: f64, size: f64, f: f64| ((-FOV_MARGIN * size - p) / f) as f32;
        let high = |p: f64, size: f64, f: f64| (((1.0 + FOV_MARGIN) * size - p) / f) as f32;
        let (w, h) = (f64::from(c.width), f64::from(c.height));
        Self {
            rotation: [0, 1, 2].map(|i| c.rotation.row(i).as_vec3().to_array()),
            translation: c.translation.as_vec3().to_array(),
            centre: c.centre().as_vec3().to_array(),
            focal: [c.fx as f32, c.fy as f32],
            principal: [c.cx as f32, c.cy as f32],
            ratio_min: [low(c.cx, w, c.fx), low(c.cy, h, c.fy)],
            ratio_max: [high(c.cx, w, c.fx), high(c.cy, h, c.fy)],
            width: c.width,
            height: c.height,
            near,
            sh_degree,
            blur: antialiasing.kernel(),
            lowers_opacity: antialiasing.is_on(),
            differentiates_pose: false,
        }
    }
}

/// A projected row, as the tile kernels read it.
#[derive(Debug, Clone, Copy, Default, PartialEq, Pod, Zeroable)]
#[repr(C, align(64))]
pub(super) struct Splat {
    /// Projected mean `[px]`.
    pub(super) mean: [f32; 2],
    /// Scaled conic factor: l₁·EXPONENT_SCALE `[1/px]`, >= 0.
    pub(super) l1: f32,
    /// Shear r = Σ₀₁/Σ₁₁.
    pub(super) shear: f32,
    /// Scaled conic factor: l₃·EXPONENT_SCALE `[1/px]`, > 0.
    pub(super) l3: f32,
    /// log₂ of the opacity, <= 0.
    pub(super) log2_opacity: f32,
    /// Colour, >= 0.
    pub(super) colour: [f32; 3],
    /// Camera z `[scene units]`.
    pub(super) depth: f32,
    /// Half the height of the region where alpha is at least the blending threshold `[px]`.
    pub(super) half_height: f32,
    /// Half the width of that region `[px]`.
    pub(super) half_width: f32,
    /// 1/l1 `[px]`.
    pub(super) inv_l1: f32,
    /// Vertical offset of that region's rightmost point from the mean `[px]`.
    pub(super) peak: f32,
    /// The decrease of the exponent from the centre to the edge of that region.
    pub(super) reach: f32,
    /// Bits of the [`Footprint`](super::footprint::Footprint); 0 if it is too large for them. With this field a splat
    /// fills one cache line.
    pub(super) tiles: u32,
}

/// Number of values in a [`Splat`].
const SPLAT_FIELDS: usize = 16;

/// Intermediate results of the forward projection that the backward pass uses too.
pub(super) struct Geometry<S: Simd> {
    /// exp(log-scale).
    pub(super) scale: [V<S>; 3],
    /// Normalised quaternion (w, x, y, z), and 1/|q| of the raw quaternion.
    pub(super) quat: [V<S>; 4],
    pub(super) quat_inv_norm: V<S>,
    /// Columns of R(q).
    pub(super) axes: [[V<S>; 3]; 3],
    /// Camera-space position.
    pub(super) p: [V<S>; 3],
    pub(super) inv_z: V<S>,
    /// x/z and y/z, and both clamped for J.
    pub(super) ratio: [V<S>; 2],
    pub(super) clamped: [V<S>; 2],
    /// n[i][k] = (row i of J·W) · (axis k); V = n · scale.
    pub(super) n: [[V<S>; 3]; 2],
    /// Σ's entries with blur, and its determinant.
    pub(super) cov: [V<S>; 3],
    pub(super) det: V<S>,
    /// The determinant without blur, |v₀ × v₁|².
    pub(super) sharp_det: V<S>,
}

#[inline(always)]
pub(super) fn dot<S: Simd>(a: [V<S>; 3], b: [V<S>; 3]) -> V<S> {
    a[0].mul_add(b[0], a[1].mul_add(b[1], a[2] * b[2]))
}

/// The rows of the view's rotation, each number in every lane.
#[inline(always)]
pub(super) fn rotation<S: Simd>(s: S, view: &ViewParams) -> [[V<S>; 3]; 3] {
    each!(i in 3 => each!(k in 3 => V::splat(s, view.rotation[i][k])))
}

/// Lanes `at..` of the sixteen values of plane `plane` in `block`.
#[inline(always)]
pub(super) fn lanes<S: Simd>(s: S, block: &[f32], plane: usize, at: usize) -> V<S> {
    V::load(s, &block[plane * WIDTH + at..(plane + 1) * WIDTH])
}

/// Projects the lanes `at..` of one block.
#[inline(always)]
pub(super) fn geometry<S: Simd>(s: S, block: &[f32], at: usize, view: &ViewParams) -> Geometry<S> {
    let c = |x: f32| V::splat(s, x);
    let mean = each!(i in 3 => lanes(s, block, plane::MEAN + i, at));
    let scale = each!(i in 3 => lanes(s, block, plane::LOG_SCALE + i, at).exp());
    let raw = each!(i in 4 => lanes(s, block, plane::QUAT + i, at));
    let norm2 =
        raw[0].mul_add(raw[0], raw[1].mul_add(raw[1], raw[2].mul_add(raw[2], raw[3] * raw[3])));
    let quat_inv_norm = c(1.0) / norm2.sqrt();
    let quat = each!(i in 4 => raw[i] * quat_inv_norm);
    let [w, x, y, z] = quat;
    let two = c(2.0);
    let axes = [
        [c(1.0) - two * (y * y + z * z), two * (x * y + w * z), two * (x * z - w * y)],
        [two * (x * y - w * z), c(1.0) - two * (x * x + z * z), two * (y * z + w * x)],
        [two * (x * z + w * y), two * (y * z - w * x), c(1.0) - two * (x * x + y * y)],
    ];
    let rot = rotation(s, view);
    let p = each!(i in 3 => {
        let [r0, r1, r2] = rot[i];
        r0.mul_add(mean[0], r1.mul_add(mean[1], r2.mul_add(mean[2], c(view.translation[i]))))
    });
    let inv_z = c(1.0) / p[2];
    let ratio = [p[0] * inv_z, p[1] * inv_z];
    let clamped = each!(i in 2 => ratio[i].max(c(view.ratio_min[i])).min(c(view.ratio_max[i])));
    let n = each!(i in 2 => {
        let f = inv_z * view.focal[i];
        let b = each!(k in 3 => f * clamped[i].neg_mul_add(rot[2][k], rot[i][k]));
        each!(k in 3 => dot(b, axes[k]))
    });
    let v = each!(i in 2 => each!(k in 3 => n[i][k] * scale[k]));
    let (a, b, d) = (dot(v[0], v[0]), dot(v[0], v[1]), dot(v[1], v[1]));
    let cross = [
        difference_of_products(v[0][1], v[1][2], v[0][2], v[1][1]),
        difference_of_products(v[0][2], v[1][0], v[0][0], v[1][2]),
        difference_of_products(v[0][0], v[1][1], v[0][1], v[1][0]),
    ];
    let sharp_det = dot(cross, cross);
    let blur = view.blur;
    let det = sharp_det + (a + d) * blur + blur * blur;
    Geometry {
        scale,
        quat,
        quat_inv_norm,
        axes,
        p,
        inv_z,
        ratio,
        clamped,
        n,
        cov: [a + blur, b, d + blur],
        det,
        sharp_det,
    }
}

/// a·b − c·d with the rounding error of c·d compensated (Kahan).
#[inline(always)]
pub(super) fn difference_of_products<S: Simd>(a: V<S>, b: V<S>, c: V<S>, d: V<S>) -> V<S> {
    let cd = c * d;
    let error = c.neg_mul_add(d, cd);
    a.mul_add(b, -cd) + error
}

/// Conic factor (l₁, r, l₃), not scaled.
#[inline(always)]
pub(super) fn conic<S: Simd>(g: &Geometry<S>) -> [V<S>; 3] {
    let [_, b, d] = g.cov;
    let l3 = V::splat_like(d, 1.0) / d.sqrt();
    [(d / g.det).sqrt(), b / d, l3]
}

/// The unit vector from the camera to each mean, and 1/distance; both are 0 for a mean at the camera.
#[inline(always)]
pub(super) fn direction<S: Simd>(
    s: S,
    block: &[f32],
    at: usize,
    view: &ViewParams,
) -> ([V<S>; 3], V<S>) {
    let v = each!(i in 3 => lanes(s, block, plane::MEAN + i, at) - view.centre[i]);
    let norm2 = dot(v, v);
    // Below this length the square underflows; the direction and its gradient are then 0.
    let is_away = V::splat(s, 1e-30).lt(norm2);
    let inv = is_away.keep(V::splat(s, 1.0) / norm2.sqrt());
    (each!(i in 3 => v[i] * inv), inv)
}

/// Spherical-harmonic basis functions up to a degree in the direction `d`.
#[inline(always)]
pub(super) fn sh_basis<S: Simd>(s: S, degree: u8, d: [V<S>; 3]) -> [V<S>; 16] {
    let mut y = [V::zero(s); 16];
    y[0] = V::splat(s, sh::C0);
    sh::basis(degree, d, &mut y);
    y
}

/// ½ + Σ Y_k·sh_k per channel, before the clamp at 0.
#[inline(always)]
pub(super) fn raw_colour<S: Simd>(
    s: S,
    block: &[f32],
    at: usize,
    degree: u8,
    y: &[V<S>; 16],
) -> [V<S>; 3] {
    let mut colour = [V::splat(s, 0.5); 3];
    for (k, &basis) in y.iter().enumerate().take(sh_coefficients(degree)) {
        for (channel, sum) in colour.iter_mut().enumerate() {
            *sum = basis.mul_add(lanes(s, block, plane::SH + 3 * k + channel, at), *sum);
        }
    }
    colour
}

/// log₂ of the logistic function: min(x, 0)·log₂e − log₂(1 + e^−|x|).
#[inline(always)]
fn log2_sigmoid<S: Simd>(s: S, x: V<S>) -> V<S> {
    let tail = (V::splat(s, 1.0) + (-x.abs()).exp()).log2_of_1_to_2();
    x.min(V::zero(s)) * std::f32::consts::LOG2_E - tail
}

/// log₂ of ρ = √(det S / det Σ): the factor of opacities with antialiasing; at least −63.
#[inline(always)]
fn log2_rho<S: Simd>(s: S, g: &Geometry<S>) -> V<S> {
    (g.sharp_det / g.det).min(V::splat(s, 1.0)).log2().min(V::zero(s)) * 0.5
}

/// Returns whether |x| <= max; false for NaN.
#[inline(always)]
fn below<S: Simd>(x: V<S>, max: f32) -> Mask<S> {
    x.abs().le(V::splat_like(x, max))
}

/// True if a splat reaches any pixel centre (½ to size − ½). False for NaN, so that rows with NaN are not
/// rendered.
#[inline(always)]
fn reaches<S: Simd>(s: S, centre: V<S>, half: V<S>, size: u32) -> Mask<S> {
    let last = V::splat(s, size as f32 - 0.5);
    V::splat(s, 0.5).le(centre + half).and((centre - half).le(last))
}

/// Projects consecutive blocks and marks the rows on screen.
pub(super) struct Project<'a> {
    pub(super) view: &'a ViewParams,
    /// [`Shortcuts::log2_reach`](crate::Shortcuts::log2_reach).
    pub(super) log2_reach: f32,
    /// The parameter blocks.
    pub(super) params: ParameterView<'a>,
    /// Number of rows; the last block may be partly empty.
    pub(super) rows: usize,
    /// Shape: `[rows]`.
    pub(super) splats: &'a mut [Splat],
    /// One bit per lane of each block, set if the row is on screen. Shape: `[blocks]`.
    pub(super) seen: &'a mut [u16],
}

impl WithSimd for Project<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, s: S) {
        let view = self.view;
        let degree = view.sh_degree;
        let grid = Grid::new(view.width, view.height);
        let mut scratch = Scratch::ZERO;
        for b in 0..self.params.blocks {
            let block = self.params.open(b, planes(degree), &mut scratch);
            let mut out = [[0.0_f32; WIDTH]; SPLAT_FIELDS];
            let mut on_screen = [0.0_f32; WIDTH];
            for at in (0..WIDTH).step_by(S::F32_LANES) {
                let g = geometry(s, block, at, view);
                let in_front = V::splat(s, view.near).lt(g.p[2]);
                let logit = lanes(s, block, plane::OPACITY, at);
                // Minimum and maximum may drop a NaN, so log-scales and logit are checked directly.
                let sound =
                    each!(i in 3 => below(lanes(s, block, plane::LOG_SCALE + i, at), f32::MAX));
                let sound = sound[0].and(sound[1]).and(sound[2]).and(below(logit, f32::MAX));
                let mut log2_opacity = log2_sigmoid(s, logit);
                if view.lowers_opacity {
                    log2_opacity = log2_opacity + log2_rho(s, &g);
                }
                // The allowed decrease of the exponent; <= 0 if even the centre is too faint.
                let reach = log2_opacity + self.log2_reach;
                let opaque = V::zero(s).lt(reach);
                // The determinant overflows if a splat is about 4·10⁹ px wide; its conic factors are then invalid.
                let rendered = in_front.and(opaque).and(sound).and(below(g.det, f32::MAX));
                if !rendered.any() {
                    continue;
                }
                let [l1, shear, l3] = conic(&g);
                let radius = reach.max(V::zero(s)).sqrt() * (1.0 / EXPONENT_SCALE);
                let half_width = radius * g.cov[0].sqrt();
                let half_height = radius * g.cov[2].sqrt();
                let u =
                    g.ratio[0].mul_add(V::splat(s, view.focal[0]), V::splat(s, view.principal[0]));
                let v =
                    g.ratio[1].mul_add(V::splat(s, view.focal[1]), V::splat(s, view.principal[1]));
                let rendered = rendered.and(reaches(s, u, half_width, view.width)).and(reaches(
                    s,
                    v,
                    half_height,
                    view.height,
                ));
                if !rendered.any() {
                    continue;
                }
                let (dir, _) = direction(s, block, at, view);
                let y = sh_basis(s, degree, dir);
                let raw = raw_colour(s, block, at, degree, &y);
                let colour = each!(i in 3 => raw[i].max(V::zero(s)));
                let sound = each!(i in 3 => below(raw[i], COLOUR_MAX));
                let rendered = rendered.and(sound[0]).and(sound[1]).and(sound[2]);
                let ellipse = Ellipse {
                    s,
                    mean: [u, v],
                    half_sides: [half_width, half_height],
                    shear,
                    l3: l3 * EXPONENT_SCALE,
                    inv_l1: V::splat(s, 1.0 / EXPONENT_SCALE) / l1,
                    peak: g.cov[1] / g.cov[0] * half_width,
                    reach,
                };
                let fields = [
                    u,
                    v,
                    l1 * EXPONENT_SCALE,
                    shear,
                    ellipse.l3,
                    log2_opacity,
                    colour[0],
                    colour[1],
                    colour[2],
                    g.p[2],
                    half_height,
                    half_width,
                    ellipse.inv_l1,
                    ellipse.peak,
                    reach,
                    V::of_bits(s, ellipse.tiles(&grid)),
                ];
                for (line, field) in out.iter_mut().zip(fields) {
                    field.store(&mut line[at..]);
                }
                rendered.keep(V::splat(s, 1.0)).store(&mut on_screen[at..]);
            }
            let used_lanes = WIDTH.min(self.rows - b * WIDTH);
            self.seen[b] = 0;
            for lane in 0..used_lanes {
                if on_screen[lane] == 0.0 {
                    continue;
                }
                let row = b * WIDTH + lane;
                let mut fields = [0.0; SPLAT_FIELDS];
                for (field, line) in fields.iter_mut().zip(&out) {
                    *field = line[lane];
                }
                self.seen[b] |= 1 << lane;
                self.splats[row] = bytemuck::cast(fields);
            }
        }
    }
}
