//! Loads photographs: undistorts them and shrinks them to the training resolution.

use std::path::PathBuf;
use std::sync::Arc;

use image::DynamicImage;
use image::metadata::Orientation;

use super::LoadError;
use super::depth::DepthSource;
pub use super::image_cache::{ImageCache, ImageDemand, Loaded};
use super::image_file;
pub(super) use super::image_file::{decode, decode_checked, read_colours, read_header};
pub use super::mask::{Hides, Mask};
use super::options::MaskMode;
pub use super::source_file::SourceFile;
use super::undistort::Undistortion;
use densify_core::image::Window;
use densify_core::image::depth::SharedDepth;
use densify_core::image::resample;
pub use densify_core::image::{Image8, SharedImage};

/// Size of a pixel of a [depth map](densify_core::image::depth::DepthMap) `[bytes]`.
const DEPTH_BYTES: u64 = 3;

/// The source of a view's pixels and their processing on load.
#[derive(Debug, Clone)]
pub struct ImageSource {
    /// The image file.
    pub file: SourceFile,
    /// Mask of the photograph, if there is one.
    pub mask: Option<Mask>,
    /// Width after loading, before cropping to the window `[px]`.
    pub width: u32,
    /// Height after loading, before cropping to the window `[px]`.
    pub height: u32,
    /// Resampling of the whole image to a pinhole camera, if the lens is distorted.
    pub undistortion: Option<Undistortion>,
    /// Header of the image file.
    pub header: ImageHeader,
    /// Pixels in memory, at the size of the header, instead of a file.
    pub rendered: Option<SharedImage>,
    /// The part of the loaded image that is used; `None`: the whole image.
    pub window: Option<Window>,
    /// The depth of the view, if it is used.
    pub depth: Option<Box<DepthSource>>,
}

/// The header of an image file. Its `Debug` text is part of the fingerprint in checkpoints.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ImageHeader {
    /// Width `[px]`.
    pub width: u32,
    /// Height `[px]`.
    pub height: u32,
    /// True if there is an alpha channel.
    pub has_alpha: bool,
    /// Rotation applied before anything else; `width` and `height` are those of the rotated image.
    pub turn: Option<Orientation>,
    /// Size after decoding `[bytes]`.
    pub decoded_bytes: u64,
    /// Size of the file `[bytes]`.
    pub file_bytes: u64,
}

impl ImageSource {
    /// An image file without further processing.
    #[cfg(test)]
    pub(super) fn whole(path: PathBuf) -> Self {
        let header = read_header(&path).expect("an image");
        let (width, height) = (header.width, header.height);
        let (mask, undistortion, rendered) = (None, None, None);
        let file = SourceFile::existing(path).expect("an image");
        Self {
            file,
            mask,
            width,
            height,
            undistortion,
            header,
            rendered,
            window: None,
            depth: None,
        }
    }

    /// Pixels in memory, which are shrunk to this size on load. Messages call them `name`.
    pub(crate) fn rendered(name: PathBuf, image: Image8, (width, height): (u32, u32)) -> Self {
        let header = ImageHeader {
            width: image.width,
            height: image.height,
            has_alpha: image.alpha.is_some(),
            turn: None,
            decoded_bytes: image.bytes(),
            file_bytes: 0,
        };
        let (file, rendered) = (SourceFile::rendered(name), Some(Arc::new(image)));
        let (mask, undistortion, window, depth) = (None, None, None, None);
        Self { file, mask, width, height, undistortion, header, rendered, window, depth }
    }

    /// Largest size of the loaded image, with its depth `[bytes]`.
    pub(crate) fn loaded_bytes(&self) -> u64 {
        let depth = if self.depth.is_some() { DEPTH_BYTES } else { 0 };
        self.pixels() * (self.channels() + depth)
    }

    /// Number of pixels of the loaded image.
    fn pixels(&self) -> u64 {
        let [width, height] = match self.window {
            Some(window) => [window.width, window.height],
            None => [self.width, self.height],
        };
        u64::from(width) * u64::from(height)
    }

