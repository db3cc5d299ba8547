//! Projection of rows to splats, and its derivative: pose, covariance, spherical harmonics.

use glam::{DMat3, DVec3};

use super::{FRUSTUM_MARGIN, Model, Rules, ScreenGradient, View};

/// A projected row.
#[derive(Debug, Clone, Copy)]
pub struct Splat {
    /// True if the row lies beyond the near plane; otherwise the other fields are meaningless.
    pub in_front: bool,
    /// Projected mean `[px]`.
    pub mean: [f64; 2],
    /// Camera z [scene units].
    pub depth: f64,
    /// Projected covariance (xx, xy, yy) `[px²]`, blur included.
    pub covariance: [f64; 3],
    /// Inverse of the covariance (A, B, C) [1/px²].
    pub conic: [f64; 3],
    /// Colour before the clamp at 0.
    pub colour: [f64; 3],
    /// The row's opacity before antialiasing, in (0, 1).
    pub own_opacity: f64,
    /// ρ² = det S/det C with antialiasing, else 1; C is the projected covariance, and S the same without blur.
    pub rho2: f64,
    /// Opacity as blended: `own_opacity` times ρ.
    pub opacity: f64,
}

/// Intermediate values of a projection that its derivative needs again.
struct Geometry {
    /// Mean in camera coordinates.
    local: DVec3,
    /// x/z and y/z as the Jacobian uses them.
    slope: [f64; 2],
    /// True if the slope is clamped.
    clamped: [bool; 2],
    /// Camera rotation.
    rotation: DMat3,
    /// Rotation of the row times its scale: covariance = m·mᵀ.
    m: DMat3,
    /// Rotation of the row.
    axes: DMat3,
    /// Standard deviations along its axes `[scene units]`.
    scale: DVec3,
}

impl Geometry {
    fn new(model: &Model, row: usize, view: View<'_>) -> Self {
        let camera = view.camera;
        let local = camera.rotation * DVec3::from(model.means[row]) + camera.translation;
        let limits = |size: u32, focal: f64, centre: f64| {
            let (half, margin) = (0.5 * f64::from(size), FRUSTUM_MARGIN);
            let excess = (margin - 1.0) * half;
            ((-centre - excess) / focal, (f64::from(size) - centre + excess) / focal)
        };
        let raw = [local.x / local.z, local.y / local.z];
        let bounds = [
            limits(camera.width, camera.fx, camera.cx),
            limits(camera.height, camera.fy, camera.cy),
        ];
        let clamped = [0, 1].map(|i| raw[i] < bounds[i].0 || raw[i] > bounds[i].1);
        let slope = [0, 1].map(|i| raw[i].max(bounds[i].0).min(bounds[i].1));
        let axes = rotation_of(model.quats[row]);
        let scale = DVec3::from(model.log_scales[row].map(f64::exp));
        let m = axes * DMat3::from_diagonal(scale);
        Self { local, slope, clamped, rotation: camera.rotation, m, axes, scale }
    }

    /// d(pixel)/d(local), as two rows.
    fn jacobian(&self, view: View<'_>) -> [DVec3; 2] {
        let (fx, fy, z) = (view.camera.fx, view.camera.fy, self.local.z);
        [
            DVec3::new(fx / z, 0.0, -fx * self.slope[0] / z),
            DVec3::new(0.0, fy / z, -fy * self.slope[1] / z),
        ]
    }
}

/// Projects all rows of a model.
pub fn project(model: &Model, view: View<'_>, rules: &Rules) -> Vec<Splat> {
    (0..model.rows())
        .map(|row| {
            let geometry = Geometry::new(model, row, view);
            let local = geometry.local;
            let sigma = geometry.m * geometry.m.transpose();
            // Rows of J·W; covariance = (JW)·Σ·(JW)ᵀ.
            let jw = geometry.jacobian(view).map(|j| geometry.rotation.transpose() * j);
            let blur = model.blur();
            let a = jw[0].dot(sigma * jw[0]) + blur;
            let b = jw[0].dot(sigma * jw[1]);
            let c = jw[1].dot(sigma * jw[1]) + blur;
            let determinant = a * c - b * b;
            let rho2 = if model.antialiasing.is_on() {
                ((a - blur) * (c - blur) - b * b).max(0.0) / determinant
            } else {
                1.0
            };
            let own_opacity = 1.0 / (1.0 + (-model.opacity_logits[row]).exp());
            Splat {
                in_front: local.z >= rules.near,
                mean: [
                    view.camera.fx * local.x / local.z + view.camera.cx,
                    view.camera.fy * local.y / local.z + view.camera.cy,
                ],
                depth: local.z,
                covariance: [a, b, c],
                conic: [c / determinant, -b / determinant, a / determinant],
                colour: colour(model, row, view),
                own_opacity,
                rho2,
                opacity: own_opacity * rho2.sqrt(),
            }
        })
        .collect()
}

