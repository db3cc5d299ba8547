//! The transfer function that a PNG states, such as a linear one, and the conversion to sRGB.
//!
//! If several chunks state one, `cICP` takes precedence over `iCCP`, `sRGB` and `gAMA` (PNG, 3rd edition, 4.3).

use std::io::{BufRead, Read, Seek};

use densify_scenegen::texture::srgb_from_linear;
use image::{DynamicImage, ImageBuffer, Pixel};

const SIGNATURE: [u8; 8] = *b"\x89PNG\r\n\x1a\n";
/// Code of linear values in `cICP` (ITU-T H.273, table 3).
const LINEAR: u8 = 8;
/// Codes and names of the transfer functions of high dynamic range.
const HIGH_RANGE: [(u8, &str); 2] = [(16, "PQ"), (18, "HLG")];
/// The exponent in `gAMA` that programs write for sRGB.
const SRGB: f64 = 1.0 / 2.2;
/// Relative tolerance of this exponent, because programs round it.
const TOLERANCE: f64 = 0.05;

/// The transfer function of a PNG's values.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Transfer {
    /// The values are linear light to the power of this exponent.
    Exponent(f64),
    /// High dynamic range with this name.
    HighRange(&'static str),
}

/// The exponent of a PNG's transfer function: its values are linear light to this power. `None` if the values are, or
/// may be, sRGB, or if they have a high dynamic range.
pub(super) fn exponent(input: impl BufRead + Seek) -> Option<f64> {
    match stated_transfer(input)? {
        Transfer::Exponent(exponent) => Some(exponent),
        Transfer::HighRange(_) => None,
    }
}

/// The name of the transfer function if the values have a high dynamic range; converting them to sRGB would need tone
/// mapping.
pub(super) fn high_range(input: impl BufRead + Seek) -> Option<&'static str> {
    match stated_transfer(input)? {
        Transfer::HighRange(name) => Some(name),
        Transfer::Exponent(_) => None,
    }
}

/// The transfer function that a PNG states; `None` if it is, or may be, that of sRGB.
fn stated_transfer(mut input: impl BufRead + Seek) -> Option<Transfer> {
    let bytes = |input: &mut dyn Read| {
        let mut bytes = [0; 8];
        input.read_exact(&mut bytes).ok().map(|()| bytes)
    };
    if bytes(&mut input)? != SIGNATURE {
        return None;
    }
    let (mut gamma, mut ignores_gamma) = (None, false);
    loop {
        let [a, b, c, d, kind @ ..] = bytes(&mut input)?;
        let mut rest = i64::from(u32::from_be_bytes([a, b, c, d])) + 4;
        match &kind {
            b"cICP" | b"gAMA" if rest == 8 => {
                let [a, b, c, d, ..] = bytes(&mut input)?;
                if &kind == b"cICP" {
                    let high = HIGH_RANGE.iter().find(|(code, _)| *code == b);
                    let linear = (b == LINEAR).then_some(Transfer::Exponent(1.0));
                    return high.map(|&(_, name)| Transfer::HighRange(name)).or(linear);
                }
                gamma = Some(f64::from(u32::from_be_bytes([a, b, c, d])) / 1e5);
                rest = 0;
            }
            b"iCCP" | b"sRGB" => ignores_gamma = true,
            b"IDAT" | b"IEND" => break,
            _ => {}
        }
        input.seek_relative(rest).ok()?;
    }
    let is_not_srgb = |exponent: &f64| *exponent > 0.0 && (exponent / SRGB - 1.0).abs() > TOLERANCE;
    gamma.filter(|exponent| !ignores_gamma && is_not_srgb(exponent)).map(Transfer::Exponent)
}

/// Converts values that are linear light to the power of `exponent` to sRGB.
pub(super) fn to_srgb(image: &mut DynamicImage, exponent: f64) {
    use DynamicImage::*;
    let srgb = |value: f64| srgb_from_linear(value.powf(1.0 / exponent));
    let eight: Vec<u8> =
        (0..=255).map(|v| (255.0 * srgb(f64::from(v) / 255.0)).round() as u8).collect();
    let deep = || -> Vec<u16> {
        (0..=u16::MAX).map(|v| (65_535.0 * srgb(f64::from(v) / 65_535.0)).round() as u16).collect()
    };
    match image {
        ImageLuma8(image) => replace(image, &eight),
        ImageLumaA8(image) => replace(image, &eight),
        ImageRgb8(image) => replace(image, &eight),
        ImageRgba8(image) => replace(image, &eight),
        ImageLuma16(image) => replace(image, &deep()),
        ImageLumaA16(image) => replace(image, &deep()),
        ImageRgb16(image) => replace(image, &deep()),
        ImageRgba16(image) => replace(image, &deep()),
        // PNGs have no other types of pixels.
        _ => {}
    }
}