    /// Peak memory while loading, including the result `[bytes]`.
    pub(super) fn working_bytes(&self) -> u64 {
        let bytes = |(width, height)| u64::from(width) * u64::from(height) * self.channels();
        let packed = bytes((self.header.width, self.header.height));
        let decode = self.header.file_bytes + self.header.decoded_bytes;
        let pack = self.header.decoded_bytes + packed;
        let whole = bytes(self.whole_size());
        let undistort = if self.undistortion.is_some() { packed + whole } else { packed };
        let shrunk = bytes((self.width, self.height));
        let shrink = if self.shrinks() { whole + shrunk } else { whole };
        let loaded = self.pixels() * self.channels();
        let cut = if self.window.is_some() { shrunk + loaded } else { 0 };
        let turn = if self.header.turn.is_some() { 2 * self.header.decoded_bytes } else { 0 };
        let depth =
            self.depth.as_ref().map_or(0, |depth| loaded + depth.working_bytes(self.pixels()));
        decode.max(turn).max(pack).max(undistort).max(shrink).max(cut).max(depth)
    }

    fn channels(&self) -> u64 {
        3 + u64::from(self.may_be_transparent()) + u64::from(self.is_masked())
    }

    /// Returns true if the loaded image may have transparent pixels.
    pub(crate) fn may_be_transparent(&self) -> bool {
        self.header.has_alpha || self.mask_becomes_transparency()
    }

    /// Returns true if the loaded image has a mask: from a file, or of the field of view of the lens.
    pub fn is_masked(&self) -> bool {
        let is_ignored = |mask: &Mask| mask.mode == MaskMode::Ignore;
        self.mask.as_ref().is_some_and(is_ignored)
            || self.undistortion.as_ref().is_some_and(|undistortion| undistortion.masked)
    }

    /// Returns true if the mask becomes transparency.
    fn mask_becomes_transparency(&self) -> bool {
        self.mask.as_ref().is_some_and(|mask| mask.mode == MaskMode::Background)
    }

    /// Width and height before shrinking `[px]`.
    pub(super) fn whole_size(&self) -> (u32, u32) {
        match &self.undistortion {
            Some(undistortion) => (undistortion.to.width, undistortion.to.height),
            None => (self.header.width, self.header.height),
        }
    }

    fn shrinks(&self) -> bool {
        (self.width, self.height) != self.whole_size()
    }

    /// Decodes, undistorts, shrinks and crops the image. The result has alpha only if a pixel is transparent.
    ///
    /// # Errors
    /// When a file is missing, unreadable or over the limits, or its size is no longer that in the header.
    pub fn load(&self) -> Result<Image8, LoadError> {
        let image = self.load_whole()?;
        Ok(match self.window {
            Some(window) => image.windowed(window),
            None => image,
        })
    }

    /// The depth at the pixels of the loaded image; `None` if there is none, or none is known.
    ///
    /// # Errors
    /// As [`load`](Self::load).
    pub fn load_depth(&self) -> Result<Option<SharedDepth>, LoadError> {
        self.depth.as_ref().map_or(Ok(None), |depth| depth.load(self))
    }

    fn load_whole(&self) -> Result<Image8, LoadError> {
        let header = self.header;
        if let Some(image) = &self.rendered {
            return Ok(if self.shrinks() {
                resample::shrink(image, self.width, self.height)
            } else {
                Image8::clone(image)
            });
        }
        let mut decoded = image_file::decode_photograph(&self.file)?;
        if let Some(turn) = header.turn {
            decoded.apply_orientation(turn);
        }
        if (decoded.width(), decoded.height()) != (header.width, header.height) {
            let size = (decoded.width(), decoded.height());
            return Err(LoadError::size(&self.file.path, size, (header.width, header.height)));
        }
        let mut image = pack(decoded);
        if let Some(mask) = &self.mask {
            mask.apply(&mut image)?;
        }
        if let Some(undistortion) = &self.undistortion {
            image = undistortion.apply(&image);
        }
        if self.shrinks() {
            image = resample::shrink(&image, self.width, self.height);
        }
        Ok(image)
    }
}

