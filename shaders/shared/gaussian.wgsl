// A row's projection and colour, for the forward and the backward pass: the functions of
// src/render/cpu/project.rs, which derives the formulas.

@group(0) @binding(1) var<storage, read> rows: array<RowPart>;
@group(0) @binding(2) var<storage, read> sh0: array<Coefficient>;
@group(0) @binding(3) var<storage, read> sh1: array<Coefficient>;
@group(0) @binding(4) var<storage, read> sh2: array<Coefficient>;
@group(0) @binding(5) var<storage, read> sh3: array<Coefficient>;

// Variance added to both diagonal entries of a projected covariance [px²]; with antialiasing, the kernel.
override BLUR: f32 = 0.3;
// True if the blur lowers opacities (antialiasing).
override LOWERS_OPACITY: bool = false;
// √(½·log₂ e): the conic factors of splats are scaled by this, so that exp becomes exp2.
const EXPONENT_SCALE: f32 = 0.8493218;
const COLOUR_MAX: f32 = 1e6;

// log2 of x in [1, 2]; absolute error below 3e-7.
fn log2_of_1_to_2(x: f32) -> f32 {
    let t = (x - 1.0) / (x + 1.0);
    let t2 = t * t;
    var p = fma(1.0 / 13.0, t2, 1.0 / 11.0);
    p = fma(p, t2, 1.0 / 9.0);
    p = fma(p, t2, 1.0 / 7.0);
    p = fma(p, t2, 1.0 / 5.0);
    p = fma(p, t2, 1.0 / 3.0);
    p = fma(p, t2, 1.0);
    return t * p * (2.0 * LOG2_E);
}

fn log2_sigmoid(x: f32) -> f32 {
    return min(x, 0.0) * LOG2_E - log2_of_1_to_2(1.0 + exp_exact(-abs(x)));
}

// log2 of x >= 0; 0 and subnormal numbers count as 2^−126.
fn log2_exact(x: f32) -> f32 {
    let bits = bitcast<u32>(max(x, 1.1754944e-38));
    let between_1_and_2 = bitcast<f32>((bits & 0x007fffffu) | 0x3f800000u);
    return f32(bits >> 23u) - 127.0 + log2_of_1_to_2(between_1_and_2);
}

// The results of the forward projection that the backward pass uses too.
struct Geometry {
    scale: vec3<f32>,
    quat: vec4<f32>,
    quat_inv_norm: f32,
    axis0: vec3<f32>,
    axis1: vec3<f32>,
    axis2: vec3<f32>,
    p: vec3<f32>,
    inv_z: f32,
    ratio: vec2<f32>,
    clamped: vec2<f32>,
    // n[i][k] = (row i of J·W) · (axis k); V = n · scale.
    n0: vec3<f32>,
    n1: vec3<f32>,
    // Covariance with blur (a, b, c), and its determinant.
    cov: vec3<f32>,
    det: f32,
    // The determinant without blur.
    sharp_det: f32,
}

// a·b − c·d, with a correction for the rounding error of the second product (Kahan).
fn difference_of_products(a: f32, b: f32, c: f32, d: f32) -> f32 {
    let cd = c * d;
    let error = fma(-c, d, cd);
    return fma(a, b, -cd) + error;
}

