//! LDR-FLIP: the visible difference when alternating between two images (Andersson, Nilsson,
//! Akenine-Möller, Oskarsson, Åström and Fairchild, *FLIP: A Difference Evaluator for Alternating
//! Images*, Proc. ACM Comput. Graph. Interact. Tech. 3(2), 2020; section and equation numbers here
//! are those of this paper). A colour pipeline filters both images by the contrast sensitivity of the eye and
//! measures a perceptual distance. A feature pipeline compares edges and points, and amplifies the
//! distance where they differ.

use std::f64::consts::PI;

use super::{BLOCK, MetricError, Pair, by_blocks, total};
use densify_core::image::Image8;

/// Pixels per degree of the visual field for a monitor 0.7 m wide with 3840 px, seen from 0.7 m; the
/// default of the paper and of published figures.
const PIXELS_PER_DEGREE: f64 = 3840.0 * PI / 180.0;
/// Terms (a, b) of the contrast sensitivity of each opponent channel, Σ a·√(π/b)·exp(−π²·x²/b) with x in
/// degrees. Table 1.
const SENSITIVITY: [[(f64, f64); 2]; 3] =
    [[(1.0, 0.0047), (0.0, 1e-5)], [(1.0, 0.0053), (0.0, 1e-5)], [(34.1, 0.04), (13.5, 0.025)]];
/// The b of the widest term of [`SENSITIVITY`], which determines the radius of all kernels.
const WIDEST: f64 = 0.04;
/// Exponent of colour distances, q_c.
const COLOUR_EXPONENT: f64 = 0.7;
/// Distances below this fraction of the largest distance count as small, p_c.
const SMALL_SHARE: f64 = 0.4;
/// Fraction of the error range `[0, 1]` to which the small distances are mapped, p_t.
const SMALL_RANGE: f64 = 0.95;
/// Width of a feature `[degrees]`, w.
const FEATURE_WIDTH: f64 = 0.082;
/// Exponent of feature differences, q_f.
const FEATURE_EXPONENT: f64 = 0.5;

/// Linear sRGB to CIE XYZ, D65.
const XYZ_FROM_RGB: [[f64; 3]; 3] = [
    [0.412_390_799_265_959_5, 0.357_584_339_383_878, 0.180_480_788_401_834_3],
    [0.212_639_005_871_510_4, 0.715_168_678_767_756, 0.072_192_315_360_733_71],
    [0.019_330_818_715_591_85, 0.119_194_779_794_626, 0.950_532_152_249_660_6],
];
/// Inverse of [`XYZ_FROM_RGB`].
const RGB_FROM_XYZ: [[f64; 3]; 3] = [
    [3.240_969_941_904_521_5, -1.537_383_177_570_093_5, -0.498_610_760_293_003_3],
    [-0.969_243_636_280_879_8, 1.875_967_501_507_720_6, 0.041_555_057_407_175_6],
    [0.055_630_079_696_993_6, -0.203_976_958_888_976_5, 1.056_971_514_242_878_6],
];

/// Mean FLIP error of a render against a target, in `[0, 1]`; 0 when they are equal.
///
/// `rendered`: shape `[height, width, 3]`, clamped to `[0, 1]` here. Targets with coverage are composited on
/// `background`, in `[0, 1]`. The outermost pixels are repeated beyond the border. NaN if the render contains a NaN.
///
/// # Errors
/// When the sizes differ or the target's mask ignores every pixel.
pub fn flip(rendered: &[f32], target: &Image8, background: [f32; 3]) -> Result<f64, MetricError> {
    let pair = Pair::new(rendered, target, background)?;
    // One sum per block of rows, added in order: the same bits at any thread count.
    let sums = differences(&pair, |pixels| {
        pixels.fold([0.0; 2], |sum, (p, difference)| {
            let weight = pair.weight(p);
            if weight > 0.0 { [sum[0] + weight * difference, sum[1] + weight] } else { sum }
        })
    });
    let [error, weight] = total(&sums)?;
    Ok(error / weight)
}