/// Converts an image to 8 bits per channel, without a copy if it is 8-bit RGB already.
fn pack(decoded: DynamicImage) -> Image8 {
    let (width, height) = (decoded.width(), decoded.height());
    if !decoded.color().has_alpha() {
        return Image8 {
            width,
            height,
            rgb: decoded.into_rgb8().into_raw(),
            alpha: None,
            mask: None,
        };
    }
    let rgba = decoded.into_rgba8();
    let pixels = width as usize * height as usize;
    let mut rgb = Vec::with_capacity(3 * pixels);
    let mut alpha = Vec::with_capacity(pixels);
    for pixel in rgba.as_raw().chunks_exact(4) {
        rgb.extend_from_slice(&pixel[..3]);
        alpha.push(pixel[3]);
    }
    let opaque = alpha.iter().all(|&a| a == 255);
    Image8 { width, height, rgb, alpha: (!opaque).then_some(alpha), mask: None }
}

#[cfg(test)]
mod tests {
    use image::{ImageBuffer, RgbImage};

    use super::*;

    #[test]
    fn every_colour_type_packs_to_eight_bits() {
        let folder = tempfile::tempdir().unwrap();
        let rgba = |alpha| ImageBuffer::from_pixel(3, 2, image::Rgba([1_u8, 2, 3, alpha]));
        let deep = ImageBuffer::from_pixel(3, 2, image::Rgb([257_u16, 65535, 0]));
        let cases: [(&str, DynamicImage, [u8; 3], Option<u8>); 5] = [
            ("l8.png", ImageBuffer::from_pixel(3, 2, image::Luma([7_u8])).into(), [7; 3], None),
            ("rgb16.png", deep.into(), [1, 255, 0], None),
            ("rgba.png", rgba(4).into(), [1, 2, 3], Some(4)),
            ("opaque.png", rgba(255).into(), [1, 2, 3], None),
            ("rgb.webp", RgbImage::from_pixel(3, 2, [9, 8, 7].into()).into(), [9, 8, 7], None),
        ];
        for (name, image, rgb, alpha) in cases {
            let path = folder.path().join(name);
            image.save(&path).unwrap();
            let loaded = ImageSource::whole(path).load().unwrap();
            assert_eq!((loaded.width, loaded.height), (3, 2), "{name}");
            assert_eq!(loaded.rgb, rgb.repeat(6), "{name}");
            assert_eq!(loaded.alpha, alpha.map(|a| vec![a; 6]), "{name}");
        }
    }

    #[cfg(unix)]
    #[test]
    fn a_photograph_that_becomes_a_link_is_not_followed() {
        let folder = tempfile::tempdir().unwrap();
        let [path, other] = ["a.png", "b.png"].map(|name| folder.path().join(name));
        RgbImage::from_pixel(4, 4, [10, 20, 30].into()).save(&path).unwrap();
        std::fs::copy(&path, &other).unwrap();
        let source = ImageSource::whole(path.clone());
        source.load().unwrap();
        std::fs::remove_file(&path).unwrap();
        std::os::unix::fs::symlink(&other, &path).unwrap();
        let message = source.load().unwrap_err().to_string();
        assert!(message.contains("a.png") && message.contains("link"), "{message}");
    }

    #[test]
    fn broken_and_oversized_files_are_errors_that_name_them() {
        let folder = tempfile::tempdir().unwrap();
        let good = folder.path().join("good.png");
        RgbImage::from_fn(64, 64, |x, y| [x as u8, y as u8, (x * y) as u8].into())
            .save(&good)
            .unwrap();
        let bytes = std::fs::read(&good).unwrap();
        let cut = folder.path().join("cut.png");
        std::fs::write(&cut, &bytes[..bytes.len() / 2]).unwrap();
        let message = ImageSource::whole(cut).load().unwrap_err().to_string();
        assert!(message.contains("cut.png"), "{message}");
        // A header that promises 100,000 x 100,000 px.
        let mut huge = bytes.clone();
        huge[16..24].copy_from_slice(&[0, 1, 0x86, 0xa0, 0, 1, 0x86, 0xa0]);
        let mut sum = flate2::Crc::new();
        sum.update(&huge[12..29]);
        huge[29..33].copy_from_slice(&sum.sum().to_be_bytes());
        for (name, contents) in
            [("huge.png", huge), ("text.jpg", b"not an image".to_vec()), ("empty.png", vec![])]
        {
            let path = folder.path().join(name);
            std::fs::write(&path, contents).unwrap();
            let message = read_header(&path).unwrap_err().to_string();
            assert!(message.contains(name), "{message}");
        }
        let message = read_header(&folder.path().join("none.png")).unwrap_err().to_string();
        assert!(message.contains("cannot read"), "{message}");
    }
}
