//! Peak signal-to-noise ratio, −10·log₁₀(MSE) at peak 1.

use rayon::prelude::*;

use super::{MetricError, Pair, total};
use densify_core::image::Image8;

/// PSNR `[dB]` of a render against a target, from the mean squared error over all pixels and channels.
///
/// `rendered`: shape `[height, width, 3]`, clamped to `[0, 1]` here. Targets with coverage are composited on
/// `background`, in `[0, 1]`. Infinite for equal images, NaN if the render contains a NaN.
///
/// # Errors
/// When the sizes differ or the target's mask ignores every pixel.
pub fn psnr(rendered: &[f32], target: &Image8, background: [f32; 3]) -> Result<f64, MetricError> {
    let pair = Pair::new(rendered, target, background)?;
    // One sum per image row, added in order: the same bits at any thread count.
    let rows: Vec<[f64; 2]> = (0..pair.height).into_par_iter().map(|y| row(&pair, y)).collect();
    let [squared, weight] = total(&rows)?;
    // 0 − x instead of −x avoids a negative zero.
    Ok(0.0 - 10.0 * (squared / (3.0 * weight)).log10())
}

/// PSNR `[dB]` of two renders of one view, both clamped to `[0, 1]`; infinite when they are equal.
pub fn psnr_between(a: &[f32], b: &[f32]) -> f64 {
    assert_eq!(a.len(), b.len(), "the renders differ in size");
    let value = |v: f32| f64::from(v.clamp(0.0, 1.0));
    let squares = a.iter().zip(b).map(|(a, b)| (value(*a) - value(*b)).powi(2)).sum::<f64>();
    0.0 - 10.0 * (squares / a.len() as f64).log10()
}

/// Sums of the weighted squared errors and of the weights of one row of pixels.
fn row(pair: &Pair<'_>, y: usize) -> [f64; 2] {
    let mut sum = [0.0; 2];
    for p in y * pair.width..(y + 1) * pair.width {
        let weight = pair.weight(p);
        // An ignored pixel may be NaN.
        if weight > 0.0 {
            sum[0] += weight * (0..3).map(|c| pair.error(p, c).powi(2)).sum::<f64>();
            sum[1] += weight;
        }
    }
    sum
}

#[cfg(test)]
mod tests {
    use super::*;

    fn target(width: u32, height: u32, value: u8) -> Image8 {
        let pixels = (width * height) as usize;
        Image8 { width, height, rgb: vec![value; 3 * pixels], alpha: None, mask: None }
    }

    #[test]
    fn uniform_errors_have_a_known_psnr() {
        let black = target(7, 5, 0);
        for (value, expected) in [(0.1, 20.0), (0.01, 40.0), (1.0, 0.0), (0.5, 6.020_599_913)] {
            let measured = psnr(&[value; 105], &black, [0.0; 3]).unwrap();
            assert!((measured - expected).abs() < 1e-6, "{value}: {measured} for {expected}");
        }
    }

    #[test]
    fn psnr_between_clamps_the_renders() {
        assert!((psnr_between(&[0.5, 0.1], &[0.4, 0.2]) - 20.0).abs() < 1e-5);
        assert!(psnr_between(&[1.5, 0.1], &[1.0, 0.1]).is_infinite());
    }

    #[test]
    fn equal_images_have_an_infinite_psnr_and_the_render_is_clamped() {
        let white = target(4, 4, 255);
        assert_eq!(psnr(&[1.0; 48], &white, [0.0; 3]), Ok(f64::INFINITY));
        assert_eq!(psnr(&[7.5; 48], &white, [0.0; 3]), Ok(f64::INFINITY));
        assert_eq!(psnr(&[-3.0; 48], &target(4, 4, 0), [0.0; 3]), Ok(f64::INFINITY));
        assert!(psnr(&[f32::NAN; 48], &white, [0.0; 3]).unwrap().is_nan());
    }

    #[test]
    fn coverage_is_composited_on_the_background() {
        let mut covered = target(1, 1, 255);
        covered.alpha = Some(vec![0]);
        assert_eq!(psnr(&[0.25, 0.5, 0.75], &covered, [0.25, 0.5, 0.75]), Ok(f64::INFINITY));
        covered.alpha = Some(vec![51]);
        // 0.2 · 1 + 0.8 · 0.5 = 0.6, so a render of 0.5 is 0.1 off.
        let measured = psnr(&[0.5; 3], &covered, [0.5; 3]).unwrap();
        assert!((measured - 20.0).abs() < 1e-9, "{measured}");
    }

    #[test]
    fn pixels_count_by_their_mask_weight() {
        let mut half = target(2, 1, 0);
        half.mask = Some(vec![255, 0]);
        let measured = psnr(&[0.1, 0.1, 0.1, f32::NAN, 1.0, 1.0], &half, [0.0; 3]).unwrap();
        assert!((measured - 20.0).abs() < 1e-6, "{measured}");

        half.mask = Some(vec![204, 51]);
        let measured = psnr(&[0.0, 0.0, 0.0, 1.0, 1.0, 1.0], &half, [0.0; 3]).unwrap();
        assert!((measured - 10.0 * 5.0_f64.log10()).abs() < 1e-12, "{measured}");

        half.mask = Some(vec![0, 0]);
        assert_eq!(psnr(&[0.0; 6], &half, [0.0; 3]), Err(MetricError::NothingToCompare));
    }

    #[test]
    fn images_of_different_sizes_are_refused() {
        let (width, height) = (2, 2);
        let size =
            |part, found, expected| Err(MetricError::Size { part, found, expected, width, height });
        let mut image = target(2, 2, 0);
        assert_eq!(psnr(&[0.0; 11], &image, [0.0; 3]), size("render", 11, 12));
        image.alpha = Some(vec![0; 3]);
        assert_eq!(psnr(&[0.0; 12], &image, [0.0; 3]), size("target's coverage", 3, 4));
    }

    #[test]
    fn a_large_image_loses_nothing_to_rounding() {
        // 2048² equal errors: a sum in f32 would stop growing long before the end.
        let n = 3 * 2048 * 2048;
        let measured = psnr(&vec![0.001; n], &target(2048, 2048, 0), [0.0; 3]).unwrap();
        let expected = -20.0 * f64::from(0.001_f32).log10();
        assert!((measured - expected).abs() < 1e-9, "{measured} for {expected}");
    }
}
