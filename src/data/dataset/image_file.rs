//! Reads the headers of image files, and decodes them.
//!
//! Files are untrusted: the sides, the number of pixels and the decoded size are checked before anything is allocated.

use std::fs::File;
use std::io::{BufRead, BufReader, Cursor, Read, Seek};
use std::path::Path;

use image::error::ImageFormatHint;
use image::{DynamicImage, ImageDecoder, ImageFormat, Limits};

use super::LoadError;
use super::colours::{self, ColourSpace};
use super::images::ImageHeader;
use super::jpeg;
use super::source_file::SourceFile;
use crate::picture_file;
use densify_core::files;

/// Longest side accepted `[px]`.
const MAX_SIDE: u32 = 16_384;
/// Largest number of pixels accepted.
const MAX_PIXELS: u64 = 1 << 28;
/// Largest size of one decoded image `[bytes]`.
const MAX_DECODED_BYTES: u64 = 1 << 30;
/// Largest image file that is read `[bytes]`: no JPEG of [`MAX_PIXELS`] is larger.
const MAX_FILE_BYTES: u64 = MAX_DECODED_BYTES;
/// Supported formats.
const FORMATS: [ImageFormat; 3] = [ImageFormat::Jpeg, ImageFormat::Png, ImageFormat::WebP];
/// Bytes at the start of a file that almost always contain the header.
const HEADER_BYTES: u64 = 256 << 10;

fn limits() -> Limits {
    let mut limits = Limits::no_limits();
    limits.max_image_width = Some(MAX_SIDE);
    limits.max_image_height = Some(MAX_SIDE);
    limits.max_alloc = Some(MAX_DECODED_BYTES);
    limits
}

/// Reads the header of an image file, without decoding it, and checks it against the limits.
pub(super) fn read_header(path: &Path) -> Result<ImageHeader, LoadError> {
    let mut file = files::open(path).map_err(LoadError::io(path))?;
    header_of(path, &mut file)
}

/// As [`read_header`], from an open file.
fn header_of(path: &Path, file: &mut File) -> Result<ImageHeader, LoadError> {
    let file_bytes = file.metadata().map_err(LoadError::io(path))?.len();
    let mut start = Vec::new();
    file.take(HEADER_BYTES).read_to_end(&mut start).map_err(LoadError::io(path))?;
    if let Some(problem) = files::wrong_kind(&start) {
        return Err(LoadError::malformed(path, "the image", problem, "restore the image"));
    }
    let header = match parse_header(Cursor::new(&start), file_bytes) {
        // The header may follow a long preview or colour profile.
        Err(_) if file_bytes > HEADER_BYTES => {
            file.rewind().map_err(LoadError::io(path))?;
            parse_header(BufReader::new(file), file_bytes)
        }
        header => header,
    }
    .map_err(|problem| LoadError::image(path, problem))?;
    let pixels = u64::from(header.width) * u64::from(header.height);
    if pixels == 0 {
        return Err(LoadError::image(path, "it has no pixels"));
    }
    if pixels > MAX_PIXELS || header.decoded_bytes > MAX_DECODED_BYTES {
        let (width, height) = (header.width, header.height);
        let problem = format!("{width}x{height} px are more than supported");
        return Err(LoadError::image(path, problem));
    }
    Ok(header)
}

fn parse_header(
    input: impl BufRead + Seek,
    file_bytes: u64,
) -> Result<ImageHeader, image::ImageError> {
    let mut reader = picture_file::reader(input).map_err(image::ImageError::IoError)?;
    // Other crates of the build may enable more decoders.
    if let Some(format) = reader.format().filter(|format| !FORMATS.contains(format)) {
        let hint = ImageFormatHint::Exact(format);
        return Err(image::ImageError::Unsupported(hint.into()));
    }
    reader.limits(limits());
    let decoder = reader.into_decoder()?;
    let (width, height) = decoder.dimensions();
    let has_alpha = decoder.color_type().has_alpha();
    let decoded_bytes = decoder.total_bytes();
    Ok(ImageHeader { width, height, has_alpha, turn: None, decoded_bytes, file_bytes })
}

/// The colour space of an image file; `None` if it is sRGB, or not stated.
///
/// # Errors
/// When the file is missing, or its colours cannot be converted to sRGB.
pub(super) fn read_colours(path: &Path) -> Result<Option<ColourSpace>, LoadError> {
    colours_of(path, &mut files::open(path).map_err(LoadError::io(path))?)
}

/// As [`read_colours`], from an open file.
fn colours_of(path: &Path, file: &mut File) -> Result<Option<ColourSpace>, LoadError> {
    colours::read(BufReader::new(file)).map_err(|fault| colour_error(path, fault))
}

fn colour_error(path: &Path, fault: colours::Fault) -> LoadError {
    LoadError::malformed(path, fault.field, fault.problem, "convert the image to sRGB")
}

/// Decodes a photograph whose header has been checked, and converts it to sRGB.
pub(super) fn decode_photograph(source: &SourceFile) -> Result<DynamicImage, LoadError> {
    let mut file = source.open()?;
    let colours = colours_of(&source.path, &mut file)?;
    file.rewind().map_err(LoadError::io(&source.path))?;
    let mut image = decode_file(&source.path, file)?;
    if let Some(colours) = colours {
        colours.convert(&mut image).map_err(|fault| colour_error(&source.path, fault))?;
    }
    Ok(image)
}

/// Decodes an image whose header has been checked; the values are those of the file, whatever colours it states.
pub(super) fn decode(source: &SourceFile) -> Result<DynamicImage, LoadError> {
    decode_file(&source.path, source.open()?)
}

/// Reads the header of an image, passes it to `check`, and decodes the image from the same open file.
pub(super) fn decode_checked(
    source: &SourceFile,
    check: impl FnOnce(ImageHeader) -> Result<(), LoadError>,
) -> Result<DynamicImage, LoadError> {
    let path = &source.path;
    let mut file = source.open()?;
    check(header_of(path, &mut file)?)?;
    file.rewind().map_err(LoadError::io(path))?;
    decode_file(path, file)
}

fn decode_file(path: &Path, file: File) -> Result<DynamicImage, LoadError> {
    let mut reader = picture_file::reader(BufReader::new(file)).map_err(LoadError::io(path))?;
    if reader.format() == Some(ImageFormat::Jpeg) {
        let mut bytes = Vec::new();
        let mut input = reader.into_inner().take(MAX_FILE_BYTES);
        input.read_to_end(&mut bytes).map_err(LoadError::io(path))?;
        return jpeg::decode(&bytes).map_err(|problem| LoadError::image(path, problem));
    }
    reader.limits(limits());
    reader.decode().map_err(|problem| LoadError::image(path, problem))
}
