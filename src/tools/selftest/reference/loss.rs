//! The training loss, 0.8 · L1 + 0.2 · (1 − SSIM), and the gradient that training follows, straight from the definition.

use densify_policies::policy::PixelLoss;

/// Radius of the 11×11 window `[px]`.
const REACH: i64 = 5;
const C1: f64 = 0.0001;
const C2: f64 = 0.0009;

/// The loss, its parts, and its gradient.
#[derive(Debug, Clone)]
pub struct Loss {
    /// 0.8 · L1 + 0.2 · (1 − SSIM).
    pub loss: f64,
    /// Mean absolute error over pixels and channels.
    pub l1: f64,
    /// Mean SSIM.
    pub ssim: f64,
    /// The loss with the pixel term in place of L1, which training minimises.
    pub minimised: f64,
    /// Gradient of `minimised` with respect to the rendering. Shape: [height, width, 3].
    pub gradient: Vec<f64>,
    /// Absolute error and 1 − SSIM of each pixel, means over channels.
    pub by_pixel: Vec<[f64; 2]>,
}

/// Weights of the window, σ = 1.5 px, by (dy, dx); they sum to 1.
fn window() -> Vec<(i64, i64, f64)> {
    let mut taps = Vec::new();
    for dy in -REACH..=REACH {
        for dx in -REACH..=REACH {
            taps.push((dy, dx, (-((dx * dx + dy * dy) as f64) / 4.5).exp()));
        }
    }
    let sum: f64 = taps.iter().map(|tap| tap.2).sum();
    taps.into_iter().map(|(dy, dx, weight)| (dy, dx, weight / sum)).collect()
}

/// Convolves an image of [height, width, 3] with the window, with zeros beyond the border. The window is
/// symmetric, so the convolution is its own transpose.
fn blur(image: &[f64], width: usize, height: usize) -> Vec<f64> {
    let taps = window();
    let (w, h) = (width as i64, height as i64);
    (0..image.len())
        .map(|i| {
            let (c, x, y) = (i % 3, (i / 3 % width) as i64, (i / 3 / width) as i64);
            taps.iter()
                .filter(|(dy, dx, _)| (0..h).contains(&(y + dy)) && (0..w).contains(&(x + dx)))
                .map(|(dy, dx, k)| k * image[3 * ((y + dy) * w + x + dx) as usize + c])
                .sum()
        })
        .collect()
}

fn product(a: &[f64], b: &[f64]) -> Vec<f64> {
    a.iter().zip(b).map(|(a, b)| a * b).collect()
}

/// The loss of `rendered` against `target`: [height, width, 3], not clamped.
pub fn loss(
    rendered: &[f64],
    target: &[f64],
    (width, height): (usize, usize),
    pixel_loss: PixelLoss,
) -> Loss {
    let n = rendered.len() as f64;
    let blurred = |image: &[f64]| blur(image, width, height);
    let (mx, my) = (blurred(rendered), blurred(target));
    let xx = blurred(&product(rendered, rendered));
    let yy = blurred(&product(target, target));
    let xy = blurred(&product(rendered, target));
    let mut ssim = 0.0;
    let mut by_pixel = vec![[0.0; 2]; rendered.len() / 3];
    // Gradients of Σ SSIM with respect to μx, E[x²] and E[xy] at every pixel.
    let [mut d_mx, mut d_xx, mut d_xy] = [(); 3].map(|()| vec![0.0; rendered.len()]);
    for i in 0..rendered.len() {
        let (a, b) = (2.0 * mx[i] * my[i] + C1, 2.0 * (xy[i] - mx[i] * my[i]) + C2);
        let c = mx[i] * mx[i] + my[i] * my[i] + C1;
        let d = xx[i] - mx[i] * mx[i] + yy[i] - my[i] * my[i] + C2;
        let value = a * b / (c * d);
        ssim += value;
        let [absolute, dissimilar] = &mut by_pixel[i / 3];
        *absolute += (rendered[i] - target[i]).abs() / 3.0;
        *dissimilar += (1.0 - value) / 3.0;
        d_mx[i] = (2.0 * my[i] * b - 2.0 * my[i] * a) / (c * d) - value * 2.0 * mx[i] / c
            + value * 2.0 * mx[i] / d;
        d_xx[i] = -value / d;
        d_xy[i] = 2.0 * a / (c * d);
    }
    ssim /= n;
    let (d_mx, d_xx, d_xy) = (blurred(&d_mx), blurred(&d_xx), blurred(&d_xy));
    let (mut l1, mut term) = (0.0, 0.0);
    let bound = f64::from(pixel_loss.bound());
    let gradient = (0..rendered.len())
        .map(|i| {
            let error = rendered[i] - target[i];
            l1 += error.abs();
            let size = error.abs();
            let (value, by_pixel) = if size < bound {
                (size * size / (2.0 * bound), error / bound)
            } else {
                (size - bound / 2.0, if error == 0.0 { 0.0 } else { error.signum() })
            };
            term += value;
            let d_ssim = d_mx[i] + 2.0 * rendered[i] * d_xx[i] + target[i] * d_xy[i];
            (0.8 * by_pixel - 0.2 * d_ssim) / n
        })
        .collect();
    l1 /= n;
    let with = |pixels: f64| 0.8 * pixels + 0.2 * (1.0 - ssim);
    Loss { loss: with(l1), l1, ssim, minimised: with(term / n), gradient, by_pixel }
}