/// Rows in front of the camera, front to back; equal depths by row.
pub fn by_depth(splats: &[Splat]) -> Vec<usize> {
    let mut order: Vec<usize> = (0..splats.len()).filter(|&i| splats[i].in_front).collect();
    order.sort_by(|&i, &j| splats[i].depth.total_cmp(&splats[j].depth).then(i.cmp(&j)));
    order
}

/// Gradients of the parameters from those of the projected rows.
pub fn backward(
    model: &Model,
    view: View<'_>,
    splats: &[Splat],
    screen: &[ScreenGradient],
) -> Model {
    let mut gradient = Model::zeros(model.rows(), model.coefficients);
    for row in 0..model.rows() {
        if !splats[row].in_front {
            continue;
        }
        let (splat, upstream) = (&splats[row], &screen[row]);
        gradient.opacity_logits[row] = upstream.opacity * splat.opacity * (1.0 - splat.own_opacity);
        let d_mean = geometry_backward(model, row, view, splat, upstream, &mut gradient)
            + colour_backward(model, row, view, splat, upstream, &mut gradient);
        gradient.means[row] = d_mean.to_array();
    }
    gradient
}

fn geometry_backward(
    model: &Model,
    row: usize,
    view: View<'_>,
    splat: &Splat,
    upstream: &ScreenGradient,
    gradient: &mut Model,
) -> DVec3 {
    let geometry = Geometry::new(model, row, view);
    let (fx, fy) = (view.camera.fx, view.camera.fy);
    let DVec3 { x, y, z } = geometry.local;
    // d(covariance) = −Q·d(Q)·Q with Q the conic; B enters the exponent once, hence the halves.
    let [qa, qb, qc] = splat.conic;
    let [ga, gb, gc] = [upstream.conic[0], 0.5 * upstream.conic[1], upstream.conic[2]];
    let (t00, t01) = (qa * ga + qb * gb, qa * gb + qb * gc);
    let (t10, t11) = (qb * ga + qc * gb, qb * gb + qc * gc);
    let mut d_cov = [-(t00 * qa + t01 * qb), -(t00 * qb + t01 * qc), -(t10 * qb + t11 * qc)];
    if model.antialiasing.is_on() && splat.rho2 > 0.0 {
        // By the quotient rule, d(ρ²)/dS = (adj S − ρ²·adj C)/det C, as S and C differ by a constant.
        let ([a, b, c], blur, rho2) = (splat.covariance, model.blur(), splat.rho2);
        let determinant = a * c - b * b;
        let d_rho2 = upstream.opacity * splat.own_opacity / (2.0 * rho2.sqrt());
        d_cov[0] += d_rho2 * (c - blur - rho2 * c) / determinant;
        d_cov[1] -= d_rho2 * b * (1.0 - rho2) / determinant;
        d_cov[2] += d_rho2 * (a - blur - rho2 * a) / determinant;
    }
    let jacobian = geometry.jacobian(view);
    let jw = jacobian.map(|j| geometry.rotation.transpose() * j);
    let sigma = geometry.m * geometry.m.transpose();

    // covariance = (JW)·Σ·(JW)ᵀ: gradients of the rows of JW, then of J.
    let d_jw = [
        2.0 * (sigma * (d_cov[0] * jw[0] + d_cov[1] * jw[1])),
        2.0 * (sigma * (d_cov[1] * jw[0] + d_cov[2] * jw[1])),
    ];
    let d_j = d_jw.map(|d| geometry.rotation * d);
    let d_slope = [-fx / z * d_j[0].z, -fy / z * d_j[1].z];
    let mut d_local = DVec3::new(
        fx / z * upstream.mean[0],
        fy / z * upstream.mean[1],
        upstream.depth
            - (fx * x * upstream.mean[0] + fy * y * upstream.mean[1]) / (z * z)
            - (fx * d_j[0].x + fy * d_j[1].y) / (z * z)
            + (fx * geometry.slope[0] * d_j[0].z + fy * geometry.slope[1] * d_j[1].z) / (z * z),
    );
    for axis in (0..2).filter(|&axis| !geometry.clamped[axis]) {
        d_local[axis] += d_slope[axis] / z;
        d_local.z -= d_slope[axis] * geometry.local[axis] / (z * z);
    }

    // Gradient of Σ = m·mᵀ, then of scale and rotation.
    let outer = |u: DVec3, v: DVec3| DMat3::from_cols(u * v.x, u * v.y, u * v.z);
    let d_sigma = d_cov[0] * outer(jw[0], jw[0])
        + d_cov[1] * (outer(jw[0], jw[1]) + outer(jw[1], jw[0]))
        + d_cov[2] * outer(jw[1], jw[1]);
    let d_m = 2.0 * (d_sigma * geometry.m);
    let mut d_axes = [DVec3::ZERO; 3];
    for (axis, d_axis) in d_axes.iter_mut().enumerate() {
        let (column, s) = (d_m.col(axis), geometry.scale[axis]);
        gradient.log_scales[row][axis] = column.dot(geometry.axes.col(axis)) * s;
        *d_axis = column * s;
    }
    gradient.quats[row] = rotation_backward(model.quats[row], d_axes);
    geometry.rotation.transpose() * d_local
}

