//! Opacities at the steps of the renderer, faint layers by the thousand, and opaque ones before them.

use super::{GREY, UPRIGHT, straight};
use crate::compare::class;
use crate::reference::{CLASSES, Model, Rules, View, render};
use crate::scenes;
use crate::trial::{Trial, count_broken};
use densify_core::gaussians::Gaussians;
use densify_render::BackendError;

/// The logit of an opacity, in f64, so that opacities next to 1 have one.
fn logit(opacity: f64) -> f32 {
    (opacity.ln() - (-opacity).ln_1p()) as f32
}

/// Colours, alphas and gradients around the least alpha, around its clamp, and at both ends.
pub(super) fn opacities(trial: &mut Trial<'_>) -> Result<(), BackendError> {
    let camera = straight(33, 27);
    let least = 1.0 / 255.0;
    let alphas =
        [1e-30, least - 5e-10, least, least + 5e-10, 0.5, 0.99 - 6e-8, 0.99, 0.99 + 6e-8, 0.9999];
    // One at a time, so that a row on the other side of the step is a flip and no more.
    for alpha in alphas {
        let mut model = Gaussians::default();
        // The mean lies on a pixel's centre, so that alpha is the opacity there.
        let shade = |k: usize| 0.6 - 0.3 * k as f32;
        scenes::push(&mut model, [0.0, 0.0, 2.0], [0.2; 3], UPRIGHT, logit(alpha), shade);
        scenes::push(&mut model, [0.1, 0.0, 3.0], [0.4; 3], UPRIGHT, 0.5, |k| 0.4 * k as f32);
        trial.check(&format!("alpha {alpha:.9}"), &model, &camera, GREY, 0)?;
    }
    let mut model = scenes::cloud(12, 0, &camera, 8);
    model.opacity_logits.iter_mut().step_by(2).for_each(|logit| *logit = f32::MAX);
    trial.check("alpha 1", &model, &camera, GREY, 0)?;
    Ok(())
}

pub(super) fn layers(trial: &mut Trial<'_>) -> Result<(), BackendError> {
    let camera = straight(5, 4);
    // σ(−5.53) is a little above 1/255.
    let all = [(600_usize, -3.0_f32), (20_000, -5.0), (2_400, -5.53), (100_000, -5.53)];
    for (rows, logit) in all {
        let mut model = Gaussians::default();
        for row in 0..rows {
            let z = 1.0 + row as f32 / rows as f32;
            let shade = |k: usize| ((row * 7 + k * 5) % 11) as f32 * 0.1 - 0.5;
            scenes::push(&mut model, [0.0, 0.0, z], [0.3 * z; 3], UPRIGHT, logit, shade);
        }
        let what = format!("{rows} layers");
        trial.check(&what, &model, &camera, GREY, 0)?;
        // Black rows on white: what is left of white is the transmittance, with all of its digits.
        model.sh.fill(-2.0);
        let view = View { camera: &camera, background: [1.0; 3], sh_degree: 0 };
        let exact = render(&Model::of(&model), view, &Rules::STANDARD);
        let mut backend = trial.subject.backend(&model)?;
        let upstream = scenes::narrowed(&scenes::upstream(&camera, 4));
        let (found, gradient) = backend.differentiate(&camera, [1.0; 3], 0, &upstream)?;
        let left = exact.transmittance.iter().zip(found.rgb.chunks_exact(3)).zip(&exact.boundary);
        let off = left.filter(|(_, close)| !**close).map(|((exact, rgb), _)| {
            rgb.iter().map(|v| (f64::from(*v) / exact - 1.0).abs()).fold(0.0, f64::max)
        });
        trial.figure(&what, "transmittance, relative", off.fold(0.0, f64::max), 2e-4);
        // (254/255)^n falls to 1e-4 at n = 2,345, and no pixel goes on beyond.
        let blended: u32 = gradient.pixel_count.iter().sum();
        let pixels = camera.width * camera.height;
        trial.figure(&what, "rows in a pixel", f64::from(blended / pixels), 2345.0);
    }
    scattered(trial)
}

