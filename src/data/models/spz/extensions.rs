//! The extensions of an SPZ file. Only `SPZ_ADOBE_coordinate_system` is read, which states the axes.
//!
//! Each extension is a record of type, length and content. Records stand before the table of version 4, and after the
//! arrays of earlier versions, if a bit of the header says so.

use std::path::Path;

use glam::{DMat3, DMat4, DVec3};

use super::layout::COORDINATE_SYSTEM;
use crate::error::LoadError;
use crate::models::similarity::{Similarity, mirror_x};
use densify_core::gaussians::Gaussians;

/// The directions of the axes x, y, z (left, right, up, down, forwards, backwards), by their number in files, counted
/// from 1.
const SYSTEMS: [&str; 16] = [
    "LDB", "RDB", "LUB", "RUB", "LDF", "RDF", "LUF", "RUF", "LFD", "RFD", "LFU", "RFU", "LBD",
    "RBD", "LBU", "RBU",
];

/// The axes of a file by the letters of their directions.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(in crate::models) struct Axes(&'static str);

/// The contents of a file's extensions.
#[derive(Debug, Default)]
pub(super) struct Extensions {
    pub(super) axes: Option<Axes>,
    /// Notes on extensions that are ignored or damaged.
    pub(super) notes: Vec<String>,
}

impl Axes {
    /// Converts a model from these axes to those of datasets: right, down, forwards.
    pub(in crate::models) fn convert(self, model: &mut Gaussians) {
        let direction = |letter| match letter {
            'L' => DVec3::NEG_X,
            'R' => DVec3::X,
            'U' => DVec3::NEG_Y,
            'D' => DVec3::Y,
            'B' => DVec3::NEG_Z,
            _ => DVec3::Z,
        };
        let mut axes = self.0.chars().map(direction);
        let mut axis = || axes.next().unwrap_or_default();
        let mut turn = DMat3::from_cols(axis(), axis(), axis());
        if turn.determinant() < 0.0 {
            // Left-handed axes are a mirror image.
            mirror_x(model);
            turn.x_axis = -turn.x_axis;
        }
        if let Some(turn) = Similarity::from_matrix(&DMat4::from_mat3(turn)) {
            turn.apply(model);
        }
    }
}

impl std::fmt::Display for Axes {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(self.0)
    }
}

/// Parses the records of extensions.
///
/// # Errors
/// When the stated axes are unknown.
pub(super) fn parse(path: &Path, mut records: &[u8]) -> Result<Extensions, LoadError> {
    let mut extensions = Extensions::default();
    while !records.is_empty() {
        let Some((kind, content, rest)) = split_record(records) else {
            extensions.notes.push("a damaged extension and those after it are ignored".into());
            break;
        };
        records = rest;
        if kind != COORDINATE_SYSTEM {
            extensions.notes.push(format!("the extension 0x{kind:08X} is ignored"));
            continue;
        }
        let number = content.first_chunk().map(|&bytes| u32::from_le_bytes(bytes));
        extensions.axes = match number {
            Some(0) => {
                extensions.notes.push("the file says that its axes are unspecified".into());
                None
            }
            Some(number) if number as usize <= SYSTEMS.len() => {
                Some(Axes(SYSTEMS[number as usize - 1]))
            }
            other => {
                let number = other.map_or("no number".into(), |number| format!("number {number}"));
                let problem = format!("the axes have {number}, but 1 to {} exist", SYSTEMS.len());
                return Err(LoadError::damaged(path, "SPZ_ADOBE_coordinate_system", problem));
            }
        };
    }
    Ok(extensions)
}

/// The type and the content of the first record, and the records after it; `None` if it is truncated.
fn split_record(records: &[u8]) -> Option<(u32, &[u8], &[u8])> {
    let (&kind, rest) = records.split_first_chunk()?;
    let (&length, rest) = rest.split_first_chunk()?;
    let (content, rest) = rest.split_at_checked(u32::from_le_bytes(length) as usize)?;
    Some((u32::from_le_bytes(kind), content, rest))
}

#[cfg(test)]
mod tests {
    use std::io::{Read, Write};

