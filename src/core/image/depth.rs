//! Depth given beside a photograph: by a sensor, a reconstruction, a point cloud or a renderer.

use std::sync::Arc;

/// The given depth of a view, as inverse depth with a confidence per pixel: 3 bytes per pixel.
#[derive(Debug, Clone, PartialEq)]
pub struct DepthMap {
    /// Width `[px]`.
    pub width: u32,
    /// Height `[px]`.
    pub height: u32,
    /// Inverse camera-space depth 1/z in multiples of `unit`; 0 where it is unknown. Shape: `[height, width]`.
    pub inverse: Vec<u16>,
    /// Weight of each pixel in the loss: 0 ignores it, 255 counts it in full; 0 where the depth is unknown.
    /// Shape: `[height, width]`.
    pub confidence: Vec<u8>,
    /// Inverse depth of one step of `inverse` `[1/scene units]`.
    pub unit: f32,
    /// Median depth of the known pixels, which makes the loss independent of the scene's unit `[scene units]`.
    pub median: f32,
}

/// A depth map shared between a cache and its users.
pub type SharedDepth = Arc<DepthMap>;

impl DepthMap {
    /// The inverse depth of a pixel `[1/scene units]` with its confidence in `[0, 1]`; 0 and 0 where it is unknown.
    pub fn inverse_depth(&self, pixel: usize) -> [f32; 2] {
        let confidence = if self.inverse[pixel] == 0 { 0 } else { self.confidence[pixel] };
        [f32::from(self.inverse[pixel]) * self.unit, f32::from(confidence) / 255.0]
    }

    /// The depth of a pixel `[scene units]`; `None` where it is unknown or does not count.
    pub fn known_depth(&self, pixel: usize) -> Option<f32> {
        let [inverse, confidence] = self.inverse_depth(pixel);
        (confidence > 0.0).then(|| 1.0 / inverse)
    }

    /// A map from inverse depths `[1/scene units]`, where values that are not positive and finite are unknown, and
    /// confidences. `None` if no depth is known. Depths below a 64th of the median count as unknown, so that a stray
    /// near value does not make all others coarse: one step of `inverse` is then at most 0.1 % of the median depth.
    ///
    /// # Panics
    /// When the lengths differ from `width · height`: a bug in the caller.
    pub fn quantised(
        (width, height): (u32, u32),
        inverse: &[f32],
        mut confidence: Vec<u8>,
    ) -> Option<Self> {
        const NEAREST: f32 = 64.0;
        let pixels = width as usize * height as usize;
        assert_eq!([inverse.len(), confidence.len()], [pixels; 2], "one value for each pixel");
        let is_known = |x: f32| x > 0.0 && x.is_finite();
        let mut known: Vec<f32> = inverse.iter().copied().filter(|&x| is_known(x)).collect();
        if known.is_empty() {
            return None;
        }
        let middle = known.len() / 2;
        let median = *known.select_nth_unstable_by(middle, f32::total_cmp).1;
        let largest = known.into_iter().fold(0.0, f32::max).min(NEAREST * median);
        let unit = largest / f32::from(u16::MAX);
        if !unit.is_normal() {
            return None;
        }
        let mut steps = Vec::with_capacity(pixels);
        for (&x, confidence) in inverse.iter().zip(&mut confidence) {
            // The cast saturates; values that are too near were excluded above, up to rounding.
            let is_kept = is_known(x) && x <= largest;
            let step = if is_kept { ((x / unit + 0.5) as u16).max(1) } else { 0 };
            *confidence = if step == 0 { 0 } else { *confidence };
            steps.push(step);
        }
        Some(Self { width, height, inverse: steps, confidence, unit, median: 1.0 / median })
    }

    /// A smaller copy: each pixel takes the known pixel that is nearest to its centre, among those that it covers.
    ///
    /// # Panics
    /// When a side is 0 or larger than that of the map: a bug in the caller.
    pub fn shrunk(&self, width: u32, height: u32) -> Self {
        let fits = |to: u32, from: u32| to > 0 && to <= from;
        assert!(fits(width, self.width) && fits(height, self.height), "not smaller");
        let scale =
            [f64::from(self.width) / f64::from(width), f64::from(self.height) / f64::from(height)];
        let pixels = width as usize * height as usize;
        let (mut inverse, mut confidence) =
            (Vec::with_capacity(pixels), Vec::with_capacity(pixels));
        for y in 0..height {
            for x in 0..width {
                let at = [(f64::from(x) + 0.5) * scale[0], (f64::from(y) + 0.5) * scale[1]];
                let half = scale.map(|scale| 0.5 * scale);
                let size = (self.width, self.height);
                let found = nearest_valid(size, at, half, |pixel| self.inverse[pixel] > 0);
                inverse.push(found.map_or(0, |pixel| self.inverse[pixel]));
                confidence.push(found.map_or(0, |pixel| self.confidence[pixel]));
            }
        }
        Self { width, height, inverse, confidence, ..*self }
    }

