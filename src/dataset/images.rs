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
