//! Images of bytes, as lossless WebP.

use std::io;

use super::lossless;
use image_webp::{ColorType, EncoderParams, WebPEncoder};

/// Largest width and height `[px]`: the largest multiple of four that WebP allows.
pub(super) const MAX_SIDE: usize = 16_380;

/// An image. Shape of `rgba`: `[height, width, 4]`.
pub(super) struct Picture {
    width: usize,
    height: usize,
    rgba: Vec<u8>,
}

/// Width and height `[px]` of an image with `rows` pixels: nearly square, multiples of four.
pub(super) fn image_size(rows: usize) -> (usize, usize) {
    let width = (rows as f64).sqrt().ceil() as usize;
    let width = width.next_multiple_of(4).clamp(4, MAX_SIDE);
    (width, rows.div_ceil(width).next_multiple_of(4))
}

impl Picture {
    /// An image of this size, whose pixels are still to be [filled](Self::fill).
    pub(super) fn new(width: usize, height: usize) -> Self {
        Self { width, height, rgba: Vec::with_capacity(4 * width * height) }
    }

    /// Fills the first `count` pixels; the remaining pixels repeat the last one, which costs almost no bytes.
    pub(super) fn fill(mut self, count: usize, pixel: impl Fn(usize) -> [u8; 4]) -> Self {
        let last = count.saturating_sub(1);
        let pixels = (0..self.width * self.height).flat_map(|at| pixel(at.min(last)));
        self.rgba.extend(pixels);
        self
    }

    /// The smallest of three encodings: by our own encoder, and by `image-webp`, which compresses runs of equal pixels,
    /// with and without prediction from the pixel above.
    pub(super) fn encode(&self) -> io::Result<Vec<u8>> {
        let opaque = self.rgba.as_chunks::<4>().0.iter().all(|pixel| pixel[3] == 255);
        let rgb: Vec<u8>;
        let (bytes, colour) = if opaque {
            let pixels = self.rgba.as_chunks::<4>().0;
            rgb = pixels.iter().flat_map(|pixel| &pixel[..3]).copied().collect();
            (&rgb, ColorType::Rgb8)
        } else {
            (&self.rgba, ColorType::Rgba8)
        };
        let encoded = |predicted: bool| {
            let mut file = Vec::new();
            let mut encoder = WebPEncoder::new(&mut file);
            let mut parameters = EncoderParams::default();
            parameters.use_predictor_transform = predicted;
            encoder.set_params(parameters);
            let done = encoder.encode(bytes, self.width as u32, self.height as u32, colour);
            done.map_err(io::Error::other)?;
            Ok::<_, io::Error>(file)
        };
        let mut best = lossless::encode(&self.rgba, (self.width, self.height));
        for predicted in [true, false] {
            let file = encoded(predicted)?;
            if file.len() < best.len() {
                best = file;
            }
        }
        Ok(best)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pictures_round_trip() {
        for rows in [1, 5, 300] {
            let (width, height) = image_size(rows);
            assert!(width * height >= rows && width % 4 == 0 && height % 4 == 0);
            for alpha in [255, 7] {
                let pixel = |row: usize| [row as u8, (row >> 8) as u8, (row * 31) as u8, alpha];
                let file = Picture::new(width, height).fill(rows, pixel).encode().unwrap();
                let read = image::load_from_memory(&file).unwrap().into_rgba8();
                for (row, found) in read.pixels().take(rows).enumerate() {
                    assert_eq!(found.0, pixel(row), "row {row} of {rows}");
                }
            }
        }
    }
}
