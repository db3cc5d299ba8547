//! Depth as 16-bit greyscale PNG, as nerfstudio, Polycam, ARKit recorders and RGB-D data sets store it.
//!
//! 0 is unknown, and so is 65535, which ScanNet++ and Kinect recorders write where nothing was measured.

use image::DynamicImage;

use super::super::LoadError;
use super::super::images::{self, ImageHeader, SourceFile};
use super::raw::{DepthHeader, Values, malformed};

pub(super) fn read_header(source: &SourceFile) -> Result<DepthHeader, LoadError> {
    let header = images::read_header(&source.path)?;
    check(source, header)?;
    let size = [header.width, header.height].map(u64::from);
    DepthHeader::checked(&source.path, size, header.file_bytes, 2)
}

/// Refuses pictures of depth: eight bits, or colours.
fn check(source: &SourceFile, header: ImageHeader) -> Result<(), LoadError> {
    let pixels = u64::from(header.width) * u64::from(header.height);
    if header.decoded_bytes == 2 * pixels && !header.has_alpha {
        return Ok(());
    }
    let problem = "this is a picture (8 bits, or colours), not a map of depth, which needs 16 bits and one channel";
    Err(malformed(&source.path, "the pixels", problem))
}

pub(super) fn read(source: &SourceFile, keeps_all: bool) -> Result<Values, LoadError> {
    let decoded = images::decode_checked(source, |header| check(source, header))?;
    let DynamicImage::ImageLuma16(steps) = decoded else {
        return Err(malformed(&source.path, "the pixels", "they are not 16-bit grey"));
    };
    let value = |step: u16| if step == u16::MAX && !keeps_all { f32::NAN } else { f32::from(step) };
    let (width, height) = steps.dimensions();
    let values = steps.into_raw().into_iter().map(value).collect();
    super::raw::image(&source.path, (width, height), values)
}
