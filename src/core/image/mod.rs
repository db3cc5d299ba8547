//! Decoded images with eight bits per channel.

use std::sync::Arc;

pub mod depth;
pub mod resample;

/// A decoded image.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Image8 {
    /// Width `[px]`.
    pub width: u32,
    /// Height `[px]`.
    pub height: u32,
    /// sRGB-encoded, row-major, RGB interleaved. Shape: `[height, width, 3]`.
    pub rgb: Vec<u8>,
    /// Straight (not premultiplied) alpha, if the image has any.
    /// Shape: `[height, width]`.
    pub alpha: Option<Vec<u8>>,
    /// Weight of each pixel in the loss, if there is a mask: 0 ignores it, 255 counts it in full.
    /// Shape: `[height, width]`.
    pub mask: Option<Vec<u8>>,
}

/// A rectangle of pixels in an image.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Window {
    /// First column `[px]`.
    pub x: u32,
    /// First row `[px]`.
    pub y: u32,
    /// Width `[px]`, >= 1.
    pub width: u32,
    /// Height `[px]`, >= 1.
    pub height: u32,
}

/// An image shared between a cache and its users.
pub type SharedImage = Arc<Image8>;

impl Image8 {
    /// A black image.
    pub fn black(width: u32, height: u32) -> Self {
        let rgb = vec![0; 3 * width as usize * height as usize];
        Self { width, height, rgb, alpha: None, mask: None }
    }

    /// Alpha of a pixel, in `[0, 1]`.
    pub fn alpha_at(&self, x: usize, y: usize) -> f32 {
        let pixel = y * self.width as usize + x;
        self.alpha.as_ref().map_or(1.0, |a| f32::from(a[pixel]) / 255.0)
    }

    /// The colour of a pixel over `background`, in `[0, 1]`.
    pub fn composited(&self, x: usize, y: usize, background: [f32; 3]) -> [f32; 3] {
        let pixel = y * self.width as usize + x;
        let alpha = self.alpha_at(x, y);
        std::array::from_fn(|channel| {
            alpha * f32::from(self.rgb[3 * pixel + channel]) / 255.0
                + (1.0 - alpha) * background[channel]
        })
    }

    /// A smaller copy; each pixel is the mean of the pixels that it covers.
    pub fn shrunk(&self, width: u32, height: u32) -> Self {
        resample::shrink(self, width, height)
    }

    /// Size of the pixels `[bytes]`.
    pub fn bytes(&self) -> u64 {
        let length = |channel: &Option<Vec<u8>>| channel.as_ref().map_or(0, Vec::len);
        (self.rgb.len() + length(&self.alpha) + length(&self.mask)) as u64
    }

    /// An image that has the channels of `like` and no pixels yet, but memory reserved for them.
    pub fn blank(width: u32, height: u32, like: &Self) -> Self {
        let pixels = width as usize * height as usize;
        let channel =
            |channel: &Option<Vec<u8>>| channel.as_ref().map(|_| Vec::with_capacity(pixels));
        Self {
            width,
            height,
            rgb: Vec::with_capacity(3 * pixels),
            alpha: channel(&like.alpha),
            mask: channel(&like.mask),
        }
    }

    /// A copy of a window, which must lie within the image.
    pub fn windowed(&self, window: Window) -> Self {
        let cut = |values: &[u8], channels: usize| {
            let row = channels * self.width as usize;
            let (from, count) = (channels * window.x as usize, channels * window.width as usize);
            let rows = values.chunks_exact(row).skip(window.y as usize);
            rows.take(window.height as usize)
                .flat_map(|row| &row[from..from + count])
                .copied()
                .collect()
        };
        let channel = |values: &Option<Vec<u8>>| values.as_ref().map(|values| cut(values, 1));
        Self {
            width: window.width,
            height: window.height,
            rgb: cut(&self.rgb, 3),
            alpha: channel(&self.alpha),
            mask: channel(&self.mask),
        }
    }
}
