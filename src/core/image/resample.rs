//! The area filter that shrinks images, and means of pixels weighted by coverage.

use super::Image8;

/// A weighted mean of pixels. Colours are also weighted by alpha, because the colour of a
/// transparent pixel must not bleed into its neighbours.
#[derive(Debug, Clone, Copy, Default)]
pub struct PixelMean {
    rgb: [f32; 3],
    alpha: f32,
    mask: f32,
    weight: f32,
    colour_weight: f32,
}

impl PixelMean {
    /// Adds a pixel.
    pub fn add(&mut self, image: &Image8, x: u32, y: u32, weight: f32) {
        let at = y as usize * image.width as usize + x as usize;
        let alpha = image.alpha.as_ref().map_or(255.0, |alpha| f32::from(alpha[at]));
        let colour_weight = weight * alpha;
        for (sum, &value) in self.rgb.iter_mut().zip(&image.rgb[3 * at..3 * at + 3]) {
            *sum += colour_weight * f32::from(value);
        }
        self.alpha += colour_weight;
        self.mask += weight * image.mask.as_ref().map_or(255.0, |mask| f32::from(mask[at]));
        self.weight += weight;
        self.colour_weight += colour_weight;
    }

    /// Appends the mean to all channels of `out`.
    pub fn push_to(self, out: &mut Image8) {
        let quantise = |value: f32| (value + 0.5) as u8;
        // The colour of a transparent pixel is never seen; black makes it reproducible.
        let scale = if self.colour_weight > 0.0 { 1.0 / self.colour_weight } else { 0.0 };
        out.rgb.extend(self.rgb.map(|sum| quantise(sum * scale)));
        if let Some(alpha) = &mut out.alpha {
            alpha.push(quantise(self.alpha / self.weight));
        }
        if let Some(mask) = &mut out.mask {
            mask.push(quantise(self.mask / self.weight));
        }
    }
}

/// Shrinks an image with an area filter: every source pixel is weighted by its overlap with the
/// target pixel.
pub fn shrink(image: &Image8, width: u32, height: u32) -> Image8 {
    let columns = spans(image.width, width);
    let rows = spans(image.height, height);
    let mut out = Image8::blank(width, height, image);
    for row in &rows {
        for column in &columns {
            let mut mean = PixelMean::default();
            for (y, wy) in row.pixels() {
                for (x, wx) in column.pixels() {
                    mean.add(image, x, y, wx * wy);
                }
            }
            mean.push_to(&mut out);
        }
    }
    out
}

/// Resamples one channel with the filter of [`shrink`]. Sizes are (width, height) `[px]`.
pub fn shrink_channel(channel: &[u8], from: (u32, u32), to: (u32, u32)) -> Vec<u8> {
    let columns = spans(from.0, to.0);
    let mut out = Vec::with_capacity(to.0 as usize * to.1 as usize);
    for row in spans(from.1, to.1) {
        for column in &columns {
            let (mut sum, mut weight) = (0.0, 0.0);
            for (y, wy) in row.pixels() {
                for (x, wx) in column.pixels() {
                    sum += wx * wy * f32::from(channel[y as usize * from.0 as usize + x as usize]);
                    weight += wx * wy;
                }
            }
            out.push((sum / weight + 0.5) as u8);
        }
    }
    out
}

/// The source pixels that a target pixel covers, along one axis.
struct Span {
    first: u32,
    last: u32,
    first_weight: f32,
    last_weight: f32,
}

impl Span {
    /// The source pixels with their weights.
    fn pixels(&self) -> impl Iterator<Item = (u32, f32)> + '_ {
        (self.first..=self.last).map(|i| {
            let weight = match i {
                _ if i == self.first => self.first_weight,
                _ if i == self.last => self.last_weight,
                _ => 1.0,
            };
            (i, weight)
        })
    }
}

/// The spans of `to` target pixels along an axis of `from` source pixels.
fn spans(from: u32, to: u32) -> Vec<Span> {
    let scale = f64::from(from) / f64::from(to);
    (0..to)
        .map(|i| {
            let (low, high) =
                (f64::from(i) * scale, (f64::from(i + 1) * scale).min(f64::from(from)));
            let first = (low as u32).min(from - 1);
            let last = ((high.ceil() as u32).max(first + 1) - 1).min(from - 1);
            let first_end = f64::from(first + 1).min(high);
            Span {
                first,
                last,
                first_weight: (first_end - low) as f32,
                last_weight: (high - f64::from(last)) as f32,
            }
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn grey(width: u32, height: u32, values: &[u8]) -> Image8 {
        let rgb = values.iter().flat_map(|&v| [v; 3]).collect();
        Image8 { width, height, rgb, alpha: None, mask: None }
    }

    #[test]
    fn halving_averages_two_by_two_pixels() {
        let out = shrink(&grey(4, 2, &[0, 100, 10, 10, 200, 100, 10, 10]), 2, 1);
        assert_eq!(out, grey(2, 1, &[100, 10]));
    }

    #[test]
    fn partly_covered_pixels_count_in_proportion() {
        let out = shrink(&grey(3, 1, &[30, 60, 240]), 2, 1);
        // Target pixel 0 covers the first source pixel and half of the second: (30 + 30) / 1.5.
        assert_eq!(out, grey(2, 1, &[40, 180]));
        assert_eq!(shrink_channel(&[30, 60, 240], (3, 1), (2, 1)), [40, 180]);
        assert_eq!(shrink_channel(&[7], (1, 1), (3, 2)), [7; 6]);
    }

    #[test]
    fn colours_of_transparent_pixels_do_not_bleed() {
        let image =
            Image8 { alpha: Some(vec![255, 0]), mask: Some(vec![0, 255]), ..grey(2, 1, &[200, 0]) };
        let out = shrink(&image, 1, 1);
        assert_eq!(out.rgb, [200; 3]);
        assert_eq!(out.alpha, Some(vec![128]));
        assert_eq!(out.mask, Some(vec![128]));
    }
}