/// A coefficient and the two quaternion components that it multiplies.
type Product = (f64, usize, usize);

/// Entry (i, j) of the rotation matrix of a unit quaternion (w, x, y, z) is
/// δij + Σ of coefficient · q[a] · q[b] over the entry's terms.
const ROTATION: [[&[Product]; 3]; 3] = [
    [&[(-2.0, 2, 2), (-2.0, 3, 3)], &[(2.0, 1, 2), (-2.0, 0, 3)], &[(2.0, 1, 3), (2.0, 0, 2)]],
    [&[(2.0, 1, 2), (2.0, 0, 3)], &[(-2.0, 1, 1), (-2.0, 3, 3)], &[(2.0, 2, 3), (-2.0, 0, 1)]],
    [&[(2.0, 1, 3), (-2.0, 0, 2)], &[(2.0, 2, 3), (2.0, 0, 1)], &[(-2.0, 1, 1), (-2.0, 2, 2)]],
];

fn norm(q: [f64; 4]) -> f64 {
    q.iter().map(|v| v * v).sum::<f64>().sqrt()
}

fn rotation_of(q: [f64; 4]) -> DMat3 {
    let unit = q.map(|v| v / norm(q));
    let mut columns = DMat3::IDENTITY.to_cols_array_2d();
    for (i, row) in ROTATION.iter().enumerate() {
        for (j, terms) in row.iter().enumerate() {
            columns[j][i] += terms.iter().map(|&(k, a, b)| k * unit[a] * unit[b]).sum::<f64>();
        }
    }
    DMat3::from_cols_array_2d(&columns)
}

/// Gradient of a quaternion from that of its rotation matrix: `d_columns[j][i]` belongs to entry (i, j).
fn rotation_backward(q: [f64; 4], d_columns: [DVec3; 3]) -> [f64; 4] {
    let length = norm(q);
    let unit = q.map(|v| v / length);
    let mut d_unit = [0.0; 4];
    for (i, row) in ROTATION.iter().enumerate() {
        for (j, terms) in row.iter().enumerate() {
            for &(k, a, b) in *terms {
                d_unit[a] += d_columns[j][i] * k * unit[b];
                d_unit[b] += d_columns[j][i] * k * unit[a];
            }
        }
    }
    let along: f64 = unit.iter().zip(&d_unit).map(|(u, d)| u * d).sum();
    [0, 1, 2, 3].map(|i| (d_unit[i] - unit[i] * along) / length)
}

/// A monomial: coefficient and powers of x, y, z.
type Monomial = (f64, [i32; 3]);

