//! Opacities at the thresholds of the renderer, thousands of faint layers, and opaque rows in front of them.

use super::{GREEN, UPRIGHT, axis_camera, shade};
use crate::compare::class;
use crate::reference::{CLASSES, Model, Rules, View, render};
use crate::scenes;
use crate::trial::{Trial, count_non_finite};
use densify_core::gaussians::Gaussians;
use densify_render::BackendError;

/// The logit of an opacity, computed in f64 for opacities close to 1.
fn logit(opacity: f64) -> f32 {
    (opacity.ln() - (-opacity).ln_1p()) as f32
}

/// Alphas around the minimum, around the clamp, and at both extremes.
pub(super) fn opacities(trial: &mut Trial<'_>) -> Result<(), BackendError> {
    let camera = axis_camera(33, 27);
    let minimum = 1.0 / 255.0;
    let alphas = [
        1e-30,
        minimum - 5e-10,
        minimum,
        minimum + 5e-10,
        0.5,
        0.99 - 6e-8,
        0.99,
        0.99 + 6e-8,
        0.9999,
    ];
    // One alpha per model, so that a threshold decided differently flips only one pixel.
    for alpha in alphas {
        let mut model = Gaussians::default();
        // The mean lies on a pixel's centre, where alpha equals the opacity.
        let shade = |k: usize| 0.6 - 0.3 * k as f32;
        scenes::push(&mut model, [0.0, 0.0, 2.0], [0.2; 3], UPRIGHT, logit(alpha), shade);
        scenes::push(&mut model, [0.1, 0.0, 3.0], [0.4; 3], UPRIGHT, 0.5, |k| 0.4 * k as f32);
        trial.check(&format!("alpha {alpha:.9}"), &model, &camera, GREEN, 0)?;
    }
    let mut model = scenes::cloud(12, 0, &camera, 8);
    model.opacity_logits.iter_mut().step_by(2).for_each(|logit| *logit = f32::MAX);
    trial.check("alpha 1", &model, &camera, GREEN, 0)?;
    Ok(())
}

pub(super) fn layers(trial: &mut Trial<'_>) -> Result<(), BackendError> {
    let camera = axis_camera(5, 4);
    // σ(−5.53) is a little above 1/255.
    let all = [(600_usize, -3.0_f32), (20_000, -5.0), (2_400, -5.53), (100_000, -5.53)];
    for (rows, logit) in all {
        let mut model = Gaussians::default();
        for row in 0..rows {
            let z = 1.0 + row as f32 / rows as f32;
            scenes::push(&mut model, [0.0, 0.0, z], [0.3 * z; 3], UPRIGHT, logit, shade(row));
        }
        let label = format!("{rows} layers");
        trial.check(&label, &model, &camera, GREEN, 0)?;
        // Black rows on white: the image is the transmittance, with full precision.
        model.sh.fill(-2.0);
        let view = View { camera: &camera, background: [1.0; 3], sh_degree: 0 };
        let exact = render(&Model::from(&model), view, &Rules::STANDARD);
        let mut backend = trial.subject.backend(&model)?;
        let upstream = scenes::narrowed(&scenes::upstream(&camera, 4));
        let (found, gradient) = backend.differentiate(&camera, [1.0; 3], 0, &upstream)?;
        let remaining =
            exact.transmittance.iter().zip(found.rgb.chunks_exact(3)).zip(&exact.boundary);
        let errors = remaining.filter(|(_, close)| !**close).map(|((exact, rgb), _)| {
            rgb.iter().map(|v| (f64::from(*v) / exact - 1.0).abs()).fold(0.0, f64::max)
        });
        trial.record(&label, "transmittance, relative", errors.fold(0.0, f64::max), 2e-4);
        // (254/255)^n falls to 1e-4 at n = 2,345, where blending stops in every pixel.
        let blended: u32 = gradient.pixel_count.iter().sum();
        let pixels = camera.width * camera.height;
        trial.record(&label, "Gaussians in a pixel", f64::from(blended / pixels), 2345.0);
    }
    side_by_side(trial)
}