/// Rows of one tile that no pixel has more than a twentieth of, so that the list is read to its end.
fn scattered(trial: &mut Trial<'_>) -> Result<(), BackendError> {
    let camera = straight(16, 16);
    let mut model = Gaussians::default();
    for row in 0..100_000 {
        let z = 1.0 + row as f32 / 100_000.0;
        let (x, y) = ((row % 16) as f64 - 7.3, (row / 16 % 16) as f64 - 7.8);
        let place = [x / camera.fx, y / camera.fy].map(|at| at as f32 * z);
        let shade = |k: usize| ((row * 7 + k * 5) % 11) as f32 * 0.1 - 0.5;
        let scale = 0.4 * z / camera.fx as f32;
        scenes::push(&mut model, [place[0], place[1], z], [scale; 3], UPRIGHT, -5.0, shade);
    }
    trial.check("100000 rows beside each other", &model, &camera, GREY, 0)?;
    Ok(())
}

pub(super) fn behind(trial: &mut Trial<'_>) -> Result<(), BackendError> {
    let camera = straight(21, 17);
    // The last two are clamped to 0.99 where they are thickest.
    for opacity in [0.98, 0.9895, 0.9995, 0.9999] {
        let mut model = Gaussians::default();
        for row in 0..41_u8 {
            let z = 1.0 + 0.02 * f32::from(row);
            let shade = |k: usize| ((usize::from(row) * 7 + k * 5) % 11) as f32 * 0.1 - 0.5;
            let logit = if row == 0 { logit(opacity) } else { -3.0 };
            let place = [0.02 * z, -0.01 * z, z];
            scenes::push(&mut model, place, [0.4 * z; 3], UPRIGHT, logit, shade);
        }
        trial.check(&format!("opacity {opacity} before 40"), &model, &camera, GREY, 0)?;
    }
    Ok(())
}

pub(super) fn logits(trial: &mut Trial<'_>) -> Result<(), BackendError> {
    let values = [-104.0, -89.0, -88.0, -50.0, -9.2, -5.6, -5.5, 0.0, 4.4, 4.7, 9.2, 16.6, 17.0];
    let values = values.into_iter().chain([40.0, 90.0]);
    for (seed, logit) in values.enumerate() {
        let what = format!("logit {logit}");
        let camera = scenes::camera(40, 30, 17);
        let mut model = scenes::cloud(12, 0, &camera, 30 + seed as u64);
        for opacity in model.opacity_logits.iter_mut().step_by(2) {
            *opacity = logit;
        }
        trial.check(&what, &model, &camera, GREY, 0)?;

        // Alone on a pixel's centre: alpha is the opacity, and the gradient its derivative.
        let camera = straight(17, 17);
        let mut model = Gaussians::default();
        scenes::push(&mut model, [0.0, 0.0, 1.0], [0.05; 3], UPRIGHT, logit, |_| 0.0);
        let mut backend = trial.subject.backend(&model)?;
        let mut upstream = scenes::narrowed(&scenes::upstream(&camera, 1));
        upstream.rgb.fill(0.0);
        upstream.depth.fill(0.0);
        upstream.alpha.fill(0.0);
        let middle = 8 * 17 + 8;
        upstream.alpha[middle] = 1.0;
        let (image, gradient) = backend.differentiate(&camera, GREY, 0, &upstream)?;
        let opacity = 1.0 / (1.0 + (-f64::from(logit)).exp());
        let (alpha, slope) = match opacity {
            faint if faint < 1.0 / 255.0 => (0.0, 0.0),
            opaque if opaque > 0.99 => (0.99, 0.0),
            between => (between, between * (1.0 - between)),
        };
        let off = |found: f32, exact: f64| (f64::from(found) - exact).abs() / exact.max(1e-3);
        // alpha is 1 − T, and T has an error of 2⁻²⁴ at 1.
        let tolerance = if trial.gradient > 1e-4 { 1e-4 } else { 2e-5 };
        trial.figure(&what, "opacity, relative", off(image.alpha[middle], alpha), tolerance);
        let found = gradient.opacity_logits[0];
        trial.figure(&what, "its derivative, relative", off(found, slope), tolerance);
        trial.train(&what, &mut *backend, &camera, GREY, 0)?;
        let beyond = backend.download()?.opacity_logits.iter().filter(|x| x.abs() > 9.2).count();
        trial.never(&what, "logits beyond 9.2 after a step", beyond);
        let broken = CLASSES.iter().map(|name| count_broken(&[class(&gradient, name)])).sum();
        trial.never(&what, "NaN or infinity", broken);
    }
    Ok(())
}
