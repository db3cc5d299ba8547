//! Images on demand: decoded by prefetch threads, held packed in a cache of bounded bytes.

use std::path::PathBuf;
use std::sync::Arc;

/// Where a view's pixels come from and what is done to them on load.
#[derive(Debug, Clone)]
pub struct ImageSource {
    /// The image file.
    pub path: PathBuf,
}

/// A decoded image, packed 8 bits per channel.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Image8 {
    /// Width [px].
    pub width: u32,
    /// Height [px].
    pub height: u32,
    /// sRGB-encoded, row-major, RGB interleaved. Shape: [height, width, 3].
    pub rgb: Vec<u8>,
    /// Coverage for compositing on the background (straight alpha), if the file has any.
    /// Shape: [height, width].
    pub alpha: Option<Vec<u8>>,
    /// Weight of each pixel in the loss: 0 = ignored, 255 = counted, if there is a mask.
    /// Shape: [height, width].
    pub mask: Option<Vec<u8>>,
}

/// A decoded image shared between cache and user.
pub type SharedImage = Arc<Image8>;

impl Image8 {
    /// The pixel's colour over `background`, in [0, 1].
    #[must_use]
    pub fn composited(&self, x: usize, y: usize, background: [f32; 3]) -> [f32; 3] {
        let pixel = y * self.width as usize + x;
        let alpha = self
            .alpha
            .as_ref()
            .map_or(1.0, |a| f32::from(a[pixel]) / 255.0);
        std::array::from_fn(|channel| {
            alpha * f32::from(self.rgb[3 * pixel + channel]) / 255.0
                + (1.0 - alpha) * background[channel]
        })
    }
}