/// Many rows in one tile; at most a twentieth of them cover any one pixel, so that the tile's list is read to its end.
fn side_by_side(trial: &mut Trial<'_>) -> Result<(), BackendError> {
    let camera = axis_camera(16, 16);
    let mut model = Gaussians::default();
    for row in 0..100_000 {
        let z = 1.0 + row as f32 / 100_000.0;
        let (x, y) = ((row % 16) as f64 - 7.3, (row / 16 % 16) as f64 - 7.8);
        let place = [x / camera.fx, y / camera.fy].map(|at| at as f32 * z);
        let scale = 0.4 * z / camera.fx as f32;
        scenes::push(&mut model, [place[0], place[1], z], [scale; 3], UPRIGHT, -5.0, shade(row));
    }
    trial.check("100000 Gaussians side by side", &model, &camera, GREEN, 0)?;
    Ok(())
}

pub(super) fn behind_opaque(trial: &mut Trial<'_>) -> Result<(), BackendError> {
    let camera = axis_camera(21, 17);
    // The last two opacities are clamped to an alpha of 0.99 at the centre of the opaque row.
    for opacity in [0.98, 0.9895, 0.9995, 0.9999] {
        let mut model = Gaussians::default();
        for row in 0..41_u8 {
            let z = 1.0 + 0.02 * f32::from(row);
            let logit = if row == 0 { logit(opacity) } else { -3.0 };
            let place = [0.02 * z, -0.01 * z, z];
            scenes::push(&mut model, place, [0.4 * z; 3], UPRIGHT, logit, shade(row.into()));
        }
        trial.check(&format!("opacity {opacity} in front of 40"), &model, &camera, GREEN, 0)?;
    }
    Ok(())
}

pub(super) fn logits(trial: &mut Trial<'_>) -> Result<(), BackendError> {
    let values = [-104.0, -89.0, -88.0, -50.0, -9.2, -5.6, -5.5, 0.0, 4.4, 4.7, 9.2, 16.6, 17.0];
    let values = values.into_iter().chain([40.0, 90.0]);
    for (seed, logit) in values.enumerate() {
        let label = format!("logit {logit}");
        let camera = scenes::camera(40, 30, 17);
        let mut model = scenes::cloud(12, 0, &camera, 30 + seed as u64);
        model.opacity_logits.iter_mut().step_by(2).for_each(|opacity| *opacity = logit);
        trial.check(&label, &model, &camera, GREEN, 0)?;

        // A single row on a pixel's centre: alpha is the opacity, and the gradient its derivative.
        let camera = axis_camera(17, 17);
        let mut model = Gaussians::default();
        scenes::push(&mut model, [0.0, 0.0, 1.0], [0.05; 3], UPRIGHT, logit, |_| 0.0);
        let mut backend = trial.subject.backend(&model)?;
        let mut upstream = scenes::narrowed(&scenes::upstream(&camera, 1));
        upstream.rgb.fill(0.0);
        upstream.depth.fill(0.0);
        upstream.alpha.fill(0.0);
        let middle = 8 * 17 + 8;
        upstream.alpha[middle] = 1.0;
        let (image, gradient) = backend.differentiate(&camera, GREEN, 0, &upstream)?;
        let opacity = 1.0 / (1.0 + (-f64::from(logit)).exp());
        let (alpha, slope) = match opacity {
            faint if faint < 1.0 / 255.0 => (0.0, 0.0),
            opaque if opaque > 0.99 => (0.99, 0.0),
            between => (between, between * (1.0 - between)),
        };
        let error = |found: f32, exact: f64| (f64::from(found) - exact).abs() / exact.max(1e-3);
        // alpha is 1 − T, and T has an error of 2⁻²⁴ at 1.
        let tolerance = if trial.gradient_tolerance > 1e-4 { 1e-4 } else { 2e-5 };
        trial.record(&label, "opacity, relative", error(image.alpha[middle], alpha), tolerance);
        let found = gradient.opacity_logits[0];
        trial.record(&label, "derivative of the opacity, relative", error(found, slope), tolerance);
        trial.train(&label, &mut *backend, &camera, GREEN, 0)?;
        let beyond = backend.download()?.opacity_logits.iter().filter(|x| x.abs() > 9.2).count();
        trial.count(&label, "logits beyond 9.2 after a step", beyond);
        let broken = CLASSES.iter().map(|name| count_non_finite(&[class(&gradient, name)])).sum();
        trial.count(&label, "NaN or infinity", broken);
    }
    Ok(())
}
