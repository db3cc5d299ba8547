//! Mean structural similarity (Wang, Bovik, Sheikh and Simoncelli, *Image Quality Assessment*,
//! IEEE TIP 13(4), 2004, eq. 13), as the 3D Gaussian Splatting papers report it: an 11×11
//! Gaussian window with σ = 1.5 px, zeros beyond the border, each colour channel by itself,
//! mean over all pixels and channels.
//!
//! The textbook formula cancels badly where the images are flat. With e = x − y, an equivalent form is
//!
//! > SSIM = (1 − μe² / (μx² + μy² + C₁)) · (1 − Var e / (Var x + Var y + C₂)),
//!
//! which is exactly 1 for equal images and precise for small errors.

use super::{MetricError, Pair, by_blocks, total};
use densify_core::image::Image8;

/// Radius of the window `[px]`.
const RADIUS: usize = 5;
/// Standard deviation of the window `[px]`.
const SIGMA: f64 = 1.5;
/// (0.01 · peak)², peak = 1.
const C1: f64 = 0.01 * 0.01;
/// (0.03 · peak)².
const C2: f64 = 0.03 * 0.03;

/// Mean SSIM of a render against a target, <= 1.
///
/// `rendered`: shape `[height, width, 3]`, clamped to `[0, 1]` here. Targets with coverage are composited on
/// `background`, in `[0, 1]`. Images smaller than the window need no special case, because both are zero beyond the
/// border. NaN if the render contains a NaN.
///
/// # Errors
/// When the sizes differ or the target's mask ignores every pixel.
pub fn ssim(rendered: &[f32], target: &Image8, background: [f32; 3]) -> Result<f64, MetricError> {
    let pair = Pair::new(rendered, target, background)?;
    let window = window();
    // One sum per block of rows, added in order: the same bits at any thread count.
    let sums = by_blocks(pair.height, |rows| {
        let map = block_map(&pair, &window, rows.start, rows.end);
        let pixels = rows.start * pair.width..rows.end * pair.width;
        pixels.zip(map.chunks_exact(3)).fold([0.0; 2], |sum, (p, ssim)| {
            let weight = pair.weight(p);
            if weight > 0.0 {
                [sum[0] + weight * ssim.iter().sum::<f64>(), sum[1] + weight]
            } else {
                sum
            }
        })
    });
    let [similarity, weight] = total(&sums)?;
    Ok(similarity / (3.0 * weight))
}

/// The window along one axis, with sum 1. The two-dimensional window is its outer product.
fn window() -> [f64; 2 * RADIUS + 1] {
    let mut window = [0.0; 2 * RADIUS + 1];
    for (i, w) in window.iter_mut().enumerate() {
        let distance = i as f64 - RADIUS as f64;
        *w = (-0.5 * (distance / SIGMA).powi(2)).exp();
    }
    let sum: f64 = window.iter().sum();
    window.map(|w| w / sum)
}

/// The averages of e, y, e² and x² + y² over the window.
type Moments = [f64; 4];

/// SSIM of rows `first..last`. Shape: `[last − first, width, 3]`.
fn block_map(pair: &Pair<'_>, window: &[f64], first: usize, last: usize) -> Vec<f64> {
    let values = 3 * pair.width;
    // The block's rows and those that their windows reach.
    let top = first.saturating_sub(RADIUS);
    let bottom = (last + RADIUS).min(pair.height);
    let mut across: Vec<Moments> = Vec::with_capacity((bottom - top) * values);
    let mut row = Vec::with_capacity(values);
    for y in top..bottom {
        moments_of_row(pair, y, &mut row);
        for i in 0..values {
            let (x, c) = (i / 3, i % 3);
            let (from, to) = (x.saturating_sub(RADIUS), (x + RADIUS + 1).min(pair.width));
            let taps = &window[from + RADIUS - x..];
            let mut sum = Moments::default();
            for (w, moments) in
                taps.iter().zip(row[3 * from + c..].iter().step_by(3)).take(to - from)
            {
                add(&mut sum, *w, moments);
            }
            across.push(sum);
        }
    }
    let mut map = Vec::with_capacity((last - first) * values);
    for y in first..last {
        let (from, to) = (y.saturating_sub(RADIUS), (y + RADIUS + 1).min(pair.height));
        for i in 0..values {
            let mut sum = Moments::default();
            for row in from..to {
                add(&mut sum, window[row + RADIUS - y], &across[(row - top) * values + i]);
            }
            map.push(similarity(sum));
        }
    }
    map
}

fn add(sum: &mut Moments, weight: f64, moments: &Moments) {
    for (s, m) in sum.iter_mut().zip(moments) {
        *s += weight * m;
    }
}