    /// Size of the pixels `[bytes]`.
    pub fn bytes(&self) -> u64 {
        (2 * self.inverse.len() + self.confidence.len()) as u64
    }
}

/// The index of the valid pixel whose centre is nearest to `at` `[px]`: the pixel that contains `at`, or else one whose
/// centre is within `half` of it along both axes. Of several at the same distance, the first in row-major order counts.
pub fn nearest_valid(
    (width, height): (u32, u32),
    at: [f64; 2],
    half: [f64; 2],
    is_valid: impl Fn(usize) -> bool,
) -> Option<usize> {
    let clamped = |at: f64, side: u32| (at.max(0.0) as u32).min(side - 1);
    let [x, y] = [clamped(at[0], width), clamped(at[1], height)];
    let index = |x: u32, y: u32| y as usize * width as usize + x as usize;
    if is_valid(index(x, y)) {
        return Some(index(x, y));
    }
    if half[0] <= 0.5 && half[1] <= 0.5 {
        return None;
    }
    let span = |at: f64, half: f64, side: u32| {
        // The small addend keeps the centres of pixels on the border of the area, in spite of rounding.
        let [first, last] = [at - half - 0.5 - 1e-6, at + half - 0.5 + 1e-6];
        (first.ceil().max(0.0) as u32, (last.floor().max(-1.0) + 1.0).min(f64::from(side)) as u32)
    };
    let (columns, rows) = (span(at[0], half[0], width), span(at[1], half[1], height));
    let mut best: Option<(f64, usize)> = None;
    for y in rows.0..rows.1 {
        for x in columns.0..columns.1 {
            let [dx, dy] = [f64::from(x) + 0.5 - at[0], f64::from(y) + 0.5 - at[1]];
            let distance = dx * dx + dy * dy;
            if best.is_none_or(|(least, _)| distance < least) && is_valid(index(x, y)) {
                best = Some((distance, index(x, y)));
            }
        }
    }
    best.map(|(_, index)| index)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn depth_survives_quantisation_and_stray_near_values() {
        let depths = [2.0_f32, 4.0, 100.0, 1e-4, 0.0, f32::NAN];
        let inverse: Vec<f32> = depths.iter().map(|z| 1.0 / z).collect();
        let map =
            DepthMap::quantised((3, 2), &inverse, vec![255, 100, 255, 255, 255, 255]).unwrap();
        for (pixel, depth) in depths[..3].iter().enumerate() {
            let [x, confidence] = map.inverse_depth(pixel);
            assert!((x - 1.0 / depth).abs() < 0.51 * map.unit, "{} for {depth}", 1.0 / x);
            assert!(confidence > 0.3);
        }
        // Too near, unknown (infinitely near), and not a number.
        assert_eq!((&map.inverse[3..], &map.confidence[3..]), (&[0; 3][..], &[0; 3][..]));
        assert!(
            (map.median - 4.0).abs() < 1e-6 || (map.median - 2.0).abs() < 1e-6,
            "{}",
            map.median
        );
        assert_eq!(DepthMap::quantised((1, 1), &[0.0], vec![255]), None);
        assert_eq!(map.bytes(), 18);
    }

    #[test]
    fn shrinking_takes_the_nearest_known_pixel_and_never_a_mean() {
        let inverse: Vec<f32> = vec![0.0, 0.0, 1.0, 0.5, 0.25, 0.0, 1.0, 0.5];
        let map = DepthMap::quantised((4, 2), &inverse, vec![255; 8]).unwrap();
        let small = map.shrunk(2, 1);
        let at = |pixel: usize| small.inverse_depth(pixel)[0];
        assert!((at(0) - 0.25).abs() < 1e-4, "the only known pixel of the four: {}", at(0));
        assert!((at(1) - 0.5).abs() < 1e-4, "the pixel that contains the centre: {}", at(1));
        assert_eq!(map.shrunk(4, 2), map);
    }

    #[test]
    fn a_pixel_outside_the_area_is_not_taken() {
        let only = |valid: usize| move |pixel: usize| pixel == valid;
        assert_eq!(nearest_valid((4, 1), [0.5, 0.5], [0.5, 0.5], only(1)), None);
        assert_eq!(nearest_valid((4, 1), [1.0, 0.5], [1.0, 0.5], only(0)), Some(0));
        assert_eq!(nearest_valid((4, 1), [1.0, 0.5], [1.0, 0.5], only(2)), None);
        assert_eq!(nearest_valid((4, 1), [9.0, -3.0], [0.5, 0.5], only(3)), Some(3), "clamped");
    }
}