    use super::super::layout::ANTIALIASED;
    use super::*;
    use crate::models::read_model;
    use crate::models::tests::saved;
    use densify_core::antialiasing::Antialiasing;
    use densify_fixtures::corpus;

    fn record(kind: u32, content: &[u8]) -> Vec<u8> {
        [&kind.to_le_bytes()[..], &(content.len() as u32).to_le_bytes(), content].concat()
    }

    /// The corpus file of a version, with these records of extensions.
    fn spz(version: u32, records: &[u8]) -> Vec<u8> {
        let mut bytes = std::fs::read(corpus(&format!("spz/v{version}.spz"))).unwrap();
        if version == 4 {
            bytes[14] |= 2;
            bytes[16] += records.len() as u8;
            bytes.splice(32..32, records.iter().copied());
            return bytes;
        }
        let mut plain = Vec::new();
        flate2::read::GzDecoder::new(&bytes[..]).read_to_end(&mut plain).unwrap();
        plain[14] |= 2;
        plain.extend(records);
        let mut zipped = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast());
        zipped.write_all(&plain).unwrap();
        zipped.finish().unwrap()
    }

    #[test]
    fn models_are_converted_from_the_stated_axes() {
        for version in [3, 4] {
            let plain = read_model(&corpus(&format!("spz/v{version}.spz"))).unwrap();
            type Turn = fn([f32; 3]) -> [f32; 3];
            let cases: [(u32, Turn); 5] = [
                (6, |mean| mean),
                (4, |[x, y, z]| [x, -y, -z]),
                (8, |[x, y, z]| [x, -y, z]),
                (12, |[x, y, z]| [x, -z, y]),
                (13, |[x, y, z]| [-x, z, -y]),
            ];
            for (number, mean) in cases {
                let stated = record(COORDINATE_SYSTEM, &number.to_le_bytes());
                let (_folder, path) = saved("model.bin", spz(version, &stated));
                let found = read_model(&path).unwrap();
                for (found, plain) in found.gaussians.means.iter().zip(&plain.gaussians.means) {
                    let apart = found.iter().zip(mean(*plain)).map(|(a, b)| (a - b).abs());
                    assert!(apart.fold(0.0, f32::max) < 1e-5, "{version}, {number}: {found:?}");
                }
                assert!(found.notes[0].contains(SYSTEMS[number as usize - 1]), "{:?}", found.notes);
            }
        }
    }

    #[test]
    fn axes_and_antialiasing_may_both_be_stated() {
        let mut bytes = spz(4, &record(COORDINATE_SYSTEM, &4_u32.to_le_bytes()));
        bytes[14] |= ANTIALIASED;
        let (_folder, path) = saved("model.bin", bytes);
        let found = read_model(&path).unwrap();
        assert_eq!(found.gaussians.antialiasing, Antialiasing::Wide);
        let [axes, antialiasing] = &found.notes[..] else { panic!("{:?}", found.notes) };
        assert!(axes.contains("RUB") && antialiasing.contains("0.3 px²"), "{:?}", found.notes);
    }

    #[test]
    fn unknown_extensions_are_noted_and_unknown_axes_refused() {
        let plain = read_model(&corpus("spz/v4.spz")).unwrap().gaussians;
        let unspecified = record(COORDINATE_SYSTEM, &[0; 4]);
        let other = record(0xadbe_0002, &[1; 12]);
        for (records, words) in [
            (&unspecified, "unspecified"),
            (&other, "0xADBE0002"),
            (&other[..9].to_vec(), "damaged"),
        ] {
            let (_folder, path) = saved("model.bin", spz(4, records));
            let found = read_model(&path).unwrap();
            assert_eq!(found.gaussians, plain, "{words}");
            assert!(found.notes[0].contains(words), "{words}: {:?}", found.notes);
        }
        for content in [&[17, 0, 0, 0][..], &[4]] {
            let (_folder, path) = saved("model.bin", spz(4, &record(COORDINATE_SYSTEM, content)));
            let message = read_model(&path).unwrap_err().to_string();
            assert!(message.contains("model.bin: SPZ_ADOBE_coordinate_system"), "{message}");
        }
    }
}