fn moments_of_row(pair: &Pair<'_>, y: usize, row: &mut Vec<Moments>) {
    row.clear();
    for p in y * pair.width..(y + 1) * pair.width {
        let weight = pair.weight(p);
        for c in 0..3 {
            let truth = pair.truth(p, c);
            // The mask's weight scales the pixel's error. An ignored pixel may be NaN.
            let error = if weight > 0.0 { weight * pair.error(p, c) } else { 0.0 };
            let x = truth + error;
            row.push([error, truth, error * error, x * x + truth * truth]);
        }
    }
}

fn similarity([e, y, e_squared, squares]: Moments) -> f64 {
    let x = y + e;
    let means = x * x + y * y;
    let luminance = 1.0 - e * e / (means + C1);
    let structure = 1.0 - (e_squared - e * e) / (squares - means + C2);
    luminance * structure
}

#[cfg(test)]
mod tests {
    use super::super::BLOCK;
    use super::*;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    /// The textbook formula: a two-dimensional window with 121 taps per pixel.
    fn textbook(x: &[f64], y: &[f64], width: usize, height: usize) -> Vec<f64> {
        let mut window = [[0.0; 11]; 11];
        for (j, row) in window.iter_mut().enumerate() {
            for (i, w) in row.iter_mut().enumerate() {
                let (dx, dy) = (i as f64 - 5.0, j as f64 - 5.0);
                *w = (-(dx * dx + dy * dy) / (2.0 * 1.5 * 1.5)).exp();
            }
        }
        let sum: f64 = window.iter().flatten().sum();
        let mut map = vec![0.0; 3 * width * height];
        for (index, value) in map.iter_mut().enumerate() {
            let (c, px, py) = (index % 3, index / 3 % width, index / 3 / width);
            let [mut ex, mut ey, mut exx, mut eyy, mut exy] = [0.0; 5];
            for (j, row) in window.iter().enumerate() {
                for (i, w) in row.iter().enumerate() {
                    let (Some(qx), Some(qy)) = ((px + i).checked_sub(5), (py + j).checked_sub(5))
                    else {
                        continue;
                    };
                    if qx >= width || qy >= height {
                        continue;
                    }
                    let (a, b) = (x[3 * (qy * width + qx) + c], y[3 * (qy * width + qx) + c]);
                    let w = w / sum;
                    ex += w * a;
                    ey += w * b;
                    exx += w * a * a;
                    eyy += w * b * b;
                    exy += w * a * b;
                }
            }
            let (c1, c2) = (0.0001, 0.0009);
            *value = (2.0 * ex * ey + c1) * (2.0 * (exy - ex * ey) + c2)
                / ((ex * ex + ey * ey + c1) * (exx - ex * ex + eyy - ey * ey + c2));
        }
        map
    }

    /// A render and a random target; they differ by up to `noise / 2` per channel.
    fn noisy(width: u32, height: u32, noise: f32, seed: u64) -> (Vec<f32>, Image8) {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let n = (3 * width * height) as usize;
        let rgb: Vec<u8> = (0..n).map(|_| rng.random()).collect();
        let noisy = |&v: &u8| f32::from(v) / 255.0 + noise * (rng.random::<f32>() - 0.5);
        let rendered = rgb.iter().map(noisy).collect();
        (rendered, Image8 { width, height, rgb, alpha: None, mask: None })
    }

    fn clamped(rendered: &[f32]) -> Vec<f64> {
        rendered.iter().map(|&v| f64::from(v).clamp(0.0, 1.0)).collect()
    }

    fn unpacked(target: &Image8) -> Vec<f64> {
        target.rgb.iter().map(|&v| f64::from(v) / 255.0).collect()
    }

    fn mean(values: &[f64]) -> f64 {
        values.iter().sum::<f64>() / values.len() as f64
    }

    fn flat(width: u32, height: u32, value: u8) -> Image8 {
        let n = (3 * width * height) as usize;
        Image8 { width, height, rgb: vec![value; n], alpha: None, mask: None }
    }

    #[test]
    fn agrees_with_the_textbook_pixel_by_pixel_at_every_size() {
        let sizes = [(1, 1), (1, 17), (17, 1), (5, 4), (11, 11), (15, 15), (16, 16), (33, 67)];
        for (seed, (width, height)) in sizes.into_iter().enumerate() {
            for noise in [0.001, 0.02, 1.0] {
                let (rendered, target) = noisy(width, height, noise, seed as u64);
                let (w, h) = (width as usize, height as usize);
                let expected = textbook(&clamped(&rendered), &unpacked(&target), w, h);
                let pair = Pair::new(&rendered, &target, [0.0; 3]).unwrap();
                let blocks = (0..h).step_by(BLOCK);
                let map = blocks.flat_map(|y| block_map(&pair, &window(), y, (y + BLOCK).min(h)));
                let worst = map.zip(&expected).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
                assert!(worst < 1e-12, "{width}x{height}, noise {noise}: {worst:e}");
                let measured = ssim(&rendered, &target, [0.0; 3]).unwrap();
                let difference = (measured - mean(&expected)).abs();
                assert!(difference < 1e-13, "{width}x{height}: mean off by {difference:e}");
            }
        }
    }

