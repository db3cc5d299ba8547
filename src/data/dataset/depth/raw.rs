//! The values of a depth file, whatever its format.

use std::fs::File;
use std::io::Read;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::Path;

use image::imageops;
use image::metadata::Orientation;
use image::{DynamicImage, GrayImage, ImageBuffer, Luma};

use super::super::LoadError;
use super::super::images::SourceFile;
use super::files::DepthKind;
use super::{colmap, exr, npy, png};
use densify_core::files;

/// Longest side of a depth map `[px]`.
pub(super) const MAX_SIDE: u64 = 16_384;
/// Largest number of pixels of a depth map.
pub(super) const MAX_PIXELS: u64 = 1 << 28;
/// Largest file that is read `[bytes]`.
const MAX_FILE_BYTES: u64 = 1 << 31;

/// The values of a depth map in the file's unit; NaN where the depth is unknown. Row-major, from the top left.
pub(in super::super) type Values = ImageBuffer<Luma<f32>, Vec<f32>>;

/// The size of a depth file, from its header.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(in super::super) struct DepthHeader {
    /// Width, as stored `[px]`.
    pub(in super::super) width: u32,
    /// Height, as stored `[px]`.
    pub(in super::super) height: u32,
    /// Size of the file `[bytes]`.
    pub(in super::super) file_bytes: u64,
    /// Size of the values as the decoder returns them, besides the values in f32 `[bytes]`.
    pub(in super::super) decoded_bytes: u64,
}

impl DepthHeader {
    /// Checks the size against the limits.
    pub(super) fn checked(
        path: &Path,
        [width, height]: [u64; 2],
        file_bytes: u64,
        value_bytes: u64,
    ) -> Result<Self, LoadError> {
        let pixels = width.saturating_mul(height);
        if pixels == 0 || width > MAX_SIDE || height > MAX_SIDE || pixels > MAX_PIXELS {
            let problem = format!("{width}x{height} px are not supported");
            return Err(malformed(path, "the size", problem));
        }
        let (width, height) = (width as u32, height as u32);
        Ok(Self { width, height, file_bytes, decoded_bytes: pixels * value_bytes })
    }
}

/// A fault in a depth file.
pub(super) fn malformed(path: &Path, field: &str, problem: impl std::fmt::Display) -> LoadError {
    LoadError::malformed(path, field, problem, "export the depth again")
}

/// Reads the header of a depth file.
pub(in super::super) fn read_header(
    source: &SourceFile,
    kind: DepthKind,
) -> Result<DepthHeader, LoadError> {
    match kind {
        DepthKind::Png => png::read_header(source),
        DepthKind::Npy => npy::read_header(source),
        DepthKind::Exr => without_panic(source, exr::read_header),
        DepthKind::Colmap => colmap::read_header(source),
    }
}

/// Reads a depth file; also returns the number of negative values, which are unknown. `keeps_zero` is true for inverse
/// depth, of which 0 and negative numbers are values.
pub(in super::super) fn read(
    source: &SourceFile,
    kind: DepthKind,
    keeps_zero: bool,
) -> Result<(Values, usize), LoadError> {
    let mut values = match kind {
        DepthKind::Png => png::read(source, keeps_zero)?,
        DepthKind::Npy => npy::read(source)?,
        DepthKind::Exr => without_panic(source, exr::read)?,
        DepthKind::Colmap => colmap::read(source)?,
    };
    let mut negative = 0;
    for value in values.iter_mut() {
        negative += usize::from(*value < 0.0 && !keeps_zero);
        if !value.is_finite() || (*value <= 0.0 && !keeps_zero) {
            *value = f32::NAN;
        }
    }
    Ok((values, negative))
}

/// Calls a decoder that may panic on damaged files, and turns a panic into an error.
fn without_panic<T>(
    source: &SourceFile,
    read: impl FnOnce(&SourceFile) -> Result<T, LoadError>,
) -> Result<T, LoadError> {
    catch_unwind(AssertUnwindSafe(|| read(source)))
        .unwrap_or_else(|_| Err(malformed(&source.path, "the file", "the decoder failed")))
}

