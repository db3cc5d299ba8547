//! Losses of uniform, equal and nearly equal images, where the usual formula of SSIM suffers from cancellation.

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::compare::relative_error;
use crate::reference::loss::{Loss, loss};
use crate::scenes;
use crate::subject::Subject;
use crate::trial::{Trial, count_non_finite, step};
use crate::values::SIZES;
use densify_core::camera::Camera;
use densify_core::gaussians::Gaussians;
use densify_core::image::Image8;
use densify_policies::policy::{Needs, PixelLoss};
use densify_render::{BackendError, Differentiable, Setup};

/// Size of the images `[px]`, except those of [`SIZES`].
const SIZE: (u32, u32) = (48, 40);

/// Tolerances of the loss, L1 and SSIM, and of the gradient relative to its largest value. Flat images are the
/// least accurate, because C₂ is small compared with the rounding errors of their squares.
fn tolerances(subject: &Subject) -> (f64, f64) {
    match subject {
        Subject::Gpu(_) => (2e-6, 1e-4),
        _ => (1e-6, 5e-5),
    }
}

fn flat_image(value: u8) -> Image8 {
    let (width, height) = SIZE;
    let rgb = vec![value; 3 * (width * height) as usize];
    Image8 { width, height, rgb, alpha: None, mask: None }
}

/// The reference's loss, with the target composited over the background and the error weighted by the mask.
fn expected(
    rendered: &[f32],
    target: &Image8,
    background: [f32; 3],
    pixel_loss: PixelLoss,
) -> Loss {
    let weight = |plane: &Option<Vec<u8>>, p: usize| {
        plane.as_ref().map_or(1.0, |plane| f64::from(plane[p]) / 255.0)
    };
    let truth = |i: usize| {
        let alpha = weight(&target.alpha, i / 3);
        alpha * f64::from(target.rgb[i]) / 255.0 + (1.0 - alpha) * f64::from(background[i % 3])
    };
    let truth: Vec<f64> = (0..rendered.len()).map(truth).collect();
    let masked =
        |i: usize| truth[i] + weight(&target.mask, i / 3) * (f64::from(rendered[i]) - truth[i]);
    let masked: Vec<f64> = (0..rendered.len()).map(masked).collect();
    let size = (target.width as usize, target.height as usize);
    let mut loss = loss(&masked, &truth, size, pixel_loss);
    for (i, gradient) in loss.gradient.iter_mut().enumerate() {
        *gradient *= weight(&target.mask, i / 3);
    }
    loss
}

fn check(
    trial: &mut Trial<'_>,
    (backend, pixel_loss): (&mut dyn Differentiable, PixelLoss),
    label: &str,
    rendered: &[f32],
    target: &Image8,
) -> Result<(), BackendError> {
    let background = [0.1, 0.5, 0.9];
    let expected = expected(rendered, target, background, pixel_loss);
    let (found, gradient) = backend.loss(&scenes::opaque(rendered, target), target, background)?;
    let (value_tolerance, gradient_tolerance) = tolerances(trial.subject);
    for (quantity, found, expected) in [
        ("loss", found.loss, expected.loss),
        ("L1", found.l1, expected.l1),
        ("SSIM", found.ssim, expected.ssim),
    ] {
        trial.record(label, quantity, (f64::from(found) - expected).abs(), value_tolerance);
    }
    let error = relative_error(&gradient, &expected.gradient);
    trial.record(label, "pixel gradient", error, gradient_tolerance);
    trial.count(label, "SSIM beyond 1", usize::from(found.ssim.abs() > 1.0));
    Ok(())
}

