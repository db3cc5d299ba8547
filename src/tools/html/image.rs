//! Images embedded in a page as `data:` URIs.

use std::path::Path;

use ::image::codecs::jpeg::JpegEncoder;
use ::image::codecs::webp::WebPEncoder;
use ::image::{ExtendedColorType, ImageResult, RgbImage};

use base64::Engine as _;
use base64::prelude::BASE64_STANDARD;
use densify_run::failure::{Failure, OTHER};

/// An image embedded in a page.
#[derive(Debug, Clone)]
pub struct EmbeddedImage {
    /// The `data:` URI.
    pub uri: String,
    /// Width and height `[px]`.
    pub size: (u32, u32),
}

impl EmbeddedImage {
    /// Encodes as JPEG.
    ///
    /// # Errors
    /// If encoding fails.
    pub fn jpeg(image: &RgbImage, quality: u8) -> Result<Self, Failure> {
        Self::encoded(image, "image/jpeg", |out| {
            let (width, height) = image.dimensions();
            JpegEncoder::new_with_quality(out, quality).encode(
                image.as_raw(),
                width,
                height,
                ExtendedColorType::Rgb8,
            )
        })
    }

    /// Encodes as lossless WebP, for enlarged crops.
    ///
    /// # Errors
    /// If encoding fails.
    pub fn lossless(image: &RgbImage) -> Result<Self, Failure> {
        Self::encoded(image, "image/webp", |out| {
            let (width, height) = image.dimensions();
            WebPEncoder::new_lossless(out).encode(image, width, height, ExtendedColorType::Rgb8)
        })
    }

    fn encoded(
        image: &RgbImage,
        mime_type: &str,
        encode: impl FnOnce(&mut Vec<u8>) -> ImageResult<()>,
    ) -> Result<Self, Failure> {
        let mut bytes = Vec::new();
        encode(&mut bytes).map_err(|error| {
            Failure::new(OTHER, format!("an image of the report cannot be encoded: {error}"))
        })?;
        Ok(Self { uri: data_uri(mime_type, &bytes), size: image.dimensions() })
    }
}

fn data_uri(mime_type: &str, bytes: &[u8]) -> String {
    format!("data:{mime_type};base64,{}", BASE64_STANDARD.encode(bytes))
}

/// The `data:` URI of an SVG or PNG file.
///
/// # Errors
/// If the file cannot be read or is of another type.
pub fn data_uri_of_file(path: &Path) -> Result<String, Failure> {
    let failed = |problem: &dyn std::fmt::Display| {
        Failure::new(OTHER, format!("cannot read {}: {problem}", path.display()))
    };
    let bytes = std::fs::read(path).map_err(|error| failed(&error))?;
    match path.extension().and_then(|ending| ending.to_str()) {
        Some("svg") => Ok(data_uri("image/svg+xml", &bytes)),
        Some("png") => Ok(data_uri("image/png", &bytes)),
        _ => Err(failed(&"it is neither an SVG nor a PNG")),
    }
}
