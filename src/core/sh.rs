//! Real spherical harmonics up to degree 3, in the order and with the signs of the original
//! 3D Gaussian Splatting files (Sloan, *Efficient Spherical Harmonic Evaluation*, JCGT 2(2), 2013).
//!
//! Written once for any number type, so that scalar and SIMD code evaluate the same formula.

use std::ops::{Add, Mul, Neg, Sub};

/// The constant basis function of band 0.
pub const C0: f32 = 0.282_094_79;
const C1: f32 = 0.488_602_51;
const C2: [f32; 5] = [1.092_548_4, -1.092_548_4, 0.315_391_57, -1.092_548_4, 0.546_274_2];
const C3: [f32; 7] = [
    -0.590_043_6,
    2.890_611_4,
    -0.457_045_8,
    0.373_176_33,
    -0.457_045_8,
    1.445_305_7,
    -0.590_043_6,
];

/// The arithmetic that the formulas need.
pub trait Real:
    Copy
    + Add<Output = Self>
    + Sub<Output = Self>
    + Mul<Output = Self>
    + Mul<f32, Output = Self>
    + Add<f32, Output = Self>
    + Sub<f32, Output = Self>
    + Neg<Output = Self>
{
}
impl<T> Real for T where
    T: Copy
        + Add<Output = T>
        + Sub<Output = T>
        + Mul<Output = T>
        + Mul<f32, Output = T>
        + Add<f32, Output = T>
        + Sub<f32, Output = T>
        + Neg<Output = T>
{
}

/// Evaluates Y_1 … Y_15 at the unit vector `d`, up to `degree`; the rest of `y` is unchanged. Y_0 is the
/// constant [`C0`].
#[inline(always)]
pub fn basis<T: Real>(degree: u8, d: [T; 3], y: &mut [T; 16]) {
    let [dx, dy, dz] = d;
    if degree == 0 {
        return;
    }
    y[1] = -(dy * C1);
    y[2] = dz * C1;
    y[3] = -(dx * C1);
    if degree == 1 {
        return;
    }
    let (xx, yy, zz) = (dx * dx, dy * dy, dz * dz);
    let (xy, yz, xz) = (dx * dy, dy * dz, dx * dz);
    y[4] = xy * C2[0];
    y[5] = yz * C2[1];
    y[6] = (zz * 2.0 - xx - yy) * C2[2];
    y[7] = xz * C2[3];
    y[8] = (xx - yy) * C2[4];
    if degree == 2 {
        return;
    }
    y[9] = dy * (xx * 3.0 - yy) * C3[0];
    y[10] = xy * dz * C3[1];
    y[11] = dy * (zz * 4.0 - xx - yy) * C3[2];
    y[12] = dz * (zz * 2.0 - xx * 3.0 - yy * 3.0) * C3[3];
    y[13] = dx * (zz * 4.0 - xx - yy) * C3[4];
    y[14] = dz * (xx - yy) * C3[5];
    y[15] = dx * (xx - yy * 3.0) * C3[6];
}

