//! Tests of EXIF fields: exposures, orientations and implausible values.

use std::io::Cursor;
use std::path::Path;

use ::exif::experimental::Writer;
use ::exif::{Field, In, Rational, Tag, Value};

use super::super::*;
use super::{assert_noted, load, refused, write_mask};
use densify_fixtures::{self, Made, NAMES, SIZE};

/// Exposure time `[s]`, f-number and sensitivity (ISO) of a photograph.
type Settings = ((u32, u32), (u32, u32), u16);

fn exposed(((a, b), (c, d), iso): Settings) -> Vec<(Tag, Value)> {
    let rational = |num, denom| Value::Rational(vec![Rational { num, denom }]);
    vec![
        (Tag::ExposureTime, rational(a, b)),
        (Tag::FNumber, rational(c, d)),
        (Tag::PhotographicSensitivity, Value::Short(vec![iso])),
    ]
}

pub(super) fn turned(orientation: u16) -> Vec<(Tag, Value)> {
    vec![(Tag::Orientation, Value::Short(vec![orientation]))]
}

/// Writes these fields into a PNG file, after its header.
pub(super) fn write_exif(path: &Path, fields: Vec<(Tag, Value)>) {
    let field = |(tag, value)| Field { tag, ifd_num: In::PRIMARY, value };
    let fields: Vec<Field> = fields.into_iter().map(field).collect();
    let mut writer = Writer::new();
    fields.iter().for_each(|field| writer.push_field(field));
    let mut bytes = Cursor::new(Vec::new());
    writer.write(&mut bytes, true).unwrap();
    let chunk = [b"eXIf".to_vec(), bytes.into_inner()].concat();
    let mut sum = flate2::Crc::new();
    sum.update(&chunk);
    let length = (chunk.len() as u32 - 4).to_be_bytes();
    let mut file = std::fs::read(path).unwrap();
    // The chunk is inserted after the signature and the first chunk.
    file.splice(33..33, [length.to_vec(), chunk, sum.sum().to_be_bytes().to_vec()].concat());
    std::fs::write(path, file).unwrap();
}

fn shot(settings: [Option<Settings>; 3]) -> Made {
    let made = Made::colmap_txt();
    for (name, settings) in ["a", "b", "c"].into_iter().zip(settings) {
        if let Some(settings) = settings {
            write_exif(&made.file(&format!("images/{name}.png")), exposed(settings));
        }
    }
    made
}

fn reported(made: &Made) -> ReportedExposures {
    let data = load(made);
    for view in &data.train {
        view.source.load().unwrap();
    }
    ReportedExposures::read(&data.train)
}

#[test]
fn exposures_are_reported_in_stops() {
    // Compared with the first photograph, the second has twice the exposure time; the third has a quarter of the time,
    // half the f-number and twice the sensitivity.
    let found = reported(&shot([
        Some(((1, 100), (4, 1), 100)),
        Some(((1, 50), (4, 1), 100)),
        Some(((10, 4000), (20, 10), 200)),
    ]));
    let stops: Vec<f64> = found.stops.iter().map(|stops| stops.unwrap()).collect();
    let expected = (0.01_f64 * 100.0 / 16.0).log2();
    for (stops, more) in stops.iter().zip([0.0, 1.0, 1.0]) {
        assert!((stops - expected - more).abs() < 1e-12, "{stops} {expected}");
    }
    assert_eq!((found.implausible, found.example), (0, None));
    // Photographs without EXIF have no exposure.
    let found = reported(&shot([None, Some(((1, 50), (4, 1), 100)), None]));
    assert!(found.stops[0].is_none() && found.stops[1].is_some() && found.stops[2].is_none());
    assert_eq!(found.implausible, 0);
}

/// JPEG files store EXIF in a segment of its own.
#[test]
fn exposures_are_read_from_jpeg_files_too() {
    let made = Made::transforms(|json| json["frames"][0]["file_path"] = "images/a.jpg".into());
    let png = shot([Some(((1, 50), (4, 1), 100)), None, None]);
    let expected = reported(&png).stops[0];
    let bytes = std::fs::read(png.file("images/a.png")).unwrap();
    let length = u32::from_be_bytes(bytes[33..37].try_into().unwrap()) as usize;
    let exif = [b"Exif\0\0", &bytes[41..41 + length]].concat();
    let mut jpeg = Cursor::new(Vec::new());
    let image = image::open(made.file("images/a.png")).unwrap();
    image.write_to(&mut jpeg, image::ImageFormat::Jpeg).unwrap();
    let size = (exif.len() as u16 + 2).to_be_bytes();
    let segment = [&[0xff, 0xe1], &size[..], &exif].concat();
    let mut jpeg = jpeg.into_inner();
    jpeg.splice(2..2, segment);
    made.write("images/a.jpg", jpeg);
    assert!(expected.is_some());
    assert_eq!(reported(&made).stops[0], expected);
}

/// EXIF is opened at most once: fields that loading needed for the orientation are kept.
#[test]
fn exif_that_was_read_while_loading_is_kept() {
    for (made, is_kept) in [(Made::realitycapture(), true), (Made::colmap_txt(), false)] {
        let path = made.file("images/a.png");
        write_exif(&path, exposed(((1, 50), (4, 1), 100)));
        let data = load(&made);
        std::fs::remove_file(path).unwrap();
        assert_eq!(ReportedExposures::read(&data.train).stops[0].is_some(), is_kept);
    }
}

