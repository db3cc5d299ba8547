//! Decodes JPEG files and refuses truncated ones. (Browsers and the crate `image` fill the missing part with grey,
//! which would then be trained on.)

use image::{DynamicImage, GrayImage, RgbImage};
use zune_core::bytestream::ZCursor;
use zune_core::colorspace::ColorSpace;
use zune_core::options::DecoderOptions;
use zune_jpeg::JpegDecoder;

/// Decodes a file whose header is within the limits.
///
/// # Errors
/// When the file is damaged or truncated.
pub(super) fn decode(bytes: &[u8]) -> Result<DynamicImage, String> {
    let lenient = DecoderOptions::default()
        .set_strict_mode(false)
        .set_max_width(usize::MAX)
        .set_max_height(usize::MAX);
    let mut decoder = JpegDecoder::new_with_options(ZCursor::new(bytes), lenient);
    // Headers may deviate from the standard, as those of many cameras do; only the pixels must be complete.
    decoder.decode_headers().map_err(|error| error.to_string())?;
    let grey = decoder.input_colorspace() == Some(ColorSpace::Luma);
    let colours = if grey { ColorSpace::Luma } else { ColorSpace::RGB };
    decoder.set_options(lenient.set_strict_mode(true).jpeg_set_out_colorspace(colours));
    if !has_end(bytes) {
        return Err("the end of the file is missing; copy it again".to_owned());
    }
    let pixels = decoder.decode().map_err(|error| format!("{error}; the file is damaged"))?;
    let (width, height) = decoder.dimensions().unwrap_or_default();
    let (width, height) = (width as u32, height as u32);
    let image = if grey {
        GrayImage::from_raw(width, height, pixels).map(DynamicImage::from)
    } else {
        RgbImage::from_raw(width, height, pixels).map(DynamicImage::from)
    };
    image.ok_or_else(|| "the decoder returned a wrong number of pixels".to_owned())
}

/// Returns true if an end marker follows the first scan. Earlier segments are skipped by their lengths, since an
/// embedded preview has an end marker of its own. Compressed pixels cannot contain the marker.
fn has_end(bytes: &[u8]) -> bool {
    const SCAN: u8 = 0xda;
    const END: [u8; 2] = [0xff, 0xd9];
    let mut at = 2;
    while let Some(&[a, b, high, low]) = bytes.get(at..at + 4) {
        match (a, b) {
            (0xff, SCAN) => return bytes[at..].windows(2).any(|pair| pair == END),
            // Fill bytes, or other bytes between segments.
            (0xff, 0xff) => at += 1,
            (0xff, _) => at += 2 + usize::from(u16::from_be_bytes([high, low])),
            _ => at += 1,
        }
    }
    false
}

#[cfg(test)]
mod tests {
    use image::codecs::jpeg::JpegEncoder;

    use super::*;

    fn sample() -> Vec<u8> {
        let image = RgbImage::from_fn(64, 48, |x, y| [(x * 4) as u8, (y * 5) as u8, 90].into());
        let mut bytes = Vec::new();
        JpegEncoder::new_with_quality(&mut bytes, 90).encode_image(&image).unwrap();
        bytes
    }

    #[test]
    fn complete_files_decode_as_in_the_crate_image() {
        let bytes = sample();
        let expected = image::load_from_memory(&bytes).unwrap();
        assert_eq!(decode(&bytes).unwrap(), expected);
        // Data appended by cameras is not damage.
        assert_eq!(decode(&[&bytes[..], b"appended"].concat()).unwrap(), expected);
        let mut grey = Vec::new();
        let image = GrayImage::from_fn(20, 9, |x, y| image::Luma([(x * y) as u8]));
        JpegEncoder::new(&mut grey).encode_image(&image).unwrap();
        assert_eq!(decode(&grey).unwrap(), image::load_from_memory(&grey).unwrap());
    }

    #[test]
    fn a_file_cut_anywhere_is_refused() {
        let bytes = sample();
        for length in 0..bytes.len() {
            assert!(decode(&bytes[..length]).is_err(), "{length} of {} bytes", bytes.len());
        }
    }
}
