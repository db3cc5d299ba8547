//! What the loss of the backend has in common with the metric, and what a mask does to it. Cases 23
//! and 24 of the [selftest](densify::verify) hold it against the reference's.

use crate::subject;
use densify::verify::scenes::noisy;

#[test]
fn a_masked_pixel_gets_no_gradient() {
    let (rendered, mut target) = noisy((30, 20), 0.3, 78);
    let mask: Vec<u8> = (0..600).map(|p| if p % 3 == 0 { 0 } else { 255 }).collect();
    target.mask = Some(mask.clone());
    let (_, gradient) = subject::loss(&rendered, &target, [0.0; 3]);
    for (p, _) in mask.iter().enumerate().filter(|&(_, &m)| m == 0) {
        assert!(gradient[3 * p..3 * p + 3].iter().all(|g| g.abs() < 1e-12), "pixel {p}");
    }
}

#[test]
fn the_loss_and_the_metric_have_one_ssim() {
    let (rendered, target) = noisy((53, 41), 0.2, 79);
    let rendered: Vec<f32> = rendered.iter().map(|v| v.clamp(0.0, 1.0)).collect();
    let (scalars, _) = subject::loss(&rendered, &target, [0.0; 3]);
    let metric = densify::metrics::ssim(&rendered, &target, [0.0; 3]).unwrap();
    assert!((f64::from(scalars.ssim) - metric).abs() < 1e-6, "{} and {metric}", scalars.ssim);
}
