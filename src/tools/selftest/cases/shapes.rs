//! Rows of every shape and size, in general position and far outside the frustum.

use super::{GREEN, axis_camera, flat_colour};
use crate::compare::relative_error;
use crate::scenes;
use crate::trial::{Trial, count_non_finite};
use densify_core::camera::Camera;
use densify_core::gaussians::Gaussians;
use densify_render::BackendError;

pub(super) fn ordinary(trial: &mut Trial<'_>) -> Result<(), BackendError> {
    for degree in 0..=3 {
        let camera = scenes::camera(49, 35, 10 + u64::from(degree));
        let model = scenes::cloud(40, degree, &camera, 20 + u64::from(degree));
        for active in 0..=degree {
            let label = format!("degree {active} of {degree}");
            trial.check(&label, &model, &camera, [0.2, 0.7, 0.4], active)?;
        }
    }
    Ok(())
}

/// A cloud in which every second row has log-scales `value`.
fn cloud_of_scale(camera: &Camera, value: f32) -> Gaussians {
    let mut model = scenes::cloud(12, 0, camera, 30);
    model.log_scales.iter_mut().step_by(2).for_each(|scales| *scales = [value; 3]);
    model
}

pub(super) fn scales(trial: &mut Trial<'_>) -> Result<(), BackendError> {
    let camera = scenes::camera(40, 30, 17);
    // exp(−43.7)² is the smallest normal number; training clamps standard deviations at exp(2.3).
    for value in [-80.0, -43.7, -30.0, -20.0, 0.0, 2.3] {
        let label = format!("log-scale {value}");
        trial.check(&label, &cloud_of_scale(&camera, value), &camera, GREEN, 0)?;
    }
    // Squares and determinants exceed f32: no accuracy is required, but all numbers stay finite.
    for value in [12.0, 20.0, 44.0, 60.0, 88.0, 89.0, 120.0] {
        let label = format!("log-scale {value}");
        trial.check_finite(&label, &cloud_of_scale(&camera, value), &camera, GREEN, 0)?;
    }
    Ok(())
}

pub(super) fn quaternions(trial: &mut Trial<'_>) -> Result<(), BackendError> {
    let camera = scenes::camera(40, 30, 18);
    let scaled = |length: f32| {
        let mut model = scenes::cloud(12, 0, &camera, 31);
        for quat in &mut model.quats {
            let norm = quat.iter().map(|v| v * v).sum::<f32>().sqrt();
            *quat = quat.map(|v| v / norm * length);
        }
        model
    };
    // Beyond 1.8e19 the square of the length overflows. Below 1e-18 the squares of its components are subnormal,
    // which devices may flush to zero (WGSL, "Differences from IEEE-754"), as SwiftShader does.
    for length in [1e-15_f32, 1e-8, 1e-5, 1.0, 1e6, 1e18] {
        let label = format!("length {length:e}");
        let model = scaled(length);
        trial.check(&label, &model, &camera, GREEN, 0)?;
        // The rotation does not depend on the length, so the gradient along it is zero.
        let upstream = scenes::narrowed(&scenes::upstream(&camera, 5));
        let mut backend = trial.subject.backend(&model)?;
        let (_, gradient) = backend.differentiate(&camera, GREEN, 0, &upstream)?;
        let to_f64 = |q: &[f32; 4]| q.map(f64::from);
        let norm = |q: [f64; 4]| q.iter().map(|v| v * v).sum::<f64>().sqrt();
        let largest = gradient.quats.iter().map(|g| norm(to_f64(g))).fold(0.0, f64::max);
        let along = model.quats.iter().zip(&gradient.quats).map(|(q, g)| {
            let (q, g) = (to_f64(q), to_f64(g));
            q.iter().zip(g).map(|(q, g)| q * g).sum::<f64>().abs() / norm(q)
        });
        let radial = along.fold(0.0, f64::max) / largest;
        trial.record(&label, "gradient along the length", radial, 2e-6);
    }
    // A row with a zero quaternion is not rendered; the next step resets the quaternion to the identity.
    for length in [0.0, 1e-30] {
        let label = format!("length {length:e}");
        let mut model = scaled(1.0);
        model.quats[3] = [0.5 * length; 4];
        let mut backend = trial.subject.backend(&model)?;
        let image = backend.render(&camera, GREEN, 0)?;
        trial.count(&label, "NaN or infinity", count_non_finite(&[&image.rgb, &image.depth]));
        trial.train(&label, &mut *backend, &camera, GREEN, 0)?;
        // `train` pruned the first row, so row 3 is now row 2.
        let upright = backend.download()?.quats[2][0] > 0.99;
        trial.count(&label, "Gaussians whose zero quaternion was not reset", usize::from(!upright));
    }
    Ok(())
}

