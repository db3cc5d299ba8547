//! Fits the exposure of a rendering to its photograph by least squares: a factor and an offset per channel. Test views
//! have exposures that the model cannot know; scores after this fit do not penalise the model for them.

use densify_core::image::Image8;

/// Applies the factor and offset per channel that bring `rendered` closest to `target` composited on `background`. The
/// target's mask weights the pixels; in a channel without contrast only the offset is fitted. Shape:
/// `[height, width, 3]`.
///
/// # Panics
/// When the sizes differ; callers compare them first.
pub fn fitted(rendered: &[f32], target: &Image8, background: [f32; 3]) -> Vec<f32> {
    let width = target.width as usize;
    assert_eq!(rendered.len(), 3 * width * target.height as usize, "sizes differ");
    let mut sums = [Sums::default(); 3];
    for (pixel, colour) in rendered.as_chunks::<3>().0.iter().enumerate() {
        let weight = target.mask.as_ref().map_or(1.0, |mask| f64::from(mask[pixel]) / 255.0);
        // An ignored pixel may be NaN.
        if weight > 0.0 {
            let truth = target.composited(pixel % width, pixel / width, background);
            for ((sums, x), y) in sums.iter_mut().zip(colour).zip(truth) {
                sums.add(weight, f64::from(x.clamp(0.0, 1.0)), f64::from(y));
            }
        }
    }
    let lines = sums.map(|sums| sums.line());
    let mut out = rendered.to_owned();
    for colour in out.as_chunks_mut::<3>().0 {
        for (x, [factor, offset]) in colour.iter_mut().zip(lines) {
            *x = (factor * f64::from(x.clamp(0.0, 1.0)) + offset) as f32;
        }
    }
    out
}

/// Weighted sums over pairs of a rendering's value x and a photograph's value y.
#[derive(Debug, Clone, Copy, Default)]
struct Sums {
    weight: f64,
    x: f64,
    y: f64,
    xx: f64,
    xy: f64,
}

impl Sums {
    fn add(&mut self, weight: f64, x: f64, y: f64) {
        self.weight += weight;
        self.x += weight * x;
        self.y += weight * y;
        self.xx += weight * x * x;
        self.xy += weight * x * y;
    }

    /// The factor and offset of the regression line.
    fn line(&self) -> [f64; 2] {
        let Self { weight, x, y, xx, xy } = *self;
        let variance = xx * weight - x * x;
        // A variance below (1e-4 / 255)² is due to rounding.
        let factor = if variance > weight * weight * 1.5e-13 {
            (xy * weight - x * y) / variance
        } else {
            1.0
        };
        if weight > 0.0 { [factor, (y - factor * x) / weight] } else { [1.0, 0.0] }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A photograph of many colours y, and its rendering 0.8·y + 0.1.
    fn pair(mask: Option<Vec<u8>>) -> (Vec<f32>, Image8) {
        let rgb: Vec<u8> = (0..3 * 48).map(|i| (i * 53 % 251) as u8).collect();
        let rendered = rgb.iter().map(|&y| 0.8 * f32::from(y) / 255.0 + 0.1).collect();
        (rendered, Image8 { width: 8, height: 6, rgb, alpha: None, mask })
    }

    #[test]
    fn a_factor_and_an_offset_are_undone() {
        let (rendered, target) = pair(None);
        let found = fitted(&rendered, &target, [0.0; 3]);
        for (found, expected) in found.iter().zip(&target.rgb) {
            assert!((found - f32::from(*expected) / 255.0).abs() < 1e-5, "{found}, {expected}");
        }
    }

    #[test]
    fn masked_pixels_do_not_count() {
        let mut mask = vec![255; 48];
        mask[5] = 0;
        let (mut rendered, target) = pair(Some(mask));
        rendered[15] = f32::NAN;
        rendered[16] = 0.9;
        let found = fitted(&rendered, &target, [0.0; 3]);
        assert!((found[0] - f32::from(target.rgb[0]) / 255.0).abs() < 1e-5, "{}", found[0]);
        assert!(found[15].is_nan());
    }

    #[test]
    fn flat_images_are_shifted_and_fully_masked_ones_unchanged() {
        let rgb = vec![51; 3 * 4];
        let mut target = Image8 { width: 2, height: 2, rgb, alpha: None, mask: None };
        let found = fitted(&[0.5; 12], &target, [0.0; 3]);
        assert!(found.iter().all(|x| (x - 0.2).abs() < 1e-6), "{found:?}");
        target.mask = Some(vec![0; 4]);
        assert_eq!(fitted(&[0.5; 12], &target, [0.0; 3]), [0.5; 12]);
    }
}