/// The FLIP error of each pixel, in `[0, 1]`; 0 where the mask ignores it. Shape: `[height, width]`.
///
/// # Errors
/// When the sizes differ.
pub fn flip_map(
    rendered: &[f32],
    target: &Image8,
    background: [f32; 3],
) -> Result<Vec<f64>, MetricError> {
    let pair = Pair::new(rendered, target, background)?;
    let blocks =
        differences(&pair, |pixels| pixels.map(|(_, difference)| difference).collect::<Vec<f64>>());
    Ok(blocks.concat())
}

/// Applies `block_result` to the pixels of each block of rows and their errors; returns the results in order. The error
/// of masked pixels is 0.
fn differences<T: Send>(
    pair: &Pair<'_>,
    block_result: impl Fn(&mut dyn Iterator<Item = (usize, f64)>) -> T + Sync,
) -> Vec<T> {
    let filters = Filters::new();
    let largest = largest_distance();
    by_blocks(pair.height, |rows| {
        let pixels = rows.start * pair.width..rows.end * pair.width;
        let [truth, render] =
            [false, true].map(|r| responses(pair, &filters, rows.start, rows.end, r));
        let both = pixels.zip(truth.iter().zip(&render));
        let error =
            |(p, (a, b))| (p, if pair.weight(p) > 0.0 { difference(a, b, largest) } else { 0.0 });
        block_result(&mut both.map(error))
    })
}

/// Peak memory for a block of rows of this width `[bytes]`: eight `f64` planes that include the rows within the
/// kernels' radius, seven of the block's own rows, and the [responses](PixelResponse) to both images.
pub(super) fn bytes_per_block(width: u64) -> u64 {
    let (rows, lines) = (BLOCK as u64, (BLOCK + 2 * Filters::new().radius()) as u64);
    let float = size_of::<f64>() as u64;
    width * (8 * lines * float + rows * (7 * float + 2 * size_of::<PixelResponse>() as u64))
}

/// The perceptual response to a pixel.
struct PixelResponse {
    /// Lightness and Hunt-adjusted chroma of the filtered image.
    colour: [f64; 3],
    /// Strengths of the edge and of the point at the pixel.
    features: [f64; 2],
}

/// Equation 11: the colour difference, amplified by the difference of features.
fn difference(a: &PixelResponse, b: &PixelResponse, largest: f64) -> f64 {
    let colour = redistributed(hyab(a.colour, b.colour).powf(COLOUR_EXPONENT), largest);
    let [edge, point] = [0, 1].map(|i| (a.features[i] - b.features[i]).abs());
    // `max` would lose a NaN.
    let feature = if point > edge { point } else { edge };
    let feature = (feature / 2.0_f64.sqrt()).powf(FEATURE_EXPONENT);
    colour.powf(1.0 - feature)
}

/// Section 4.1.4: compresses the few large distances.
fn redistributed(distance: f64, largest: f64) -> f64 {
    let bend = SMALL_SHARE * largest;
    if distance < bend {
        SMALL_RANGE / bend * distance
    } else {
        SMALL_RANGE + (distance - bend) / (largest - bend) * (1.0 - SMALL_RANGE)
    }
}

/// The largest distance, c_max: between pure green and pure blue.
fn largest_distance() -> f64 {
    let [green, blue] = [[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]].map(hunt_adjusted_lab);
    hyab(green, blue).powf(COLOUR_EXPONENT)
}

/// Equation 6: the HyAB distance between two colours.
fn hyab(a: [f64; 3], b: [f64; 3]) -> f64 {
    (a[0] - b[0]).abs() + (a[1] - b[1]).hypot(a[2] - b[2])
}

fn product(matrix: &[[f64; 3]; 3], v: [f64; 3]) -> [f64; 3] {
    matrix.map(|row| row[0] * v[0] + row[1] * v[1] + row[2] * v[2])
}

/// XYZ relative to that of white, whose components are the sums of the matrix's rows.
fn relative_xyz(rgb: [f64; 3]) -> [f64; 3] {
    let xyz = product(&XYZ_FROM_RGB, rgb);
    [0, 1, 2].map(|i| xyz[i] / XYZ_FROM_RGB[i].iter().sum::<f64>())
}