/// Σ_k g_k ∇Y_k(d), the gradient of Σ g_k Y_k with respect to the (unconstrained) vector `d`.
/// `g[0]` is not read: Y_0 is constant. `zero` is the additive identity.
#[inline(always)]
pub fn basis_gradient<T: Real>(degree: u8, d: [T; 3], g: &[T; 16], zero: T) -> [T; 3] {
    let [dx, dy, dz] = d;
    if degree == 0 {
        return [zero; 3];
    }
    let mut gx = -(g[3] * C1);
    let mut gy = -(g[1] * C1);
    let mut gz = g[2] * C1;
    if degree == 1 {
        return [gx, gy, gz];
    }
    let g4 = g[4] * C2[0];
    let g5 = g[5] * C2[1];
    let g6 = g[6] * (2.0 * C2[2]);
    let g7 = g[7] * C2[3];
    let g8 = g[8] * (2.0 * C2[4]);
    gx = gx + g4 * dy - g6 * dx + g7 * dz + g8 * dx;
    gy = gy + g4 * dx + g5 * dz - g6 * dy - g8 * dy;
    gz = gz + g5 * dy + g6 * dz * 2.0 + g7 * dx;
    if degree == 2 {
        return [gx, gy, gz];
    }
    let (xx, yy, zz) = (dx * dx, dy * dy, dz * dz);
    let (xy, yz, xz) = (dx * dy, dy * dz, dx * dz);
    let g9 = g[9] * (3.0 * C3[0]);
    let g10 = g[10] * C3[1];
    let g11 = g[11] * C3[2];
    let g12 = g[12] * (3.0 * C3[3]);
    let g13 = g[13] * C3[4];
    let g14 = g[14] * C3[5];
    let g15 = g[15] * (3.0 * C3[6]);
    gx = gx + g9 * xy * 2.0 + g10 * yz - g11 * xy * 2.0 - g12 * xz * 2.0
        + g13 * (zz * 4.0 - xx * 3.0 - yy)
        + g14 * xz * 2.0
        + g15 * (xx - yy);
    gy = gy + g9 * (xx - yy) + g10 * xz + g11 * (zz * 4.0 - xx - yy * 3.0)
        - g12 * yz * 2.0
        - g13 * xy * 2.0
        - g14 * yz * 2.0
        - g15 * xy * 2.0;
    gz = gz
        + g10 * xy
        + g11 * yz * 8.0
        + g12 * (zz * 2.0 - xx - yy)
        + g13 * xz * 8.0
        + g14 * (xx - yy);
    [gx, gy, gz]
}

#[cfg(test)]
mod tests {
    use super::*;

    fn unit(i: u32) -> [f32; 3] {
        // A Fibonacci sphere: evenly spread directions.
        let z = 1.0 - (2.0 * i as f32 + 1.0) / 2000.0;
        let (sin, cos) = (i as f32 * 2.399_963).sin_cos();
        let r = (1.0 - z * z).sqrt();
        [r * cos, r * sin, z]
    }

    #[test]
    fn basis_is_orthonormal() {
        let mut gram = [[0.0_f64; 16]; 16];
        for i in 0..2000 {
            let mut y = [0.0_f32; 16];
            y[0] = C0;
            basis(3, unit(i), &mut y);
            for (row, &a) in gram.iter_mut().zip(&y) {
                for (cell, &b) in row.iter_mut().zip(&y) {
                    *cell += f64::from(a * b) * 4.0 * std::f64::consts::PI / 2000.0;
                }
            }
        }
        for (i, row) in gram.iter().enumerate() {
            for (j, &cell) in row.iter().enumerate() {
                let expected = if i == j { 1.0 } else { 0.0 };
                assert!((cell - expected).abs() < 5e-3, "<Y{i}, Y{j}> = {cell}");
            }
        }
    }

    #[test]
    fn gradient_agrees_with_central_differences() {
        let g: [f32; 16] = std::array::from_fn(|k| (k as f32 * 0.7).sin());
        let value = |d: [f32; 3]| {
            let mut y = [0.0_f32; 16];
            basis(3, d, &mut y);
            y.iter().zip(&g).map(|(&a, &b)| f64::from(a) * f64::from(b)).sum::<f64>()
        };
        for i in [3, 500, 1200, 1999] {
            let d = unit(i);
            let analytic = basis_gradient(3, d, &g, 0.0);
            for axis in 0..3 {
                let h = 1e-2;
                let (mut up, mut down) = (d, d);
                up[axis] += h;
                down[axis] -= h;
                let numeric = (value(up) - value(down)) / f64::from(up[axis] - down[axis]);
                // For the cubic band, central differences have an error of order h².
                assert!((f64::from(analytic[axis]) - numeric).abs() < 2e-3);
            }
        }
    }
}
