//! Opens image files for decoding.

use std::io::{self, BufRead, Seek};

use image::ImageReader;

/// Anything that an image is read from. Decoders are generic and large; as all images are read through this one trait
/// object, they are compiled once.
pub(crate) trait Input: BufRead + Seek {}

impl<T: BufRead + Seek> Input for T {}

/// A reader of the format that the first bytes indicate.
///
/// # Errors
/// When the bytes cannot be read.
pub(crate) fn reader<'a>(
    input: impl BufRead + Seek + 'a,
) -> io::Result<ImageReader<Box<dyn Input + 'a>>> {
    ImageReader::new(Box::new(input) as Box<dyn Input>).with_guessed_format()
}
