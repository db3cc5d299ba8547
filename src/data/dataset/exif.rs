//! EXIF fields of photographs: orientation and exposure.
//!
//! EXIF is optional: a photograph is read even if its EXIF is missing, damaged or implausible.

use std::fs::File;
use std::io::BufReader;
use std::ops::RangeInclusive;
use std::path::Path;

use exif::{In, Tag, Value};
use image::metadata::Orientation;

use super::View;
use densify_core::files;

/// Largest file that is searched for EXIF `[bytes]`.
const MAX_BYTES: u64 = 256 << 20;
/// Plausible exposure times `[s]`.
const SECONDS: RangeInclusive<f64> = 1e-7..=3600.0;
/// Plausible f-numbers.
const F_NUMBERS: RangeInclusive<f64> = 0.3..=256.0;
/// Plausible sensitivities (ISO).
const SENSITIVITIES: RangeInclusive<f64> = 1.0..=1e8;

/// The EXIF fields of a photograph that are used.
#[derive(Debug, Clone, Default, PartialEq)]
pub(super) struct Exif {
    orientation: Option<Orientation>,
    /// The exposure `[stops above 1 s at f/1 and ISO 1]`, or the implausible value; `None` if a field is missing.
    exposure: Option<Result<f64, String>>,
    /// Make, model and focal length, which photographs by one lens have in common; `None` if one of them is missing.
    pub(super) lens: Option<String>,
}

impl Exif {
    /// Reads the fields of a file; empty if the file cannot be read.
    pub(super) fn open(path: &Path) -> Self {
        files::open(path).map(Self::read).unwrap_or_default()
    }

    /// Reads the fields of an open file, from its start.
    pub(super) fn read(file: File) -> Self {
        // The length of the file bounds the allocations, whatever lengths its fields claim.
        let is_small = file.metadata().is_ok_and(|data| data.len() <= MAX_BYTES);
        let fields =
            is_small.then(|| exif::Reader::new().read_from_container(&mut BufReader::new(file)));
        let Some(Ok(fields)) = fields else { return Self::default() };
        Self { orientation: orientation(&fields), exposure: exposure(&fields), lens: lens(&fields) }
    }

    /// Direction in the image, as its pixels are stored (x right, y down), that is up when it is shown upright.
    pub(super) fn up(&self) -> [f64; 2] {
        match self.orientation.map_or(1, Orientation::to_exif) {
            3 | 4 => [0.0, 1.0],
            5 | 6 => [-1.0, 0.0],
            7 | 8 => [1.0, 0.0],
            _ => [0.0, -1.0],
        }
    }

    /// The quarter turn that makes the photograph upright, if it needs one. Other orientations keep width and height.
    pub(super) fn quarter_turn(&self) -> Option<Orientation> {
        self.orientation.filter(|turn| (5..=8).contains(&turn.to_exif()))
    }
}

fn orientation(fields: &exif::Exif) -> Option<Orientation> {
    let number = fields.get_field(Tag::Orientation, In::PRIMARY)?.value.get_uint(0)?;
    Orientation::from_exif(u8::try_from(number).ok()?)
}

/// As [`Exif::lens`].
fn lens(fields: &exif::Exif) -> Option<String> {
    let text = |tag| {
        let value = fields.get_field(tag, In::PRIMARY)?.display_value().to_string();
        Some(value).filter(|value| !value.trim_matches(['"', ' ', '0', '.']).is_empty())
    };
    Some([text(Tag::Make)?, text(Tag::Model)?, text(Tag::FocalLength)?].join(" "))
}

/// As [`Exif::exposure`].
fn exposure(fields: &exif::Exif) -> Option<Result<f64, String>> {
    let number = |tag| match &fields.get_field(tag, In::PRIMARY)?.value {
        Value::Rational(values) => values.first().map(exif::Rational::to_f64),
        value => value.get_uint(0).map(f64::from),
    };
    let (seconds, aperture) = (number(Tag::ExposureTime)?, number(Tag::FNumber)?);
    let sensitivity = number(Tag::PhotographicSensitivity)?;
    for (value, range, text) in [
        (seconds, SECONDS, "an exposure of {} s"),
        (aperture, F_NUMBERS, "f/{}"),
        (sensitivity, SENSITIVITIES, "ISO {}"),
    ] {
        if !range.contains(&value) {
            return Some(Err(text.replace("{}", &value.to_string())));
        }
    }
    Some(Ok((seconds * sensitivity / (aperture * aperture)).log2()))
}

/// Exposures of views according to the EXIF fields of their photographs.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct ReportedExposures {
    /// Exposure of each view `[stops above 1 s at f/1 and ISO 1]`, if reported. Shape: `[views]`.
    pub stops: Vec<Option<f64>>,
    /// Number of views with implausible values.
    pub implausible: usize,
    /// Name and implausible value of the first such view, for messages.
    pub example: Option<String>,
}

impl ReportedExposures {
    /// Collects the exposures of these views, reading the EXIF of each photograph that has not been read yet.
    pub fn read(views: &[View]) -> Self {
        let mut all = Self::default();
        // The views of one photograph are consecutive.
        let mut last: Option<(&Path, Exif)> = None;
        for View { name, source, .. } in views {
            let path = &*source.file.path;
            let exif = match last.take().filter(|(other, _)| *other == path) {
                Some((_, exif)) => exif,
                None => source.file.exif(),
            };
            let stops = match &exif.exposure {
                Some(Err(value)) => {
                    all.implausible += 1;
                    all.example.get_or_insert_with(|| format!("{name} says {value}"));
                    None
                }
                Some(Ok(stops)) => Some(*stops),
                None => None,
            };
            all.stops.push(stops);
            last = Some((path, exif));
        }
        all
    }
}