pub(super) fn needles(trial: &mut Trial<'_>) -> Result<(), BackendError> {
    let camera = axis_camera(48, 48);
    // In the gradient of the long axis, terms from the short axis of dL/dΣ must cancel; they are larger than the
    // result by the squared ratio of the widths. The usual formula, which contains the inverse of Σ, loses the
    // gradient entirely at 300 px.
    trial.limits.interior = 1e-3;
    for (sigma_px, tolerance) in [(10.0_f32, 1e-3), (100.0, 5e-3), (1000.0, 1e-1)] {
        trial.gradient_tolerance = tolerance;
        for turn in 0..16 {
            let label = format!("{sigma_px} px, turn {turn}");
            let model = needle(sigma_px, turn);
            let (measured, expected) = trial.check(&label, &model, &camera, GREEN, 0)?;
            let log_scales = measured.log_scales[0].map(f64::from);
            let found = covariance_gradient(&model, log_scales, measured.quats[0].map(f64::from));
            let exact = covariance_gradient(&model, expected.log_scales[0], expected.quats[0]);
            trial.record(&label, "covariance gradient", relative_error(&found, &exact), 1e-3);
        }
    }
    // The exponent may be off by 1e-2 here, and alpha with it.
    trial.limits.interior = 1e-2;
    for turn in 0..16 {
        let label = format!("10000 px, turn {turn}");
        trial.check_image(&label, &needle(1e4, turn), &camera, GREEN, 0)?;
    }
    Ok(())
}

/// dL/dΣ of a row with a unit quaternion, in the frame of its axes: xx, yy, zz, xy, xz. The element yz cannot be
/// recovered, as the other two axes are equally wide.
///
/// Log-scales change the diagonal D of Σ = R D Rᵀ by 2D. A rotation δ about an axis of the row changes q by half
/// of q ⊗ (0, δ), and the elements ij and ji of the other two axes by (Dᵢ − Dⱼ) δ.
fn covariance_gradient(model: &Gaussians, d_log_scales: [f64; 3], d_quat: [f64; 4]) -> [f64; 5] {
    let variance = model.log_scales[0].map(|log| (2.0 * f64::from(log)).exp());
    let [w, x, y, z] = model.quats[0].map(f64::from);
    let [gw, gx, gy, gz] = d_quat;
    // Half the imaginary part of conj(q) ⊗ g.
    let turn_y = 0.5 * (w * gy - y * gw - z * gx + x * gz);
    let turn_z = 0.5 * (w * gz - z * gw - x * gy + y * gx);
    let [a, b, c] = variance;
    let diagonal = [0, 1, 2].map(|i| d_log_scales[i] / (2.0 * variance[i]));
    let [xx, yy, zz] = diagonal;
    [xx, yy, zz, turn_z / (2.0 * (a - b)), turn_y / (2.0 * (c - a))]
}

/// A row of `sigma_px` by 0.01 px before the blur: at z = 1 a pixel is 1/64 wide.
fn needle(sigma_px: f32, turn: u8) -> Gaussians {
    let angle = std::f32::consts::PI * (f32::from(turn) + 0.3) / 16.0;
    let scale = [sigma_px / 64.0, 0.01 / 64.0, 0.01 / 64.0];
    let quat = [(0.5 * angle).cos(), 0.0, 0.0, (0.5 * angle).sin()];
    let mut model = Gaussians::default();
    scenes::push(&mut model, [0.01, -0.02, 1.0], scale, quat, 2.0, flat_colour);
    model
}

pub(super) fn outside_frustum(trial: &mut Trial<'_>) -> Result<(), BackendError> {
    let camera = scenes::camera(34, 28, 12);
    for times in [1.0, 1.1, 1.2, 1.5, 2.0, 5.0, 20.0] {
        let mut model = Gaussians { sh_degree: 1, ..Gaussians::default() };
        let corners = [[1.0, 0.1], [-0.2, 1.0], [-1.0, -1.0], [1.0, -0.7]];
        for (row, [x, y]) in corners.into_iter().enumerate() {
            let z = 2.0 + 0.4 * row as f64;
            let side = z * times * 0.5;
            let mean = scenes::world(&camera, [x * side, y * side, z]);
            // Long enough to reach into the image.
            let scale = [0.5 * side as f32, 0.2 * side as f32, 0.1];
            let colour = |k| if k < 3 { 0.5 - 0.2 * k as f32 } else { 0.05 };
            scenes::push(&mut model, mean, scale, [0.9, 0.1 * row as f32, -0.3, 0.2], 0.6, colour);
        }
        let label = format!("{times} times the half width");
        trial.check(&label, &model, &camera, [0.2, 0.7, 0.4], 1)?;
    }
    Ok(())
}