/// The confidences of a depth map: 0 ignores a pixel, 255 counts it in full.
pub(in super::super) fn read_confidence(
    source: &SourceFile,
) -> Result<ImageBuffer<Luma<u8>, Vec<u8>>, LoadError> {
    // ARKit has the levels 0, 1 and 2.
    const MOST: u16 = 2;
    let mut levels = match super::super::images::decode(source)? {
        // Conversion to eight bits would turn these into 0.
        DynamicImage::ImageLuma16(deep) if deep.iter().all(|&level| level <= MOST) => {
            GrayImage::from_fn(deep.width(), deep.height(), |x, y| [deep[(x, y)].0[0] as u8].into())
        }
        levels => levels.into_luma8(),
    };
    if levels.iter().all(|&level| u16::from(level) <= MOST) {
        levels.iter_mut().for_each(|level| *level = (*level * 127).saturating_add(*level / 2));
    }
    Ok(levels)
}

/// Turns values as the photograph is turned.
pub(in super::super) fn turned<T: image::Primitive + 'static>(
    values: ImageBuffer<Luma<T>, Vec<T>>,
    turn: Orientation,
) -> ImageBuffer<Luma<T>, Vec<T>> {
    match turn {
        Orientation::NoTransforms => values,
        Orientation::Rotate90 => imageops::rotate90(&values),
        Orientation::Rotate180 => imageops::rotate180(&values),
        Orientation::Rotate270 => imageops::rotate270(&values),
        Orientation::FlipHorizontal => imageops::flip_horizontal(&values),
        Orientation::FlipVertical => imageops::flip_vertical(&values),
        Orientation::Rotate90FlipH => imageops::flip_horizontal(&imageops::rotate90(&values)),
        Orientation::Rotate270FlipH => imageops::flip_horizontal(&imageops::rotate270(&values)),
    }
}

/// The values as an image, after a check that the file had one for each pixel.
pub(super) fn image(
    path: &Path,
    (width, height): (u32, u32),
    values: Vec<f32>,
) -> Result<Values, LoadError> {
    let count = values.len();
    (u64::from(width) * u64::from(height) == count as u64)
        .then(|| Values::from_raw(width, height, values))
        .flatten()
        .ok_or_else(|| {
            malformed(path, "the values", format!("{count} values for {width}x{height} px"))
        })
}

/// The length of a file, and its whole content.
pub(super) fn bytes(source: &SourceFile) -> Result<Vec<u8>, LoadError> {
    let path = &source.path;
    let file = source.open()?;
    let length = length(path, &file)?;
    let mut bytes = Vec::with_capacity(usize::try_from(length).unwrap_or(0));
    file.take(MAX_FILE_BYTES).read_to_end(&mut bytes).map_err(LoadError::io(path))?;
    Ok(bytes)
}

/// The length of a file, if it may be read as a whole `[bytes]`.
pub(super) fn length(path: &Path, file: &File) -> Result<u64, LoadError> {
    let length = file.metadata().map_err(LoadError::io(path))?.len();
    if length > MAX_FILE_BYTES {
        return Err(malformed(path, "the file", format!("{length} bytes are too many")));
    }
    Ok(length)
}

/// The first bytes of a file, and its length `[bytes]`.
pub(super) fn start(source: &SourceFile, count: u64) -> Result<(Vec<u8>, u64), LoadError> {
    let path = &source.path;
    let file = source.open()?;
    let length = length(path, &file)?;
    let mut start = Vec::new();
    file.take(count).read_to_end(&mut start).map_err(LoadError::io(path))?;
    if let Some(problem) = files::wrong_kind(&start) {
        return Err(malformed(path, "the file", problem));
    }
    Ok((start, length))
}