fn geometry(row: Row) -> Geometry {
    var g: Geometry;
    g.scale = vec3(exp_exact(row.log_scale.x), exp_exact(row.log_scale.y), exp_exact(row.log_scale.z));
    g.quat_inv_norm = 1.0 / sqrt(dot(row.quat, row.quat));
    g.quat = row.quat * g.quat_inv_norm;
    let w = g.quat.x;
    let x = g.quat.y;
    let y = g.quat.z;
    let z = g.quat.w;
    g.axis0 = vec3(1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y));
    g.axis1 = vec3(2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x));
    g.axis2 = vec3(2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y));
    let r0 = frame.rotation[0];
    let r1 = frame.rotation[1];
    let r2 = frame.rotation[2];
    g.p = vec3(
        dot(r0.xyz, row.mean) + r0.w,
        dot(r1.xyz, row.mean) + r1.w,
        dot(r2.xyz, row.mean) + r2.w,
    );
    g.inv_z = 1.0 / g.p.z;
    g.ratio = g.p.xy * g.inv_z;
    g.clamped = min(max(g.ratio, frame.ratio.xy), frame.ratio.zw);
    let b0 = frame.lens.x * g.inv_z * (r0.xyz - g.clamped.x * r2.xyz);
    let b1 = frame.lens.y * g.inv_z * (r1.xyz - g.clamped.y * r2.xyz);
    g.n0 = vec3(dot(b0, g.axis0), dot(b0, g.axis1), dot(b0, g.axis2));
    g.n1 = vec3(dot(b1, g.axis0), dot(b1, g.axis1), dot(b1, g.axis2));
    let v0 = g.n0 * g.scale;
    let v1 = g.n1 * g.scale;
    let a = dot(v0, v0);
    let d = dot(v1, v1);
    let across = vec3(
        difference_of_products(v0.y, v1.z, v0.z, v1.y),
        difference_of_products(v0.z, v1.x, v0.x, v1.z),
        difference_of_products(v0.x, v1.y, v0.y, v1.x),
    );
    g.sharp_det = dot(across, across);
    g.det = g.sharp_det + (a + d) * BLUR + BLUR * BLUR;
    g.cov = vec3(a + BLUR, dot(v0, v1), d + BLUR);
    return g;
}

// log2 of the factor of opacities with antialiasing.
fn log2_rho(g: Geometry) -> f32 {
    return 0.5 * min(log2_exact(min(g.sharp_det / g.det, 1.0)), 0.0);
}

// Conic factor (l1, r, l3), not scaled.
fn conic(g: Geometry) -> vec3<f32> {
    return vec3(sqrt(g.cov.z / g.det), g.cov.y / g.cov.z, 1.0 / sqrt(g.cov.z));
}

const C0: f32 = 0.28209479;
const C1: f32 = 0.48860251;
const C20: f32 = 1.0925484;
const C22: f32 = 0.31539157;
const C24: f32 = 0.5462742;
const C30: f32 = -0.5900436;
const C31: f32 = 2.8906114;
const C32: f32 = -0.4570458;
const C33: f32 = 0.37317633;
const C35: f32 = 1.4453057;

// Basis functions at the unit vector d; see src/core/sh.rs.
fn basis(degree: u32, d: vec3<f32>) -> array<f32, 16> {
    var y: array<f32, 16>;
    y[0] = C0;
    if degree >= 1u {
        y[1] = -C1 * d.y;
        y[2] = C1 * d.z;
        y[3] = -C1 * d.x;
    }
    let xx = d.x * d.x;
    let yy = d.y * d.y;
    let zz = d.z * d.z;
    if degree >= 2u {
        y[4] = C20 * d.x * d.y;
        y[5] = -C20 * d.y * d.z;
        y[6] = C22 * (2.0 * zz - xx - yy);
        y[7] = -C20 * d.x * d.z;
        y[8] = C24 * (xx - yy);
    }
    if degree >= 3u {
        y[9] = C30 * d.y * (3.0 * xx - yy);
        y[10] = C31 * d.x * d.y * d.z;
        y[11] = C32 * d.y * (4.0 * zz - xx - yy);
        y[12] = C33 * d.z * (2.0 * zz - 3.0 * xx - 3.0 * yy);
        y[13] = C32 * d.x * (4.0 * zz - xx - yy);
        y[14] = C35 * d.z * (xx - yy);
        y[15] = C30 * d.x * (xx - 3.0 * yy);
    }
    return y;
}

// 1/2 + the sum of Y_k·sh_k per channel, before the clamp at 0.
fn raw_colour(row: u32, degree: u32, y: ptr<function, array<f32, 16>>) -> vec3<f32> {
    var colour = vec3(0.5);
    let count = (degree + 1u) * (degree + 1u);
    for (var k = 0u; k < count; k++) {
        colour += (*y)[k] * coefficient(row, k);
    }
    return colour;
}
