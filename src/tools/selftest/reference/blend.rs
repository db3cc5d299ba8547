//! Front-to-back blending of every row into every pixel, and its derivative.

use super::project::Splat;
use super::{Image, Rules, ScreenGradient, Upstream, View};

/// A row blended into a pixel.
struct Contribution {
    row: usize,
    /// Pixel centre minus projected mean `[px]`.
    offset: [f64; 2],
    /// exp(−½ dᵀQd).
    falloff: f64,
    alpha: f64,
    clamped: bool,
    /// Transmittance in front of the row.
    transmittance: f64,
}

/// The rows blended into one pixel, front to back.
struct Pixel {
    contributions: Vec<Contribution>,
    /// Transmittance behind the last of them.
    transmittance: f64,
    /// True if a threshold was close.
    boundary: bool,
}

/// Relative distances within which `f32` may decide differently: of alpha to its minimum and its clamp, of
/// transmittance to its minimum, and between depths of neighbours. Rounding of `f32` is smaller by two orders
/// of magnitude.
const CLOSE_ALPHA: f64 = 1e-3;
const CLOSE_TRANSMITTANCE: f64 = 1e-2;
const CLOSE_DEPTH: f64 = 1e-6;

/// The pixels of an image, row by row.
fn pixels(view: View<'_>) -> impl Iterator<Item = [u32; 2]> {
    let (width, height) = (view.camera.width, view.camera.height);
    (0..height).flat_map(move |y| (0..width).map(move |x| [x, y]))
}

fn trace(splats: &[Splat], order: &[usize], [x, y]: [u32; 2], rules: &Rules) -> Pixel {
    let mut pixel = Pixel { contributions: Vec::new(), transmittance: 1.0, boundary: false };
    let mut last_depth = f64::NEG_INFINITY;
    for &row in order {
        let splat = &splats[row];
        let offset = [f64::from(x) + 0.5 - splat.mean[0], f64::from(y) + 0.5 - splat.mean[1]];
        let [dx, dy] = offset;
        let [a, b, c] = splat.conic;
        let falloff = (-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy).exp();
        let raw = splat.opacity * falloff;
        let close = |value: f64, to: f64, share: f64| (value - to).abs() < share * to;
        pixel.boundary |= close(raw, rules.alpha_min, CLOSE_ALPHA);
        if raw < rules.alpha_min {
            continue;
        }
        pixel.boundary |= close(raw, rules.alpha_max, CLOSE_ALPHA);
        // Equal depths are not close: every renderer takes the first row first.
        pixel.boundary |= splat.depth > last_depth && close(splat.depth, last_depth, CLOSE_DEPTH);
        last_depth = splat.depth;
        let alpha = raw.min(rules.alpha_max);
        let after = pixel.transmittance * (1.0 - alpha);
        pixel.boundary |= close(after, rules.transmittance_min, CLOSE_TRANSMITTANCE);
        if after <= rules.transmittance_min {
            break;
        }
        pixel.contributions.push(Contribution {
            row,
            offset,
            falloff,
            alpha,
            clamped: raw > rules.alpha_max,
            transmittance: pixel.transmittance,
        });
        pixel.transmittance = after;
    }
    pixel
}

fn visible_colour(splat: &Splat) -> [f64; 3] {
    splat.colour.map(|c| c.max(0.0))
}

/// One pixel of an [`Image`].
#[derive(Debug, Clone, Copy)]
pub struct Sample {
    /// Background included, not clamped.
    pub rgb: [f64; 3],
    /// 1 − final transmittance.
    pub alpha: f64,
    /// Σ α·T·z.
    pub depth: f64,
    /// Transmittance left for the background.
    pub transmittance: f64,
    /// Number of rows blended.
    pub blended: u32,
    /// True if a threshold was close.
    pub boundary: bool,
}

/// Renders one pixel of splats in the given order.
pub fn render_pixel(
    splats: &[Splat],
    order: &[usize],
    view: View<'_>,
    rules: &Rules,
    at: [u32; 2],
) -> Sample {
    let pixel = trace(splats, order, at, rules);
    let mut rgb = view.background.map(|b| b * pixel.transmittance);
    let mut depth = 0.0;
    for hit in &pixel.contributions {
        let weight = hit.alpha * hit.transmittance;
        let colour = visible_colour(&splats[hit.row]);
        for c in 0..3 {
            rgb[c] += weight * colour[c];
        }
        depth += weight * splats[hit.row].depth;
    }
    Sample {
        rgb,
        alpha: 1.0 - pixel.transmittance,
        depth,
        transmittance: pixel.transmittance,
        blended: pixel.contributions.len() as u32,
        boundary: pixel.boundary,
    }
}

/// Renders splats in the given order.
pub fn render(splats: &[Splat], order: &[usize], view: View<'_>, rules: &Rules) -> Image {
    let samples: Vec<Sample> =
        pixels(view).map(|at| render_pixel(splats, order, view, rules, at)).collect();
    Image {
        rgb: samples.iter().flat_map(|s| s.rgb).collect(),
        alpha: samples.iter().map(|s| s.alpha).collect(),
        depth: samples.iter().map(|s| s.depth).collect(),
        transmittance: samples.iter().map(|s| s.transmittance).collect(),
        blended: samples.iter().map(|s| s.blended).collect(),
        boundary: samples.iter().map(|s| s.boundary).collect(),
    }
}