/// Replaces all values but alpha with those of a table.
fn replace<P: Pixel>(image: &mut ImageBuffer<P, Vec<P::Subpixel>>, table: &[P::Subpixel])
where
    P::Subpixel: Into<usize>,
{
    for pixel in image.pixels_mut() {
        pixel.apply_without_alpha(|value| table[value.into()]);
    }
}

#[cfg(test)]
mod tests {
    use std::io::Cursor;

    use image::{ImageFormat, Luma, Rgb, Rgba};

    use super::super::images::{ImageSource, read_header};
    use super::*;

    type Chunk<'a> = (&'a [u8; 4], &'a [u8]);

    /// A PNG with chunks after its header.
    fn png(image: &DynamicImage, chunks: &[Chunk<'_>]) -> Vec<u8> {
        let mut bytes = Vec::new();
        image.write_to(&mut Cursor::new(&mut bytes), ImageFormat::Png).unwrap();
        let mut more = Vec::new();
        for (kind, data) in chunks {
            let chunk = [&kind[..], data].concat();
            let mut sum = flate2::Crc::new();
            sum.update(&chunk);
            more.extend((data.len() as u32).to_be_bytes());
            more.extend(chunk);
            more.extend(sum.sum().to_be_bytes());
        }
        bytes.splice(33..33, more);
        bytes
    }

    /// A quarter of full light is 137 in sRGB.
    #[test]
    fn values_become_srgb_as_the_file_says() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.png");
        let rgb = DynamicImage::from(ImageBuffer::from_pixel(2, 2, Rgb([64_u8, 0, 255])));
        let deep = DynamicImage::from(ImageBuffer::from_pixel(2, 2, Rgb([16_448_u16, 0, 65_535])));
        let gamma = |exponent: u32| exponent.to_be_bytes();
        let (linear, usual, old) = (gamma(100_000), gamma(45_455), gamma(55_556));
        let zero = gamma(0);
        let cases: [(&DynamicImage, &[Chunk<'_>], u8); 10] = [
            (&rgb, &[], 64),
            (&rgb, &[(b"gAMA", &linear)], 137),
            (&deep, &[(b"gAMA", &linear[..])], 137),
            (&rgb, &[(b"gAMA", &usual)], 64),
            (&rgb, &[(b"gAMA", &zero)], 64),
            (&rgb, &[(b"gAMA", &old)], 81),
            (&rgb, &[(b"sRGB", &[0]), (b"gAMA", &linear)], 64),
            (&rgb, &[(b"gAMA", &linear), (b"sRGB", &[0])], 64),
            (&rgb, &[(b"cICP", &[1, 8, 0, 1])], 137),
            (&rgb, &[(b"gAMA", &linear), (b"cICP", &[1, 13, 0, 1])], 64),
        ];
        for (image, chunks, red) in cases {
            std::fs::write(&path, png(image, chunks)).unwrap();
            let loaded = ImageSource::whole(path.clone()).load().unwrap();
            assert_eq!(loaded.rgb[..3], [red, 0, 255], "{chunks:?}");
        }
        // Alpha does not change, and grey images remain grey.
        let clear = ImageBuffer::from_pixel(2, 2, Rgba([64_u8, 64, 64, 64]));
        let grey = ImageBuffer::from_pixel(2, 2, Luma([64_u8]));
        for (image, alpha) in [(clear.into(), Some(vec![64; 4])), (grey.into(), None)] {
            std::fs::write(&path, png(&image, &[(b"gAMA", &linear)])).unwrap();
            let loaded = ImageSource::whole(path.clone()).load().unwrap();
            assert_eq!((&loaded.rgb[..3], loaded.alpha), (&[137; 3][..], alpha));
        }
    }

    #[test]
    fn values_of_high_dynamic_range_are_refused() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.png");
        let rgb = ImageBuffer::from_pixel(2, 2, Rgb([64_u8, 0, 255])).into();
        for (code, name) in [(16, "PQ"), (18, "HLG")] {
            std::fs::write(&path, png(&rgb, &[(b"cICP", &[9, code, 0, 1])])).unwrap();
            let message = read_header(&path).unwrap_err().to_string();
            assert!(message.contains(&format!("a.png: cICP: its values are {name}")), "{message}");
        }
    }

    #[test]
    fn truncated_files_state_no_exponent() {
        let grey = ImageBuffer::from_pixel(2, 2, Luma([64_u8])).into();
        let whole = png(&grey, &[(b"gAMA", &100_000_u32.to_be_bytes())]);
        assert_eq!(exponent(Cursor::new(&whole)), Some(1.0));
        for at in 0..40 {
            assert_eq!(exponent(Cursor::new(&whole[..at])), None);
        }
    }
}
