//! Measurements of auxiliary views that both backends take on the host: the pixel map, the pixels of surface
//! points, and the radius of a row.

use densify_policies::policy::{ErrorScore, PixelMap};
use densify_policies::rng::PolicyRng;
use densify_policies::sample::weighted;

use super::AuxInput;
use densify_core::image::Image8;

/// The pixel map of a rendering; see [`PixelMap`]. Shape of rendering and map: `[height, width]`.
pub(super) fn pixel_map(
    rgb: &[[f32; 3]],
    target: &Image8,
    background: [f32; 3],
    map: PixelMap,
) -> Vec<f32> {
    let width = target.width as usize;
    let weight = |at: usize| target.mask.as_ref().map_or(1.0, |m| f32::from(m[at]) / 255.0);
    let mut error: Vec<f32> = rgb
        .iter()
        .enumerate()
        .map(|(at, rendered)| {
            let truth = target.composited(at % width, at / width, background);
            let difference = |i: usize| (rendered[i] - truth[i]).abs();
            weight(at) * (difference(0) + difference(1) + difference(2)) / 3.0
        })
        .collect();
    let mut edge: Vec<f32> = edges(target, background).into_iter().map(f32::from).collect();
    for (at, edge) in edge.iter_mut().enumerate() {
        *edge *= weight(at);
    }
    stretch(&mut error);
    stretch(&mut edge);
    if map.threshold > 0.0 {
        for e in &mut error {
            *e = f32::from(u8::from(*e > map.threshold));
        }
    }
    error.iter().zip(&edge).map(|(e, g)| map.error * e + map.edge * g).collect()
}

/// Pixels (x, y, alpha) sampled without replacement in proportion to their alpha.
pub(super) fn sample_pixels(
    alpha: &[f32],
    width: usize,
    input: &AuxInput<'_>,
) -> Vec<(usize, usize, f32)> {
    // Views of one step use different random numbers.
    let view_hash = (input.view as u64 + 1).wrapping_mul(0x9e37_79b9_7f4a_7c15);
    let rng = PolicyRng::new(input.seed ^ view_hash, input.step);
    let sampled = weighted(alpha, input.request.points as usize, &rng);
    sampled
        .into_iter()
        .map(|at| (at as usize % width, at as usize / width, alpha[at as usize]))
        .collect()
}

/// Three standard deviations along the longer axis of a projected covariance [a b; b c], rounded up `[px]`. The
/// covariance is given by its factors 1/l1 = √(det/c), shear = b/c and 1/l3 = √c.
pub(super) fn radius_px(inv_l1: f32, shear: f32, inv_l3: f32) -> f32 {
    let c = inv_l3 * inv_l3;
    let b = shear * c;
    let a = inv_l1 * inv_l1 + shear * b;
    let mid = 0.5 * (a + c);
    // The root of mid² − det, without cancellation.
    let root = (0.5 * (a - c)).hypot(b);
    (3.0 * (mid + root).sqrt()).ceil()
}

/// Edge strength per pixel. Shape: `[height, width]`.
fn edges(target: &Image8, background: [f32; 3]) -> Vec<u8> {
    let size = [target.width as usize, target.height as usize];
    let mut luma = vec![0; size[0] * size[1]];
    for (y, line) in luma.chunks_exact_mut(size[0].max(1)).enumerate() {
        luma_line(target, background, y, line);
    }
    (0..luma.len()).map(|at| edge_at(&luma, size, at)).collect()
}

/// Writes the 8-bit luma of an image row.
pub(super) fn luma_line(target: &Image8, background: [f32; 3], y: usize, line: &mut [u8]) {
    for (x, luma) in line.iter_mut().enumerate() {
        let rgb = target.composited(x, y, background);
        let [r, g, b] = rgb.map(|v| (v.clamp(0.0, 1.0) * 255.0).round() as u32);
        // ITU-R 601-2 in 16 bits: 0.299, 0.587, 0.114.
        *luma = ((19_595 * r + 38_470 * g + 7_471 * b + 32_768) >> 16) as u8;
    }
}

/// The 8-neighbour Laplacian of the luma at a pixel, clipped to 0..255; border pixels are repeated.
pub(super) fn edge_at(luma: &[u8], [width, height]: [usize; 2], pixel: usize) -> u8 {
    let at = |x: usize, y: usize| i32::from(luma[y * width + x]);
    let (x, y) = (pixel % width, pixel / width);
    let columns = [x.saturating_sub(1), x, (x + 1).min(width - 1)];
    let rows = [y.saturating_sub(1), y, (y + 1).min(height - 1)];
    let sum: i32 = rows.iter().flat_map(|&y| columns.map(|x| at(x, y))).sum();
    (9 * at(x, y) - sum).clamp(0, 255) as u8
}

/// The weight that one unit of edge strength adds to a pixel, such that the mean edge strength adds `weight`. `sum`
/// is the sum of edge strengths over all `pixels`.
pub(super) fn edge_factor(weight: f32, sum: u64, pixels: usize) -> f32 {
    if sum == 0 { 0.0 } else { (f64::from(weight) * pixels as f64 / sum as f64) as f32 }
}

/// The weights that [`ErrorScore::edge`] gives to all pixels. Shape: `[height, width]`.
#[cfg_attr(not(feature = "gpu"), expect(dead_code, reason = "used by the GPU backend only"))]
pub(super) fn edge_weights(target: &Image8, background: [f32; 3], score: &ErrorScore) -> Vec<f32> {
    let edges = edges(target, background);
    let sum = edges.iter().map(|&edge| u64::from(edge)).sum();
    let factor = edge_factor(score.edge, sum, edges.len());
    edges.iter().map(|&edge| 1.0 + factor * f32::from(edge)).collect()
}

/// Maps values linearly to 0..1 by their minimum and maximum; to 0 if they are all equal.
fn stretch(values: &mut [f32]) {
    let range = values
        .iter()
        .fold((f32::INFINITY, f32::NEG_INFINITY), |(low, high), &x| (low.min(x), high.max(x)));
    let (low, width) = (range.0, range.1 - range.0);
    for x in values {
        *x = if width > 0.0 { (*x - low) / width } else { 0.0 };
    }
}

#[cfg(test)]
#[expect(clippy::float_cmp, reason = "results are exact")]
mod tests {
    use super::*;

    #[test]
    fn values_are_stretched_to_the_range_0_to_1() {
        let mut values = [3.0, 1.0, 2.0];
        stretch(&mut values);
        assert_eq!(values, [1.0, 0.0, 0.5]);
        let mut flat = [4.0; 3];
        stretch(&mut flat);
        assert_eq!(flat, [0.0; 3]);
    }
}
