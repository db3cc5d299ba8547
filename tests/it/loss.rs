//! What the loss of a backend has in common with the metric, and what a mask does to it. Cases 23
//! and 24 of the [selftest](densify::verify) hold it against the reference's.

use densify::backend::StepOutput;
use densify::dataset::images::Image8;
use densify::gaussians::Gaussians;
use densify::verify::scenes::{noisy, opaque};

use crate::subject::{make, repeatable};

/// The loss of an image on black, and its gradient, on every backend.
fn losses(rendered: &[f32], target: &Image8) -> Vec<(String, StepOutput, Vec<f32>)> {
    let loss = |subject: densify::verify::Subject| {
        let mut backend = make(&subject, &Gaussians::default());
        let outcome = backend.loss(&opaque(rendered, target), target, [0.0; 3]);
        let (scalars, gradient) = outcome.expect("a loss");
        (subject.name(), scalars, gradient)
    };
    repeatable().into_iter().map(loss).collect()
}

#[test]
fn a_masked_pixel_gets_no_gradient() {
    let (rendered, mut target) = noisy((30, 20), 0.3, 78);
    let mask: Vec<u8> = (0..600).map(|p| if p % 3 == 0 { 0 } else { 255 }).collect();
    target.mask = Some(mask.clone());
    for (name, _, gradient) in losses(&rendered, &target) {
        for (p, _) in mask.iter().enumerate().filter(|&(_, &m)| m == 0) {
            let pixel = &gradient[3 * p..3 * p + 3];
            assert!(pixel.iter().all(|g| g.abs() < 1e-12), "{name}: pixel {p}");
        }
    }
}

#[test]
fn the_loss_and_the_metric_have_one_ssim() {
    let (rendered, target) = noisy((53, 41), 0.2, 79);
    let rendered: Vec<f32> = rendered.iter().map(|v| v.clamp(0.0, 1.0)).collect();
    let metric = densify::metrics::ssim(&rendered, &target, [0.0; 3]).unwrap();
    for (name, scalars, _) in losses(&rendered, &target) {
        let off = (f64::from(scalars.ssim) - metric).abs();
        assert!(off < 1e-6, "{name}: {} and {metric}", scalars.ssim);
    }
}
