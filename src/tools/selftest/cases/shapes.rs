//! Rows of every shape and size, in general position and far beside the image.

use super::{GREY, flat_colour, straight};
use crate::compare::{class, relative_error};
use crate::reference::CLASSES;
use crate::scenes;
use crate::trial::{Trial, count_broken};
use densify_core::camera::Camera;
use densify_core::gaussians::Gaussians;
use densify_render::BackendError;

pub(super) fn ordinary(trial: &mut Trial<'_>) -> Result<(), BackendError> {
    for degree in 0..=3 {
        let camera = scenes::camera(49, 35, 10 + u64::from(degree));
        let model = scenes::cloud(40, degree, &camera, 20 + u64::from(degree));
        for active in 0..=degree {
            let what = format!("degree {active} of {degree}");
            trial.check(&what, &model, &camera, [0.2, 0.7, 0.4], active)?;
        }
    }
    Ok(())
}

/// A cloud of which every second row has all log-scales `value`.
fn of_scale(camera: &Camera, value: f32) -> Gaussians {
    let mut model = scenes::cloud(12, 0, camera, 30);
    for scales in model.log_scales.iter_mut().step_by(2) {
        *scales = [value; 3];
    }
    model
}

pub(super) fn scales(trial: &mut Trial<'_>) -> Result<(), BackendError> {
    let camera = scenes::camera(40, 30, 17);
    // exp(−43.7)² is the smallest normal number; from exp(2.3) on, training stops growth.
    for value in [-80.0, -43.7, -30.0, -20.0, 0.0, 2.3] {
        let what = format!("log-scale {value}");
        trial.check(&what, &of_scale(&camera, value), &camera, GREY, 0)?;
    }
    // Squares and determinants leave f32: no standard, but nothing breaks, and no other row.
    for value in [12.0, 20.0, 44.0, 60.0, 88.0, 89.0, 120.0] {
        let model = of_scale(&camera, value);
        let mut backend = trial.subject.backend(&model)?;
        let upstream = scenes::narrowed(&scenes::upstream(&camera, 5));
        let (image, gradient) = backend.differentiate(&camera, GREY, 0, &upstream)?;
        let mut broken = count_broken(&[&image.rgb, &image.alpha, &image.depth]);
        broken += CLASSES.iter().map(|name| count_broken(&[class(&gradient, name)])).sum::<usize>();
        let what = format!("log-scale {value}");
        trial.never(&what, "NaN or infinity", broken);
        trial.train(&what, &mut *backend, &camera, GREY, 0)?;
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
    // Beyond 1.8e19 the square of the length is none; below 1e-18 those of the components are subnormal,
    // which devices may take for zero (WGSL, "Differences from IEEE-754"), and SwiftShader does.
    for length in [1e-15_f32, 1e-8, 1e-5, 1.0, 1e6, 1e18] {
        let what = format!("length {length:e}");
        let model = scaled(length);
        trial.check(&what, &model, &camera, GREY, 0)?;
        // Turning does not depend on the length, so that nothing pulls along it.
        let upstream = scenes::narrowed(&scenes::upstream(&camera, 5));
        let mut backend = trial.subject.backend(&model)?;
        let (_, gradient) = backend.differentiate(&camera, GREY, 0, &upstream)?;
        let wide = |q: &[f32; 4]| q.map(f64::from);
        let size = |q: [f64; 4]| q.iter().map(|v| v * v).sum::<f64>().sqrt();
        let largest = gradient.quats.iter().map(|g| size(wide(g))).fold(0.0, f64::max);
        let along = model.quats.iter().zip(&gradient.quats).map(|(q, g)| {
            let (q, g) = (wide(q), wide(g));
            q.iter().zip(g).map(|(q, g)| q * g).sum::<f64>().abs() / size(q)
        });
        let radial = along.fold(0.0, f64::max) / largest;
        trial.figure(&what, "gradient along the length", radial, 2e-6);
    }
    // Without a direction: not drawn, and without rotation after a step.
    for length in [0.0, 1e-30] {
        let what = format!("length {length:e}");
        let mut model = scaled(1.0);
        model.quats[3] = [0.5 * length; 4];
        let mut backend = trial.subject.backend(&model)?;
        let image = backend.render(&camera, GREY, 0)?;
        trial.never(&what, "NaN or infinity", count_broken(&[&image.rgb, &image.depth]));
        trial.train(&what, &mut *backend, &camera, GREY, 0)?;
        // It is drawn from then on, and turns as others do: by a learning rate a step.
        // The first row was pruned: it is the third now.
        let upright = backend.download()?.quats[2][0] > 0.99;
        trial.never(&what, "rows that stay without a rotation", usize::from(!upright));
    }
    Ok(())
}

pub(super) fn needles(trial: &mut Trial<'_>) -> Result<(), BackendError> {
    let camera = straight(48, 48);
    // The gradient of the long axis is what remains when the short axis's share of dL/dΣ, larger by
    // the squared ratio of the widths, cancels; the usual route over the inverse of Σ leaves nothing
    // of it at 300 px already.
    trial.limits.interior = 1e-3;
    for (sigma_px, tolerance) in [(10.0_f32, 1e-3), (100.0, 5e-3), (1000.0, 1e-1)] {
        trial.gradient = tolerance;
        for turn in 0..16 {
            let what = format!("{sigma_px} px, turn {turn}");
            let model = needle(sigma_px, turn);
            let (measured, expected) = trial.check(&what, &model, &camera, GREY, 0)?;
            let found = by_covariance(
                &model,
                measured.log_scales[0].map(f64::from),
                measured.quats[0].map(f64::from),
            );
            let exact = by_covariance(&model, expected.log_scales[0], expected.quats[0]);
            trial.figure(&what, "by covariance", relative_error(&found, &exact), 1e-3);
        }
    }
    // The exponent may be off by 1e-2 here, and alpha with it.
    trial.limits.interior = 1e-2;
    for turn in 0..16 {
        let what = format!("10000 px, turn {turn}");
        trial.check_image(&what, &needle(1e4, turn), &camera, GREY, 0)?;
    }
    Ok(())
}

/// dL/dΣ of a row of unit quaternion, in the frame of its axes: xx, yy, zz, xy, xz. What turning about
/// the long axis would tell, yz, is lost where the others are equally wide.
///
/// Log-scales move the diagonal D of Σ = R D Rᵀ by 2D; a turn δ about an axis of the row, which moves q
/// by half of q ⊗ (0, δ), moves the element ij beside it by (Dᵢ − Dⱼ) δ, and its mirror image, too.
fn by_covariance(model: &Gaussians, log_scales: [f64; 3], quats: [f64; 4]) -> [f64; 5] {
    let variance = model.log_scales[0].map(|log| (2.0 * f64::from(log)).exp());
    let [w, x, y, z] = model.quats[0].map(f64::from);
    let [gw, gx, gy, gz] = quats;
    // The imaginary part of conj(q) ⊗ g, halved.
    let turn_y = 0.5 * (w * gy - y * gw - z * gx + x * gz);
    let turn_z = 0.5 * (w * gz - z * gw - x * gy + y * gx);
    let [a, b, c] = variance;
    let diagonal = [0, 1, 2].map(|i| log_scales[i] / (2.0 * variance[i]));
    let [xx, yy, zz] = diagonal;
    [xx, yy, zz, turn_z / (2.0 * (a - b)), turn_y / (2.0 * (c - a))]
}

/// A row of 0.01 px by `sigma_px` before the blur: at z = 1 a pixel is 1/64 wide.
fn needle(sigma_px: f32, turn: u8) -> Gaussians {
    let angle = std::f32::consts::PI * (f32::from(turn) + 0.3) / 16.0;
    let scale = [sigma_px / 64.0, 0.01 / 64.0, 0.01 / 64.0];
    let quat = [(0.5 * angle).cos(), 0.0, 0.0, (0.5 * angle).sin()];
    let mut model = Gaussians::default();
    scenes::push(&mut model, [0.01, -0.02, 1.0], scale, quat, 2.0, flat_colour);
    model
}

pub(super) fn beside(trial: &mut Trial<'_>) -> Result<(), BackendError> {
    let camera = scenes::camera(34, 28, 12);
    for times in [1.0, 1.1, 1.2, 1.5, 2.0, 5.0, 20.0] {
        let mut model = Gaussians { sh_degree: 1, ..Gaussians::default() };
        for (row, [x, y]) in [[1.0, 0.1], [-0.2, 1.0], [-1.0, -1.0], [1.0, -0.7]].iter().enumerate()
        {
            let z = 2.0 + 0.4 * row as f64;
            let side = z * times * 0.5;
            let mean = scenes::world(&camera, [x * side, y * side, z]);
            // Long enough to reach into the image.
            let scale = [0.5 * side as f32, 0.2 * side as f32, 0.1];
            let colour = |k| if k < 3 { 0.5 - 0.2 * k as f32 } else { 0.05 };
            scenes::push(&mut model, mean, scale, [0.9, 0.1 * row as f32, -0.3, 0.2], 0.6, colour);
        }
        let what = format!("{times} times the half width");
        trial.check(&what, &model, &camera, [0.2, 0.7, 0.4], 1)?;
    }
    Ok(())
}