/// CIELAB without the cube root, so that filtering is linear: (Y, Cx, Cz).
fn opponents(rgb: [f64; 3]) -> [f64; 3] {
    let [x, y, z] = relative_xyz(rgb);
    [116.0 * y - 16.0, 500.0 * (x - y), 200.0 * (y - z)]
}

/// Inverse of [`opponents`].
fn rgb_from_opponents([luminance, cx, cz]: [f64; 3]) -> [f64; 3] {
    let y = (luminance + 16.0) / 116.0;
    let relative = [y + cx / 500.0, y, y - cz / 200.0];
    let white = XYZ_FROM_RGB.map(|row| row.iter().sum::<f64>());
    product(&RGB_FROM_XYZ, [0, 1, 2].map(|i| relative[i] * white[i]))
}

/// CIELAB of a linear colour, chroma scaled with lightness (equation 5).
fn hunt_adjusted_lab(rgb: [f64; 3]) -> [f64; 3] {
    const DELTA: f64 = 6.0 / 29.0;
    let [x, y, z] = relative_xyz(rgb)
        .map(|t| if t > DELTA.powi(3) { t.cbrt() } else { t / (3.0 * DELTA * DELTA) + 4.0 / 29.0 });
    let lightness = 116.0 * y - 16.0;
    [lightness, 0.01 * lightness * 500.0 * (x - y), 0.01 * lightness * 200.0 * (y - z)]
}

fn linear(encoded: f64) -> f64 {
    if encoded <= 0.040_45 { encoded / 12.92 } else { ((encoded + 0.055) / 1.055).powf(2.4) }
}

/// The one-dimensional kernels of both pipelines. Every filter is a sum of separable filters.
struct Filters {
    /// One kernel per term of each opponent channel; applied along both axes, it has the weight of the term.
    sensitivity: [Vec<Vec<f64>>; 3],
    /// A Gaussian as wide as features, with sum 1, and its first and second derivatives, whose positive taps sum to 1
    /// and negative taps to −1.
    feature: [Vec<f64>; 3],
}

impl Filters {
    fn new() -> Self {
        let radius = (3.0 * (WIDEST / (2.0 * PI * PI)).sqrt() * PIXELS_PER_DEGREE).ceil();
        let sensitivity = SENSITIVITY.map(|terms| {
            let kernels = terms.map(|(a, b)| {
                let shape = sampled(radius, |x| (-(PI * x / PIXELS_PER_DEGREE).powi(2) / b).exp());
                let sum: f64 = shape.iter().sum();
                (a * (PI / b).sqrt() * sum * sum, shape.into_iter().map(move |k| k / sum))
            });
            let total: f64 = kernels.iter().map(|(weight, _)| weight).sum();
            let kernels = kernels.into_iter().filter(|(weight, _)| *weight > 0.0);
            kernels
                .map(|(weight, shape)| shape.map(|k| k * (weight / total).sqrt()).collect())
                .collect()
        });
        let deviation = 0.5 * FEATURE_WIDTH * PIXELS_PER_DEGREE;
        let radius = (3.0 * deviation).ceil();
        let gaussian = |x: f64| (-0.5 * (x / deviation).powi(2)).exp();
        let smooth = sampled(radius, gaussian);
        let sum: f64 = smooth.iter().sum();
        let feature = [
            smooth.into_iter().map(|k| k / sum).collect(),
            balanced(sampled(radius, |x| -x * gaussian(x))),
            balanced(sampled(radius, |x| ((x / deviation).powi(2) - 1.0) * gaussian(x))),
        ];
        Self { sensitivity, feature }
    }

    /// Radius of the widest kernel `[px]`.
    fn radius(&self) -> usize {
        self.sensitivity[0][0].len() / 2
    }
}

/// The values of a function at −radius, …, radius.
fn sampled(radius: f64, function: impl Fn(f64) -> f64) -> Vec<f64> {
    let radius = radius as i32;
    (-radius..=radius).map(|x| function(f64::from(x))).collect()
}