#[test]
fn implausible_values_are_named_and_not_used() {
    for (settings, words) in [
        (((0, 1), (4, 1), 100), "exposure of 0 s"),
        (((1, 0), (4, 1), 100), "exposure of inf s"),
        (((0, 0), (4, 1), 100), "exposure of NaN s"),
        (((4_000_000_000, 1), (4, 1), 100), "exposure of 4000000000 s"),
        (((1, 50), (0, 1), 100), "f/0"),
        (((1, 50), (1000, 1), 100), "f/1000"),
        (((1, 50), (4, 1), 0), "ISO 0"),
    ] {
        let found = reported(&shot([Some(settings), Some(((1, 50), (4, 1), 100)), Some(settings)]));
        assert_eq!((found.implausible, found.stops[0], found.stops[2]), (2, None, None), "{words}");
        assert!(found.stops[1].is_some());
        let example = found.example.unwrap();
        assert!(example.contains("a.png") && example.contains(words), "{words}: {example}");
    }
}

/// With any byte of the EXIF damaged, the photograph is still read.
#[test]
fn damaged_exif_does_not_prevent_loading() {
    let made = shot([Some(((1, 50), (4, 1), 100)), None, None]);
    let path = made.file("images/a.png");
    let whole = std::fs::read(&path).unwrap();
    let length = u32::from_be_bytes(whole[33..37].try_into().unwrap()) as usize;
    for at in 41..41 + length {
        for value in [0, 0x7f, 0xff] {
            let mut bytes = whole.clone();
            bytes[at] = value;
            let mut sum = flate2::Crc::new();
            sum.update(&bytes[37..41 + length]);
            bytes[41 + length..45 + length].copy_from_slice(&sum.sum().to_be_bytes());
            std::fs::write(&path, &bytes).unwrap();
            let data = load(&made);
            assert_eq!(ReportedExposures::read(&data.train).stops.len(), 3, "{at}");
        }
    }
}

/// Writes an upright image, red above and blue below, with an EXIF orientation.
fn write_turned_image(made: &Made, orientation: Option<u16>) {
    let path = made.file("images/b.png");
    let (width, height) = (SIZE.1, SIZE.0);
    let colour = |y: u32| if y < height / 2 { [255, 0, 0] } else { [0, 0, 255] };
    let picture = image::RgbImage::from_fn(width, height, |_, y| colour(y).into());
    picture.save(&path).unwrap();
    if let Some(orientation) = orientation {
        write_exif(&path, turned(orientation));
    }
}

#[test]
fn a_photograph_that_fits_its_camera_only_after_a_quarter_turn_is_turned() {
    // Orientation 6 is a quarter turn clockwise, so that the upper side comes to the right; 8 is the opposite turn; 5
    // and 7 are also mirrored.
    let (upper, lower) = ([255, 0, 0], [0, 0, 255]);
    for (orientation, left) in [(6, lower), (8, upper), (5, upper), (7, lower)] {
        let made = Made::colmap_txt();
        write_turned_image(&made, Some(orientation));
        let data = load(&made);
        let view = &data.train[1];
        let image = view.source.load().unwrap();
        assert_eq!((image.width, image.height), SIZE);
        assert_eq!(image.rgb[..3], left, "{orientation}");
        assert_ne!(image.rgb[57..60], left, "{orientation}");
        assert_noted(&data, "1 photograph rotated by 90 degrees, b.png");
        // Turning needs memory for two copies of the image.
        let bytes = view.source.working_bytes();
        assert!(bytes >= 2 * 3 * u64::from(SIZE.0 * SIZE.1), "{bytes}");
        assert!(data.train[0].source.header.turn.is_none());
        // A mask has the orientation of the turned image.
        write_mask(&made.file("masks/b.png"), |_| 9);
        let data = load(&made);
        assert_eq!(data.train[1].source.load().unwrap().mask.unwrap()[0], 9);
    }
}

/// The image size in the pose file decides: the orientation of an image that fits its camera is ignored.
#[test]
fn a_photograph_that_fits_its_camera_is_not_turned() {
    let plain = Made::colmap_txt();
    let bytes = |made: &Made| {
        let data = load(made);
        let view = &data.train[1].source;
        (view.load().unwrap(), view.working_bytes(), data.notes)
    };
    for orientation in [1, 3, 6, 8, 77] {
        let made = Made::colmap_txt();
        write_exif(&made.file("images/b.png"), turned(orientation));
        assert!(bytes(&made) == bytes(&plain), "{orientation}");
    }
    // Square images fit either way and are not turned.
    let made = Made::colmap_txt();
    made.replace("sparse/0/cameras.txt", "PINHOLE 20 12 15 16 10 6", "PINHOLE 12 12 15 16 6 6");
    for name in NAMES {
        densify_fixtures::image(&made.file(&format!("images/{name}")), (12, 12), 9);
    }
    write_exif(&made.file("images/b.png"), turned(6));
    let data = load(&made);
    assert_eq!(data.train[1].source.header.turn, None);
    // An image that fits neither way is refused.
    for orientation in [None, Some(1), Some(3), Some(77)] {
        let made = Made::colmap_txt();
        write_turned_image(&made, orientation);
        let case = format!("{orientation:?}");
        refused(&case, &made, &LoadOptions::default(), "b.png, 12x20");
    }
}

/// Without an image size in the pose file, it is unknown whether the poses include the turn.
#[test]
fn an_ambiguous_orientation_is_noted() {
    let sizeless = || {
        Made::transforms(|json| {
            for field in ["w", "h"] {
                json.as_object_mut().unwrap().remove(field);
            }
        })
    };
    for (made, is_named) in [
        (Made::realitycapture(), true),
        (sizeless(), true),
        (Made::transforms(|_| ()), false),
        (Made::colmap_txt(), false),
    ] {
        write_exif(&made.file("images/b.png"), turned(6));
        let data = load(&made);
        let is_noted = |note: &Note| note.contains("1 photograph used as stored, although");
        assert_eq!(data.notes.iter().any(is_noted), is_named, "{:?}", data.notes);
    }
}
