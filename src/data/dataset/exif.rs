//! What cameras write into photographs (EXIF): which way up they were held, and how they exposed.
//!
//! It is a hint and nothing more. Files without it, with a damaged one or with one of nonsense are read all
//! the same.

use std::fs::File;
use std::io::BufReader;
use std::ops::RangeInclusive;
use std::path::Path;

use exif::{In, Tag, Value};
use image::metadata::Orientation;

use super::View;
use densify_core::files;

/// Longest file in which it is looked for `[bytes]`.
const MAX_BYTES: u64 = 256 << 20;
/// Exposure times of cameras `[s]`.
const SECONDS: RangeInclusive<f64> = 1e-7..=3600.0;
/// F-numbers of lenses.
const F_NUMBERS: RangeInclusive<f64> = 0.3..=256.0;
/// Sensitivities of sensors (ISO).
const SENSITIVITIES: RangeInclusive<f64> = 1.0..=1e8;

/// How bright the photographs of some views were exposed, as far as they say.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct ReportedExposures {
    /// In stops above 1 s at f/1 and ISO 1, by view.
    pub stops: Vec<Option<f64>>,
    /// Number of photographs that say something which no camera does.
    pub nonsense: usize,
    /// The first of them, and what it says.
    pub example: Option<String>,
}

impl ReportedExposures {
    /// Reads the exposure times, f-numbers and sensitivities of the photographs of these views.
    #[must_use]
    pub fn of(views: &[View]) -> Self {
        let mut all = Self::default();
        for view in views {
            // Pictures that were rendered into memory say nothing.
            let found = match view.source.rendered {
                Some(_) => None,
                None => view.source.file.open().ok().and_then(read),
            };
            let stops = match found.as_ref().and_then(exposure) {
                Some(Ok(stops)) => Some(stops),
                Some(Err(what)) => {
                    all.nonsense += 1;
                    all.example.get_or_insert_with(|| format!("{} says {what}", view.name));
                    None
                }
                None => None,
            };
            all.stops.push(stops);
        }
        all
    }
}

/// The quarter turn that makes a photograph upright, if it says that one does.
pub(super) fn quarter_turn(path: &Path) -> Option<Orientation> {
    let found = read(files::open(path).ok()?)?;
    let number = found.get_field(Tag::Orientation, In::PRIMARY)?.value.get_uint(0)?;
    let turn = Orientation::from_exif(u8::try_from(number).ok()?)?;
    // The others leave width and height as they are.
    let is_quarter = (5..=8).contains(&turn.to_exif());
    is_quarter.then_some(turn)
}

fn read(file: File) -> Option<exif::Exif> {
    // What is read is never longer than the file, whatever lengths that claims.
    let is_sensible = file.metadata().ok()?.len() <= MAX_BYTES;
    let found =
        is_sensible.then(|| exif::Reader::new().read_from_container(&mut BufReader::new(file)));
    found?.ok()
}

/// How bright a photograph was exposed `[stops]`, or what it says instead; `None` where it does not say.
fn exposure(found: &exif::Exif) -> Option<Result<f64, String>> {
    let number = |tag| match &found.get_field(tag, In::PRIMARY)?.value {
        Value::Rational(values) => values.first().map(exif::Rational::to_f64),
        value => value.get_uint(0).map(f64::from),
    };
    let (seconds, aperture) = (number(Tag::ExposureTime)?, number(Tag::FNumber)?);
    let sensitivity = number(Tag::PhotographicSensitivity)?;
    for (value, range, what) in [
        (seconds, SECONDS, "an exposure of {} s"),
        (aperture, F_NUMBERS, "f/{}"),
        (sensitivity, SENSITIVITIES, "ISO {}"),
    ] {
        if !range.contains(&value) {
            return Some(Err(what.replace("{}", &value.to_string())));
        }
    }
    Some(Ok((seconds * sensitivity / (aperture * aperture)).log2()))
}