pub(super) fn uniform_photographs(trial: &mut Trial<'_>) -> Result<(), BackendError> {
    let mut backend = trial.subject.backend(&Gaussians::default())?;
    let (noisy, photograph) = scenes::noisy(SIZE, 0.2, 23);
    let transparent = Image8 { alpha: Some(vec![0; photograph.rgb.len() / 3]), ..photograph };
    for (label, target) in [
        ("black", flat_image(0)),
        ("white", flat_image(255)),
        ("grey", flat_image(128)),
        ("transparent", transparent),
    ] {
        check(trial, (&mut *backend, PixelLoss::L1), label, &noisy, &target)?;
    }
    for value in [0, 1, 153, 255] {
        let (label, target) = (format!("equal to {value}"), flat_image(value));
        let rendered = vec![f32::from(value) * (1.0 / 255.0); target.rgb.len()];
        let (found, gradient) =
            backend.loss(&scenes::opaque(&rendered, &target), &target, [0.0; 3])?;
        let error = f64::from(found.loss.abs().max((1.0 - found.ssim).abs()));
        // A GPU's division by 255 is accurate to 2.5 units in the last place.
        let tolerance = if matches!(trial.subject, Subject::Gpu(_)) { 3e-7 } else { 0.0 };
        trial.record(&label, "loss of equal images", error, tolerance);
        if tolerance == 0.0 {
            let nonzero = gradient.iter().filter(|g| g.abs() > 1e-12).count();
            trial.count(&label, "gradients of equal images", nonzero);
        }
    }
    // An empty view that equals its photograph moves no row.
    let camera = scenes::camera(48, 40, 25);
    let model = scenes::cloud(10, 0, &camera, 26);
    let away = Camera { translation: glam::DVec3::new(0.0, 0.0, -1e3), ..camera };
    let mut backend = trial.subject.backend(&model)?;
    let output = step(&mut *backend, 1, &away, &flat_image(255), [1.0; 3], 0)?;
    let mut moved = usize::from(backend.download()?.means != model.means);
    moved += count_non_finite(&[&[output.loss, output.ssim]]) + output.visible;
    trial.count("an empty view", "Gaussians moved", moved);
    Ok(())
}

pub(super) fn flat_and_similar(trial: &mut Trial<'_>) -> Result<(), BackendError> {
    let mut backend = trial.subject.backend(&Gaussians::default())?;
    let needs = Needs { pixel_loss: PixelLoss::Huber, ..Needs::default() };
    let setup = Setup { needs, ..Setup::default() };
    let mut huber = trial.subject.backend_with(&Gaussians::default(), setup)?;
    // The reference's loss is too slow for the longest image.
    for (seed, size) in SIZES.into_iter().filter(|size| size.1 < 1000).enumerate() {
        for noise in [0.05, 1.0] {
            let (rendered, target) = scenes::noisy(size, noise, seed as u64);
            let label = format!("{}x{}, noise {noise}", size.0, size.1);
            check(trial, (&mut *backend, PixelLoss::L1), &label, &rendered, &target)?;
            let label = format!("{label}, Huber");
            check(trial, (&mut *huber, PixelLoss::Huber), &label, &rendered, &target)?;
        }
    }
    let (rendered, target) = scenes::noisy(SIZE, 0.3, 77);
    let (width, pixels) = (target.width as usize, target.rgb.len() / 3);
    let ramp: Vec<u8> = (0..pixels).map(|p| (p % 256) as u8).collect();
    let half: Vec<u8> = (0..pixels).map(|p| if p % width < width / 2 { 255 } else { 0 }).collect();
    for (label, alpha, mask) in [
        ("coverage", Some(&ramp), None),
        ("mask", None, Some(&half)),
        ("soft mask", None, Some(&ramp)),
        ("coverage and mask", Some(&ramp), Some(&half)),
    ] {
        let target = Image8 { alpha: alpha.cloned(), mask: mask.cloned(), ..target.clone() };
        check(trial, (&mut *backend, PixelLoss::L1), label, &rendered, &target)?;
    }
    let n = target.rgb.len();
    let mut rng = ChaCha8Rng::seed_from_u64(24);
    let noisy: Vec<f32> = (0..n).map(|_| 0.9 + 1e-3 * rng.random_range(-1.0_f32..1.0)).collect();
    for (label, rendered, value) in [
        ("0.6 + 1e-3", vec![0.601; n], 153),
        ("0.9 with noise 1e-3", noisy, 230),
        ("black on white", vec![0.0; n], 255),
        ("beyond 1", vec![1.2; n], 255),
    ] {
        check(trial, (&mut *backend, PixelLoss::L1), label, &rendered, &flat_image(value))?;
    }
    // Almost equal: SSIM stays at 1.
    let target = flat_image(153);
    let almost = scenes::opaque(&vec![0.600_000_1; n], &target);
    let (found, _) = backend.loss(&almost, &target, [0.0; 3])?;
    trial.record("0.6 + 1e-7", "SSIM below 1", f64::from(1.0 - found.ssim), 1e-6);
    trial.count("0.6 + 1e-7", "SSIM beyond 1", usize::from(found.ssim > 1.0));
    Ok(())
}