/// Scales positive taps to sum 1 and negative ones to sum −1.
fn balanced(kernel: Vec<f64>) -> Vec<f64> {
    let positive: f64 = kernel.iter().filter(|k| **k > 0.0).sum();
    let negative: f64 = kernel.iter().filter(|k| **k < 0.0).sum();
    kernel.into_iter().map(|k| if k > 0.0 { k / positive } else { k / -negative }).collect()
}

/// The responses to rows `first..last` of the render, or of the target.
fn responses(
    pair: &Pair<'_>,
    filters: &Filters,
    first: usize,
    last: usize,
    render: bool,
) -> Vec<PixelResponse> {
    let width = pair.width;
    let radius = filters.radius();
    // The rows within the kernels' radius; the outermost row is repeated beyond the border.
    let mut planes = [const { Vec::new() }; 3];
    for line in first..last + 2 * radius {
        let y = line.saturating_sub(radius).min(pair.height - 1);
        for p in y * width..(y + 1) * width {
            let channels = opponents([0, 1, 2].map(|c| linear(value(pair, p, c, render))));
            for (plane, channel) in planes.iter_mut().zip(channels) {
                plane.push(channel);
            }
        }
    }
    let rows = last - first;
    let filtered = [0, 1, 2].map(|c| {
        let mut sum = vec![0.0; rows * width];
        for kernel in &filters.sensitivity[c] {
            add_down(&mut sum, &across(&planes[c], width, kernel), width, kernel, radius);
        }
        sum
    });
    // Luminance in [0, 1]; derivatives ignore an offset.
    let luminance: Vec<f64> = planes[0].iter().map(|y| (y + 16.0) / 116.0).collect();
    let [smooth, first_derivative, second_derivative] = &filters.feature;
    let along = filters.feature.each_ref().map(|kernel| across(&luminance, width, kernel));
    let derivative = |x: usize, kernel: &[f64]| {
        let mut sum = vec![0.0; rows * width];
        add_down(&mut sum, &along[x], width, kernel, radius);
        sum
    };
    let edges = [derivative(1, smooth), derivative(0, first_derivative)];
    let points = [derivative(2, smooth), derivative(0, second_derivative)];
    let response = |i: usize| {
        let rgb = rgb_from_opponents([0, 1, 2].map(|c| filtered[c][i]));
        PixelResponse {
            colour: hunt_adjusted_lab(rgb.map(|v| v.clamp(0.0, 1.0))),
            features: [&edges, &points].map(|[x, y]| x[i].hypot(y[i])),
        }
    };
    (0..rows * width).map(response).collect()
}

/// Channel `c` of pixel `p`, sRGB-encoded. Masked pixels of the render have the value of the target.
fn value(pair: &Pair<'_>, p: usize, c: usize, render: bool) -> f64 {
    let truth = pair.truth(p, c);
    let weight = pair.weight(p);
    // An ignored pixel may be NaN.
    if render && weight > 0.0 { truth + weight * pair.error(p, c) } else { truth }
}

/// Filters along the rows.
fn across(plane: &[f64], width: usize, kernel: &[f64]) -> Vec<f64> {
    let radius = kernel.len() / 2;
    let mut out = vec![0.0; plane.len()];
    let mut padded = vec![0.0; width + 2 * radius];
    for (row, out) in plane.chunks_exact(width).zip(out.chunks_exact_mut(width)) {
        padded[..radius].fill(row[0]);
        padded[radius..radius + width].copy_from_slice(row);
        padded[radius + width..].fill(row[width - 1]);
        for (i, k) in kernel.iter().enumerate() {
            for (sum, value) in out.iter_mut().zip(&padded[i..]) {
                *sum += k * value;
            }
        }
    }
    out
}

/// Filters along the columns and adds the result; `plane` has `radius` more rows above and below.
fn add_down(sum: &mut [f64], plane: &[f64], width: usize, kernel: &[f64], radius: usize) {
    let skipped = radius - kernel.len() / 2;
    for (y, sum) in sum.chunks_exact_mut(width).enumerate() {
        for (i, k) in kernel.iter().enumerate() {
            let row = &plane[(y + skipped + i) * width..][..width];
            for (sum, value) in sum.iter_mut().zip(row) {
                *sum += k * value;
            }
        }
    }
}

#[cfg(test)]
mod tests;