    #[test]
    fn equal_images_have_a_similarity_of_exactly_one() {
        assert_eq!(ssim(&[0.0; 19 * 23 * 3], &flat(19, 23, 0), [0.0; 3]), Ok(1.0));
        assert_eq!(ssim(&[1.0; 19 * 23 * 3], &flat(19, 23, 255), [0.0; 3]), Ok(1.0));
    }

    #[test]
    fn the_similarity_of_one_pixel_has_a_closed_form() {
        // The window sees the pixel with weight w and zeros elsewhere: μ = w·x, E[x²] = w·x².
        let w = window()[RADIUS].powi(2);
        let (x, y) = (f64::from(0.75_f32), 51.0 / 255.0);
        let (c1, c2) = (0.01_f64.powi(2), 0.03_f64.powi(2));
        let expected = (2.0 * w * w * x * y + c1) * (2.0 * (w - w * w) * x * y + c2)
            / ((w * w * (x * x + y * y) + c1) * ((w - w * w) * (x * x + y * y) + c2));
        let measured = ssim(&[0.75; 3], &flat(1, 1, 51), [0.0; 3]).unwrap();
        assert!((measured - expected).abs() < 1e-13, "{measured} for {expected}");
    }

    #[test]
    fn nearly_equal_flat_images_do_not_exceed_one() {
        // The render, 0.6 in f32, is within half an ulp of 153/255. The textbook formula in f32 reports 1.0000046 here.
        let target = flat(64, 64, 153);
        let rendered = vec![0.6; 64 * 64 * 3];
        let measured = ssim(&rendered, &target, [0.0; 3]).unwrap();
        assert!(measured <= 1.0 && measured > 1.0 - 1e-9, "{measured}");
    }

    #[test]
    fn masked_pixels_have_no_effect() {
        let (mut rendered, mut target) = noisy(20, 20, 0.1, 5);
        let mask: Vec<u8> = (0..400).map(|p| if p % 20 < 10 { 255 } else { 0 }).collect();
        target.mask = Some(mask.clone());
        let before = ssim(&rendered, &target, [0.0; 3]).unwrap();
        for (p, _) in mask.iter().enumerate().filter(|&(_, &m)| m == 0) {
            rendered[3 * p..3 * p + 3].copy_from_slice(&[f32::NAN, -4.0, 0.5]);
        }
        assert_eq!(ssim(&rendered, &target, [0.0; 3]), Ok(before));

        // If the ignored pixels equal the target's, the mask only selects the pixels that are averaged.
        let (mut x, y) = (clamped(&rendered), unpacked(&target));
        let is_masked = |i: usize| mask[i / 3] == 0;
        (0..1200).filter(|&i| is_masked(i)).for_each(|i| x[i] = y[i]);
        let map = textbook(&x, &y, 20, 20);
        let counted: Vec<f64> = (0..1200).filter(|&i| !is_masked(i)).map(|i| map[i]).collect();
        assert!((before - mean(&counted)).abs() < 1e-13);

        target.mask = Some(vec![0; 400]);
        assert_eq!(ssim(&rendered, &target, [0.0; 3]), Err(MetricError::NothingToCompare));
    }

    #[test]
    fn coverage_is_composited_on_the_background() {
        let (rendered, mut target) = noisy(14, 12, 0.3, 6);
        let alpha: Vec<u8> = (0..168).map(|p| (p * 3 % 256) as u8).collect();
        let background = [0.25_f32, 0.5, 1.0];
        let mut y = unpacked(&target);
        for (i, v) in y.iter_mut().enumerate() {
            let a = f64::from(alpha[i / 3]) / 255.0;
            *v = a * *v + (1.0 - a) * f64::from(background[i % 3]);
        }
        let expected = mean(&textbook(&clamped(&rendered), &y, 14, 12));
        target.alpha = Some(alpha);
        let measured = ssim(&rendered, &target, background).unwrap();
        assert!((measured - expected).abs() < 1e-13, "{measured} for {expected}");
    }

    #[test]
    fn results_are_bit_identical_at_any_thread_count() {
        let (rendered, target) = noisy(50, 170, 0.4, 7);
        let bits = [1, 2, 5].map(|threads| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| ssim(&rendered, &target, [0.0; 3])).unwrap().to_bits()
        });
        assert_eq!(bits, [bits[0]; 3]);
    }
}
