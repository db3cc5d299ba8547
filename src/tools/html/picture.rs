//! Pictures within a page, as `data:` URIs.

use std::path::Path;

use image::codecs::jpeg::JpegEncoder;
use image::codecs::webp::WebPEncoder;
use image::{ExtendedColorType, ImageResult, RgbImage};

use base64::Engine as _;
use base64::prelude::BASE64_STANDARD;
use densify_run::failure::{Failure, OTHER};

/// A picture that stands in a page.
#[derive(Debug, Clone)]
pub struct Embedded {
    /// Its `data:` URI.
    pub uri: String,
    /// Width and height `[px]`.
    pub size: (u32, u32),
}

impl Embedded {
    /// As JPEG, for what is looked at as a whole.
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

    /// As lossless WebP, for what is looked at closely.
    pub fn lossless(image: &RgbImage) -> Result<Self, Failure> {
        Self::encoded(image, "image/webp", |out| {
            let (width, height) = image.dimensions();
            WebPEncoder::new_lossless(out).encode(image, width, height, ExtendedColorType::Rgb8)
        })
    }

    fn encoded(
        image: &RgbImage,
        kind: &str,
        encode: impl FnOnce(&mut Vec<u8>) -> ImageResult<()>,
    ) -> Result<Self, Failure> {
        let mut bytes = Vec::new();
        encode(&mut bytes).map_err(|error| {
            Failure::new(OTHER, format!("a picture of the report cannot be encoded: {error}"))
        })?;
        Ok(Self { uri: uri(kind, &bytes), size: image.dimensions() })
    }
}

fn uri(kind: &str, bytes: &[u8]) -> String {
    format!("data:{kind};base64,{}", BASE64_STANDARD.encode(bytes))
}

/// The URI of a picture in a file, SVG or PNG.
pub fn embed_file(path: &Path) -> Result<String, Failure> {
    let failed = |why: &dyn std::fmt::Display| {
        Failure::new(OTHER, format!("cannot read {}: {why}", path.display()))
    };
    let bytes = std::fs::read(path).map_err(|error| failed(&error))?;
    match path.extension().and_then(|ending| ending.to_str()) {
        Some("svg") => Ok(uri("image/svg+xml", &bytes)),
        Some("png") => Ok(uri("image/png", &bytes)),
        _ => Err(failed(&"it is neither SVG nor PNG")),
    }
}
