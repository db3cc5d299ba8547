//! Tests of the colour spaces that files state.

use std::io::Cursor;

use image::codecs::jpeg::JpegEncoder;
use image::codecs::png::PngEncoder;
use image::codecs::webp::WebPEncoder;
use image::{DynamicImage, ImageBuffer, ImageEncoder, ImageFormat, Luma, Rgb, RgbImage, Rgba};
use moxcms::{ColorProfile, curve_from_gamma};
use rand::{RngExt, SeedableRng};

use super::super::images::{ImageSource, read_colours};
use super::super::tests::{assert_noted, load};
use super::*;
use densify_fixtures::Made;

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
    let cases: [(&DynamicImage, &[Chunk<'_>], u8); 12] = [
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
        // Frames that FFmpeg extracts from a video.
        (&rgb, &[(b"cICP", &[1, 1, 0, 0])], 64),
        (&rgb, &[(b"cICP", &[2, 2, 0, 1])], 64),
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

/// Values of Display P3 become these of sRGB, by the matrix of CSS Color 4 between the linear values.
fn srgb_from_p3(rgb: [u8; 3]) -> [u8; 3] {
    let linear = rgb.map(|v| match f64::from(v) / 255.0 {
        v if v <= 0.04045 => v / 12.92,
        v => ((v + 0.055) / 1.055).powf(2.4),
    });
    let rows = [[1.22494, -0.22494, 0.0], [-0.04206, 1.04206, 0.0], [-0.01964, -0.07864, 1.09828]];
    rows.map(|row| {
        let sum: f64 = row.iter().zip(linear).map(|(a, b)| a * b).sum();
        let sum = sum.clamp(0.0, 1.0);
        let value =
            if sum <= 0.003_130_8 { 12.92 * sum } else { 1.055 * sum.powf(1.0 / 2.4) - 0.055 };
        (255.0 * value).round() as u8
    })
}

fn assert_near(found: &[u8], expected: [u8; 3], tolerance: u8, case: &str) {
    let found = &found[..3];
    let near = found.iter().zip(expected).all(|(a, b)| a.abs_diff(b) <= tolerance);
    assert!(near, "{case}: {found:?} instead of {expected:?}");
}

/// The image in a format, with a profile.
fn tagged(image: &DynamicImage, extension: &str, profile: &[u8]) -> Vec<u8> {
    fn write(mut encoder: impl ImageEncoder, image: &DynamicImage, profile: &[u8]) {
        encoder.set_icc_profile(profile.to_vec()).unwrap();
        image.write_with_encoder(encoder).unwrap();
    }
    let mut bytes = Vec::new();
    match extension {
        "png" => write(PngEncoder::new(&mut bytes), image, profile),
        "webp" => write(WebPEncoder::new_lossless(&mut bytes), image, profile),
        _ => write(JpegEncoder::new_with_quality(&mut bytes, 100), image, profile),
    }
    bytes
}

fn loaded(
    folder: &tempfile::TempDir,
    extension: &str,
    bytes: &[u8],
) -> densify_core::image::Image8 {
    let path = folder.path().join(format!("a.{extension}"));
    std::fs::write(&path, bytes).unwrap();
    ImageSource::whole(path).load().unwrap()
}

#[test]
fn profiles_of_every_format_are_converted() {
    let folder = tempfile::tempdir().unwrap();
    let colour = [64, 200, 64];
    let image = DynamicImage::from(RgbImage::from_pixel(16, 16, Rgb(colour)));
    let p3 = ColorProfile::new_display_p3().encode().unwrap();
    let srgb = ColorProfile::new_srgb().encode().unwrap();
    let mut linear = ColorProfile::new_srgb();
    linear.cicp = None;
    for curve in [&mut linear.red_trc, &mut linear.green_trc, &mut linear.blue_trc] {
        *curve = Some(curve_from_gamma(1.0));
    }
    let linear = linear.encode().unwrap();
    // Readers accept a profile in several segments, if all are there.
    let long = [&p3[..], &[0; 100_000]].concat();
    for extension in ["png", "jpg", "webp"] {
        let convert =
            |profile: &[u8]| loaded(&folder, extension, &tagged(&image, extension, profile));
        let tolerance = if extension == "jpg" { 3 } else { 1 };
        for (profile, expected, case) in [
            (&p3, srgb_from_p3(colour), "P3"),
            (&long, srgb_from_p3(colour), "several parts"),
            (&linear, [137, 229, 137], "linear"),
        ] {
            assert_near(
                &convert(profile).rgb,
                expected,
                tolerance,
                &format!("{extension}, {case}"),
            );
        }
        let mut plain = Vec::new();
        image
            .write_to(&mut Cursor::new(&mut plain), ImageFormat::from_extension(extension).unwrap())
            .unwrap();
        if extension != "jpg" {
            assert_eq!(convert(&srgb), loaded(&folder, extension, &plain), "{extension}");
        }
    }
}

#[test]
fn profiles_apply_to_alpha_depth_and_grey() {
    let folder = tempfile::tempdir().unwrap();
    let p3 = ColorProfile::new_display_p3().encode().unwrap();
    let expected = srgb_from_p3([64, 200, 64]);
    let clear = ImageBuffer::from_pixel(3, 2, Rgba([64_u8, 200, 64, 30])).into();
    let clear = loaded(&folder, "png", &tagged(&clear, "png", &p3));
    assert_near(&clear.rgb, expected, 1, "alpha");
    assert_eq!(clear.alpha, Some(vec![30; 6]));
    let deep = [64_u16, 200, 64].map(|v| 257 * v);
    let deep = ImageBuffer::from_pixel(3, 2, Rgb(deep)).into();
    assert_near(&loaded(&folder, "png", &tagged(&deep, "png", &p3)).rgb, expected, 1, "16 bits");
    let grey = ImageBuffer::from_pixel(3, 2, Luma([64_u8])).into();
    for (profile, value) in
        [(p3, 64), (ColorProfile::new_gray_with_gamma(1.0).encode().unwrap(), 137)]
    {
        assert_near(
            &loaded(&folder, "png", &tagged(&grey, "png", &profile)).rgb,
            [value; 3],
            1,
            "grey",
        );
    }
}

#[test]
fn primaries_of_png_chunks_are_converted() {
    let folder = tempfile::tempdir().unwrap();
    let image = RgbImage::from_pixel(2, 2, Rgb([64, 200, 64])).into();
    let expected = srgb_from_p3([64, 200, 64]);
    let chromaticities = |all: [u32; 8]| all.map(u32::to_be_bytes).concat();
    let p3 = chromaticities([31_270, 32_900, 68_000, 32_000, 26_500, 69_000, 15_000, 6_000]);
    let srgb = chromaticities([31_270, 32_900, 64_000, 33_000, 30_000, 60_000, 15_000, 6_000]);
    let gamma = 45_455_u32.to_be_bytes();
    let cases: [(&[Chunk<'_>], [u8; 3]); 6] = [
        (&[(b"cICP", &[12, 13, 0, 1])], expected),
        (&[(b"cICP", &[12, 1, 0, 1])], expected),
        (&[(b"cHRM", &p3)], expected),
        (&[(b"gAMA", &gamma), (b"cHRM", &p3)], expected),
        (&[(b"gAMA", &gamma), (b"cHRM", &srgb)], [64, 200, 64]),
        (&[(b"sRGB", &[0]), (b"cHRM", &p3)], [64, 200, 64]),
    ];
    for (chunks, expected) in cases {
        let found = loaded(&folder, "png", &png(&image, chunks));
        assert_near(&found.rgb, expected, 1, &format!("{chunks:?}"));
    }
}

#[test]
fn colours_that_cannot_be_converted_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let rgb = DynamicImage::from(ImageBuffer::from_pixel(2, 2, Rgb([64_u8, 0, 255])));
    let p3 = ColorProfile::new_display_p3().encode().unwrap();
    let mut parts = tagged(&rgb, "jpg", &[&p3[..], &[0; 100_000]].concat());
    let second = parts.windows(13).rposition(|part| part == b"ICC_PROFILE\0\x02").unwrap();
    parts[second] = b'X';
    let pq = ColorProfile::new_display_p3_pq().encode().unwrap();
    let cases: [(&str, Vec<u8>, &str); 8] = [
        ("png", png(&rgb, &[(b"cICP", &[9, 16, 0, 1])]), "cICP: its values are PQ"),
        ("png", png(&rgb, &[(b"cICP", &[9, 18, 0, 1])]), "cICP: its values are HLG"),
        (
            "png",
            png(&rgb, &[(b"cICP", &[1, 17, 0, 1])]),
            "cICP: primaries 1 with transfer function 17",
        ),
        ("png", png(&rgb, &[(b"cHRM", &[0; 32])]), "cHRM: its primaries span no colours"),
        ("png", png(&rgb, &[(b"iCCP", b"name\0\0nothing")]), "ICC profile: it is damaged"),
        ("jpg", parts, "ICC profile: it is damaged"),
        ("jpg", tagged(&rgb, "jpg", &p3[..300]), "ICC profile: it is damaged"),
        ("webp", tagged(&rgb, "webp", &pq), "ICC profile: its values are PQ"),
    ];
    for (extension, bytes, words) in cases {
        let path = folder.path().join(format!("a.{extension}"));
        std::fs::write(&path, bytes).unwrap();
        let message = read_colours(&path).unwrap_err().to_string();
        assert!(
            message.contains(words) && message.contains("convert the image to sRGB"),
            "{message}"
        );
    }
}

#[test]
fn conversions_are_noted() {
    let made = Made::colmap_txt();
    let image = RgbImage::from_pixel(20, 12, Rgb([64, 200, 64])).into();
    let p3 = ColorProfile::new_display_p3().encode().unwrap();
    made.write("images/b.png", tagged(&image, "png", &p3));
    assert_noted(&load(&made), "1 photograph converted to sRGB, b.png, Display P3");
}

#[test]
fn truncated_files_state_nothing() {
    let grey = ImageBuffer::from_pixel(2, 2, Luma([64_u8])).into();
    let whole = png(&grey, &[(b"gAMA", &100_000_u32.to_be_bytes())]);
    assert!(read(Cursor::new(&whole)).unwrap().is_some());
    let p3 = ColorProfile::new_display_p3().encode().unwrap();
    let rgb = DynamicImage::from(RgbImage::new(2, 2));
    let [jpeg, webp] = ["jpg", "webp"].map(|extension| tagged(&rgb, extension, &p3));
    for (whole, end) in [(&whole, 40), (&jpeg, p3.len()), (&webp, p3.len())] {
        for at in 0..end {
            assert!(read(Cursor::new(&whole[..at])).unwrap().is_none(), "{at}");
        }
    }
}

/// Profiles come from strangers.
#[test]
fn damaged_profiles_are_errors_or_read_but_never_panic() {
    let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(7);
    let whole = [
        ColorProfile::new_display_p3().encode().unwrap(),
        ColorProfile::new_gray_with_gamma(1.8).encode().unwrap(),
    ];
    for round in 0..400 {
        let mut profile = whole[round % 2].clone();
        for _ in 0..rng.random_range(1..4) {
            let at = rng.random_range(0..profile.len());
            profile[at] = rng.random();
        }
        profile.truncate(rng.random_range(profile.len() / 2..2 * profile.len()));
        if let Ok(Some(colours)) = profiles::from_icc(&profile) {
            let mut image = RgbImage::from_pixel(2, 2, Rgb([64, 200, 64])).into();
            let _ = colours.convert(&mut image);
        }
    }
}

/// Cameras state Adobe RGB in EXIF, mostly without a profile.
#[test]
fn adobe_rgb_of_cameras_is_converted() {
    let folder = tempfile::tempdir().unwrap();
    let image = DynamicImage::from(RgbImage::from_pixel(16, 16, Rgb([100, 150, 100])));
    let with_exif = |index: &[u8], jpeg: &[u8]| {
        let value = exif::Value::Ascii(vec![index.to_vec()]);
        let field = exif::Field {
            tag: exif::Tag::InteroperabilityIndex,
            ifd_num: exif::In::PRIMARY,
            value,
        };
        let mut writer = exif::experimental::Writer::new();
        writer.push_field(&field);
        let mut tiff = Cursor::new(Vec::new());
        writer.write(&mut tiff, false).unwrap();
        let segment = [b"Exif\0\0", &tiff.into_inner()[..]].concat();
        let length = (segment.len() as u16 + 2).to_be_bytes();
        [&jpeg[..2], &[0xff, 0xe1], &length, &segment, &jpeg[2..]].concat()
    };
    let mut plain = Vec::new();
    image.write_to(&mut Cursor::new(&mut plain), ImageFormat::Jpeg).unwrap();
    let srgb = ColorProfile::new_srgb().encode().unwrap();
    let tagged = tagged(&image, "jpg", &srgb);
    // The values follow from the matrix in Adobe RGB (1998), version 2005-05, and gamma 563/256.
    for (index, jpeg, expected) in [
        (b"R03", &plain, [66, 151, 97]),
        (b"R98", &plain, [100, 150, 100]),
        (b"R03", &tagged, [100, 150, 100]),
    ] {
        let found = loaded(&folder, "jpg", &with_exif(index, jpeg));
        assert_near(&found.rgb, expected, 3, &format!("{index:?}"));
    }
}