/// The real spherical harmonics of degrees 0–3, with the order and signs of the original 3DGS code.
#[rustfmt::skip]
const HARMONICS: [&[Monomial]; 16] = {
    const D0: f64 = 0.282_094_791_773_878_14;
    const D1: f64 = 0.488_602_511_902_919_9;
    const XY: f64 = 1.092_548_430_592_079_2;
    const ZZ: f64 = 0.315_391_565_252_520_05;
    const XX: f64 = 0.546_274_215_296_039_6;
    const C0: f64 = 0.590_043_589_926_643_5;
    const C1: f64 = 2.890_611_442_640_554;
    const C2: f64 = 0.457_045_799_464_465_8;
    const C3: f64 = 0.373_176_332_590_115_4;
    const C5: f64 = 1.445_305_721_320_277;
    [
        &[(D0, [0, 0, 0])],
        &[(-D1, [0, 1, 0])],
        &[(D1, [0, 0, 1])],
        &[(-D1, [1, 0, 0])],
        &[(XY, [1, 1, 0])],
        &[(-XY, [0, 1, 1])],
        &[(2.0 * ZZ, [0, 0, 2]), (-ZZ, [2, 0, 0]), (-ZZ, [0, 2, 0])],
        &[(-XY, [1, 0, 1])],
        &[(XX, [2, 0, 0]), (-XX, [0, 2, 0])],
        &[(-3.0 * C0, [2, 1, 0]), (C0, [0, 3, 0])],
        &[(C1, [1, 1, 1])],
        &[(-4.0 * C2, [0, 1, 2]), (C2, [2, 1, 0]), (C2, [0, 3, 0])],
        &[(2.0 * C3, [0, 0, 3]), (-3.0 * C3, [2, 0, 1]), (-3.0 * C3, [0, 2, 1])],
        &[(-4.0 * C2, [1, 0, 2]), (C2, [3, 0, 0]), (C2, [1, 2, 0])],
        &[(C5, [2, 0, 1]), (-C5, [0, 2, 1])],
        &[(-C0, [3, 0, 0]), (3.0 * C0, [1, 2, 0])],
    ]
};

fn evaluate(harmonic: &[Monomial], d: DVec3) -> f64 {
    harmonic.iter().map(|(k, p)| k * d.x.powi(p[0]) * d.y.powi(p[1]) * d.z.powi(p[2])).sum()
}

fn derivative(harmonic: &[Monomial], d: DVec3) -> DVec3 {
    let mut gradient = DVec3::ZERO;
    for &(k, powers) in harmonic {
        for axis in 0..3 {
            if powers[axis] > 0 {
                let mut lower = powers;
                lower[axis] -= 1;
                gradient[axis] += evaluate(&[(k * f64::from(powers[axis]), lower)], d);
            }
        }
    }
    gradient
}

fn active_harmonics(view: View<'_>) -> impl Iterator<Item = (usize, &'static [Monomial])> {
    let count = (usize::from(view.sh_degree) + 1).pow(2);
    HARMONICS.into_iter().take(count).enumerate()
}

/// Vector from the camera to the row's mean, not normalised.
fn camera_to_mean(model: &Model, row: usize, view: View<'_>) -> DVec3 {
    let centre = -(view.camera.rotation.transpose() * view.camera.translation);
    DVec3::from(model.means[row]) - centre
}

fn colour(model: &Model, row: usize, view: View<'_>) -> [f64; 3] {
    let direction = camera_to_mean(model, row, view).normalize();
    let mut colour = [0.5; 3];
    for (k, harmonic) in active_harmonics(view) {
        let value = evaluate(harmonic, direction);
        for (c, channel) in colour.iter_mut().enumerate() {
            *channel += value * model.sh[(row * model.coefficients + k) * 3 + c];
        }
    }
    colour
}

fn colour_backward(
    model: &Model,
    row: usize,
    view: View<'_>,
    splat: &Splat,
    upstream: &ScreenGradient,
    gradient: &mut Model,
) -> DVec3 {
    let offset = camera_to_mean(model, row, view);
    let direction = offset.normalize();
    let d_colour = [0, 1, 2].map(|c| if splat.colour[c] > 0.0 { upstream.colour[c] } else { 0.0 });
    let mut d_direction = DVec3::ZERO;
    for (k, harmonic) in active_harmonics(view) {
        let value = evaluate(harmonic, direction);
        let slope = derivative(harmonic, direction);
        for (c, d) in d_colour.iter().enumerate() {
            let index = (row * model.coefficients + k) * 3 + c;
            gradient.sh[index] = value * d;
            d_direction += slope * (d * model.sh[index]);
        }
    }
    (d_direction - direction * direction.dot(d_direction)) / offset.length()
}
