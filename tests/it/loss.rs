//! The backend's training loss and its gradient against the reference's.

use densify::dataset::images::Image8;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::compare::{Table, relative_error};
use crate::reference::loss::{Loss, loss};
use crate::subject;

/// Of loss, L1 and mean SSIM.
const VALUE: f64 = 1e-6;
/// Of the gradient, against its largest value. Flat images lose most, as C₂ is small beside the
/// rounding of their squares.
const GRADIENT: f64 = 5e-5;

fn random(width: u32, height: u32, noise: f32, seed: u64) -> (Vec<f32>, Image8) {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let n = 3 * (width * height) as usize;
    let rgb: Vec<u8> = (0..n).map(|_| rng.random()).collect();
    let rendered = rgb
        .iter()
        .map(|&v| f32::from(v) / 255.0 + noise * rng.random_range(-1.0_f32..1.0))
        .collect();
    (rendered, Image8 { width, height, rgb, alpha: None, mask: None })
}

/// The reference's loss of what the backend sees: target on background, error under the mask.
fn expected(rendered: &[f32], target: &Image8, background: [f32; 3]) -> Loss {
    let share = |plane: &Option<Vec<u8>>, p: usize| {
        plane.as_ref().map_or(1.0, |plane| f64::from(plane[p]) / 255.0)
    };
    let truth: Vec<f64> = (0..rendered.len())
        .map(|i| {
            let alpha = share(&target.alpha, i / 3);
            alpha * f64::from(target.rgb[i]) / 255.0 + (1.0 - alpha) * f64::from(background[i % 3])
        })
        .collect();
    let masked: Vec<f64> = (0..rendered.len())
        .map(|i| truth[i] + share(&target.mask, i / 3) * (f64::from(rendered[i]) - truth[i]))
        .collect();
    let mut loss = loss(&masked, &truth, target.width as usize, target.height as usize);
    for (i, gradient) in loss.gradient.iter_mut().enumerate() {
        *gradient *= share(&target.mask, i / 3);
    }
    loss
}

fn check(table: &mut Table, what: &str, rendered: &[f32], target: &Image8, background: [f32; 3]) {
    let expected = expected(rendered, target, background);
    let (scalars, gradient) = subject::loss(rendered, target, background);
    table.check(what, "loss", (f64::from(scalars.loss) - expected.loss).abs(), VALUE);
    table.check(what, "l1", (f64::from(scalars.l1) - expected.l1).abs(), VALUE);
    table.check(what, "ssim", (f64::from(scalars.ssim) - expected.ssim).abs(), VALUE);
    table.check(what, "gradient", relative_error(&gradient, &expected.gradient), GRADIENT);
}

#[test]
fn every_size() {
    let mut table = Table::new("loss");
    let sizes = [
        (1, 1),
        (1, 17),
        (17, 1),
        (5, 4),
        (11, 11),
        (15, 15),
        (16, 16),
        (33, 47),
        (70, 34),
        (257, 17),
    ];
    for (seed, (width, height)) in sizes.into_iter().enumerate() {
        for noise in [0.05, 1.0] {
            let (rendered, target) = random(width, height, noise, seed as u64);
            let what = format!("{width}x{height}, noise {noise}");
            check(&mut table, &what, &rendered, &target, [0.0; 3]);
        }
    }
    table.finish();
}

#[test]
fn targets_with_coverage_and_masks() {
    let mut table = Table::new("loss with coverage and masks");
    let (rendered, target) = random(37, 29, 0.3, 77);
    let pixels = 37 * 29;
    let ramp: Vec<u8> = (0..pixels).map(|p| (p % 256) as u8).collect();
    let half: Vec<u8> = (0..pixels).map(|p| if p % 37 < 20 { 255 } else { 0 }).collect();
    let background = [0.1, 0.5, 0.9];
    let mut check = |what: &str, alpha: Option<&Vec<u8>>, mask: Option<&Vec<u8>>| {
        let target = Image8 { alpha: alpha.cloned(), mask: mask.cloned(), ..target.clone() };
        check(&mut table, what, &rendered, &target, background);
    };
    check("coverage", Some(&ramp), None);
    check("mask", None, Some(&half));
    check("soft mask", None, Some(&ramp));
    check("both", Some(&ramp), Some(&half));
    table.finish();
}

#[test]
fn a_masked_pixel_gets_no_gradient() {
    let (rendered, mut target) = random(30, 20, 0.3, 78);
    let mask: Vec<u8> = (0..600).map(|p| if p % 3 == 0 { 0 } else { 255 }).collect();
    target.mask = Some(mask.clone());
    let (_, gradient) = subject::loss(&rendered, &target, [0.0; 3]);
    for (p, _) in mask.iter().enumerate().filter(|&(_, &m)| m == 0) {
        assert!(gradient[3 * p..3 * p + 3].iter().all(|g| g.abs() < 1e-12), "pixel {p}");
    }
}

#[test]
fn equal_images_have_no_loss() {
    for value in [0, 153, 255] {
        let n = 3 * 40 * 33;
        let target = Image8 { width: 40, height: 33, rgb: vec![value; n], alpha: None, mask: None };
        let rendered = vec![f32::from(value) * (1.0 / 255.0); n];
        let (scalars, gradient) = subject::loss(&rendered, &target, [0.0; 3]);
        assert_eq!((scalars.loss.to_bits(), scalars.ssim.to_bits()), (0, 1.0_f32.to_bits()));
        assert!(gradient.iter().all(|g| g.abs() < 1e-12), "{value}");
    }
}

#[test]
fn flat_and_nearly_flat_images() {
    let mut table = Table::new("loss of flat images");
    let mut rng = ChaCha8Rng::seed_from_u64(24);
    let flat = |value: u8| Image8 {
        width: 48,
        height: 40,
        rgb: vec![value; 3 * 48 * 40],
        alpha: None,
        mask: None,
    };
    let n = 3 * 48 * 40;
    check(&mut table, "0.6 + 1e-3", &vec![0.601; n], &flat(153), [0.0; 3]);
    let noisy: Vec<f32> = (0..n).map(|_| 0.9 + 1e-3 * rng.random_range(-1.0_f32..1.0)).collect();
    check(&mut table, "0.9 with noise 1e-3", &noisy, &flat(230), [0.0; 3]);
    check(&mut table, "black on white", &vec![0.0; n], &flat(255), [0.0; 3]);
    check(&mut table, "beyond 1", &vec![1.2; n], &flat(255), [0.0; 3]);
    table.finish();

    // A hair apart: the sign of the difference is the whole gradient, and SSIM stays at 1.
    let (scalars, _) = subject::loss(&vec![0.600_000_1; n], &flat(153), [0.0; 3]);
    assert!(scalars.ssim <= 1.0 && scalars.ssim > 1.0 - 1e-6, "{}", scalars.ssim);
}

#[test]
fn the_loss_and_the_metric_have_one_ssim() {
    let (rendered, target) = random(53, 41, 0.2, 79);
    let rendered: Vec<f32> = rendered.iter().map(|v| v.clamp(0.0, 1.0)).collect();
    let (scalars, _) = subject::loss(&rendered, &target, [0.0; 3]);
    let metric = densify::metrics::ssim(&rendered, &target, [0.0; 3]).unwrap();
    assert!((f64::from(scalars.ssim) - metric).abs() < VALUE, "{} and {metric}", scalars.ssim);
}