/// Calls `f` for every row blended into a pixel, with the pixel, the row, its weight, and the distance of the
/// pixel's centre to the projected mean `[px]`.
pub fn each_blended(
    splats: &[Splat],
    order: &[usize],
    view: View<'_>,
    rules: &Rules,
    mut f: impl FnMut(usize, usize, f64, f64),
) {
    for (p, at) in pixels(view).enumerate() {
        for hit in trace(splats, order, at, rules).contributions {
            let [dx, dy] = hit.offset;
            f(p, hit.row, hit.alpha * hit.transmittance, dx.hypot(dy));
        }
    }
}

/// Gradients of Σ image · upstream with respect to the splats. Shape: `[rows]`.
pub fn backward(
    splats: &[Splat],
    order: &[usize],
    view: View<'_>,
    rules: &Rules,
    upstream: &Upstream,
) -> Vec<ScreenGradient> {
    backward_along_rays(splats, order, view, rules, upstream, &[])
}

/// The rows blended into each pixel with their weights, front to back.
pub fn rays(
    splats: &[Splat],
    order: &[usize],
    view: View<'_>,
    rules: &Rules,
) -> Vec<Vec<(usize, f64)>> {
    let blended = |hit: Contribution| (hit.row, hit.alpha * hit.transmittance);
    let ray = |at| trace(splats, order, at, rules).contributions.into_iter().map(blended).collect();
    pixels(view).map(ray).collect()
}

/// Gradients of Σ image · upstream plus a function of the [`rays`], whose derivatives with respect to the weights and
/// depths of each pixel's rows are given; if empty, they are 0.
pub fn backward_along_rays(
    splats: &[Splat],
    order: &[usize],
    view: View<'_>,
    rules: &Rules,
    upstream: &Upstream,
    by_sample: &[Vec<[f64; 2]>],
) -> Vec<ScreenGradient> {
    let mut gradient = vec![ScreenGradient::default(); splats.len()];
    for (p, at) in pixels(view).enumerate() {
        let pixel = trace(splats, order, at, rules);
        let d_rgb = [0, 1, 2].map(|c| upstream.rgb[3 * p + c]);
        let (d_alpha_out, d_depth) = (upstream.alpha[p], upstream.depth[p]);
        // Loss contribution of everything behind; at first the background.
        let mut behind: f64 =
            pixel.transmittance * (0..3).map(|c| view.background[c] * d_rgb[c]).sum::<f64>();
        for (i, hit) in pixel.contributions.iter().enumerate().rev() {
            let [by_weight, by_depth] = by_sample.get(p).map_or([0.0; 2], |ray| ray[i]);
            let splat = &splats[hit.row];
            let colour = visible_colour(splat);
            let weight = hit.alpha * hit.transmittance;
            let value = (0..3).map(|c| colour[c] * d_rgb[c]).sum::<f64>()
                + splat.depth * d_depth
                + d_alpha_out
                + by_weight;
            let d_alpha = hit.transmittance * value - behind / (1.0 - hit.alpha);
            behind += weight * value;

            let sum = &mut gradient[hit.row];
            for (colour, d) in sum.colour.iter_mut().zip(d_rgb) {
                *colour += weight * d;
            }
            sum.depth += weight * d_depth + by_depth;
            sum.max_weight = sum.max_weight.max(weight);
            sum.sum_weight += weight;
            sum.pixels += 1;
            if !hit.clamped {
                sum.opacity += d_alpha * hit.falloff;
                add_exponent(sum, splat, hit, -d_alpha * hit.alpha);
            }
        }
    }
    gradient
}

/// Adds what the exponent p in alpha = opacity · exp(−p) contributes to the gradients of the mean and the conic.
fn add_exponent(sum: &mut ScreenGradient, splat: &Splat, hit: &Contribution, d_exponent: f64) {
    let [dx, dy] = hit.offset;
    let [a, b, c] = splat.conic;
    let d_mean = [-d_exponent * (a * dx + b * dy), -d_exponent * (b * dx + c * dy)];
    for (axis, d) in d_mean.into_iter().enumerate() {
        sum.mean[axis] += d;
        sum.mean_abs[axis] += d.abs();
    }
    sum.conic[0] += d_exponent * 0.5 * dx * dx;
    sum.conic[1] += d_exponent * dx * dy;
    sum.conic[2] += d_exponent * 0.5 * dy * dy;
}

/// Upper bounds of what the pixels not marked in `counted` add to each row's statistics, whichever way a backend
/// decides thresholds that are close: largest weight, sum of weights, number of pixels.
pub fn leeway(
    splats: &[Splat],
    order: &[usize],
    view: View<'_>,
    counted: &[bool],
) -> Vec<(f64, f64, u32)> {
    // These rules skip no row that a backend may blend: an alpha 10 % below the minimum is never blended.
    let rules = Rules { alpha_min: 0.9 / 255.0, ..Rules::SMOOTH };
    let mut bounds = vec![(0.0, 0.0, 0); splats.len()];
    for (at, _) in pixels(view).zip(counted).filter(|(_, counted)| !**counted) {
        for hit in trace(splats, order, at, &rules).contributions {
            // A row in front that is blended here but skipped by the backend makes the backend's transmittance up to
            // 1/255 larger.
            let weight = 1.01 * hit.alpha * hit.transmittance;
            let (largest, sum, pixels) = &mut bounds[hit.row];
            *largest = weight.max(*largest);
            *sum += weight;
            *pixels += 1;
        }
    }
    bounds
}
