//! Reads point clouds in LAS files, versions 1.0 to 1.4, without compression.
//!
//! The header has the offset, the format and the length of the point records, and for each axis the scale and offset
//! that turn 32-bit integers into coordinates (ASPRS, *LAS Specification 1.4 R15*, sections 2.4 and 2.6).

use std::fs::File;
use std::io::{BufReader, Read, Seek, SeekFrom};
use std::path::Path;

use glam::DVec3;

use crate::error::LoadError;
use crate::points::PointCloud;
use densify_core::files;

/// The first bytes of a file.
pub(crate) const MAGIC: &[u8] = b"LASF";
/// Length of the header of versions up to 1.2 `[bytes]`.
const HEADER: usize = 227;
/// Largest accepted number of points.
const MAX_POINTS: u64 = 1 << 28;
/// Bit of the point format that marks LAZ.
const COMPRESSED: u8 = 0x80;
/// Place of red, green and blue in the records of the formats that have them `[bytes]`.
const COLOURS: [(u8, usize); 6] = [(2, 20), (3, 28), (5, 28), (7, 30), (8, 30), (10, 30)];
/// Colour of points that have none.
const GREY: u8 = 128;

/// Reads all points.
///
/// # Errors
/// When the file is compressed (LAZ), cut off, or contradicts itself.
pub(crate) fn read(path: &Path) -> Result<PointCloud, LoadError> {
    let bad = |field: &str, problem: String| Err(LoadError::damaged(path, field, problem));
    let mut file: File = files::open(path).map_err(LoadError::io(path))?;
    let length = file.metadata().map_err(LoadError::io(path))?.len();
    let mut header = [0; HEADER];
    if file.read_exact(&mut header).is_err() || !header.starts_with(MAGIC) {
        return bad("the header", "it is not that of a LAS file".to_owned());
    }
    let u16_at = |at: usize| u16::from_le_bytes([header[at], header[at + 1]]);
    let u32_at = |at: usize| u32::from_le_bytes([0, 1, 2, 3].map(|byte| header[at + byte]));
    let f64_at =
        |at: usize| f64::from_le_bytes([0, 1, 2, 3, 4, 5, 6, 7].map(|byte| header[at + byte]));
    let axes = |at: usize| DVec3::new(f64_at(at), f64_at(at + 8), f64_at(at + 16));
    let (begins, format, record) = (u64::from(u32_at(96)), header[104], usize::from(u16_at(105)));
    if format & COMPRESSED != 0 {
        let problem = "LAZ, the compressed form of LAS, is not supported";
        let remedy = "unpack it, for instance with `pdal translate in.laz out.las`";
        return Err(LoadError::malformed(path, "the point format", problem, remedy));
    }
    let (scale, offset) = (axes(131), axes(155));
    if !(scale.is_finite() && offset.is_finite()) {
        return bad("the header", "its scale or offset is not finite".to_owned());
    }
    // Version 1.4 may have more points than fit the older field, which is then 0.
    let mut count = u64::from(u32_at(107));
    if count == 0 && u16_at(94) >= 375 {
        let mut number = [0; 8];
        let read = file.seek(SeekFrom::Start(247)).and_then(|_| file.read_exact(&mut number));
        read.map_err(LoadError::io(path))?;
        count = u64::from_le_bytes(number);
    }
    if count > MAX_POINTS || record < 20 {
        return bad("the header", format!("{count} points of {record} bytes are not supported"));
    }
    let needed = begins.saturating_add(count * record as u64);
    if length < needed {
        return bad("the file", format!("it has {length} of {needed} bytes"));
    }
    let colours = COLOURS.iter().find(|(known, _)| *known == format).map(|(_, at)| *at);
    let colours = colours.filter(|at| at + 6 <= record);
    file.seek(SeekFrom::Start(begins)).map_err(LoadError::io(path))?;
    let (mut input, mut bytes) = (BufReader::new(file), vec![0; record]);
    let mut points = PointCloud::default();
    let mut deep = Vec::new();
    for _ in 0..count {
        input.read_exact(&mut bytes).map_err(LoadError::io(path))?;
        let axis =
            |at: usize| f64::from(i32::from_le_bytes([0, 1, 2, 3].map(|byte| bytes[at + byte])));
        points.positions.push(DVec3::new(axis(0), axis(4), axis(8)) * scale + offset);
        if let Some(at) = colours {
            deep.push(
                [0, 2, 4].map(|channel| {
                    u16::from_le_bytes([bytes[at + channel], bytes[at + channel + 1]])
                }),
            );
        }
    }
    // Many programs write colours of 0 to 255 into the 16-bit fields.
    let shift = if deep.iter().flatten().all(|&value| value <= 255) { 0 } else { 8 };
    points.colours = deep.iter().map(|colour| colour.map(|value| (value >> shift) as u8)).collect();
    points.colours.resize(points.positions.len(), [GREY; 3]);
    Ok(points)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A file of format 2 with two points, of which the second has this colour.
    fn file(colour: u16) -> Vec<u8> {
        let mut bytes = vec![0; HEADER];
        bytes[..4].copy_from_slice(MAGIC);
        bytes[94..96].copy_from_slice(&(HEADER as u16).to_le_bytes());
        bytes[96..100].copy_from_slice(&(HEADER as u32).to_le_bytes());
        bytes[104] = 2;
        bytes[105..107].copy_from_slice(&26_u16.to_le_bytes());
        bytes[107..111].copy_from_slice(&2_u32.to_le_bytes());
        for axis in 0..3 {
            bytes[131 + 8 * axis..139 + 8 * axis].copy_from_slice(&0.01_f64.to_le_bytes());
            bytes[155 + 8 * axis..163 + 8 * axis].copy_from_slice(&1000.0_f64.to_le_bytes());
        }
        for (place, colour) in [([0, 0, 0], 0), ([100, -200, 300_i32], colour)] {
            bytes.extend(place.iter().flat_map(|value| value.to_le_bytes()));
            bytes.extend([0; 8]);
            bytes.extend([colour, 0, 1].iter().flat_map(|value: &u16| value.to_le_bytes()));
        }
        bytes
    }

    fn read_bytes(bytes: &[u8]) -> Result<PointCloud, String> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("scan.las");
        std::fs::write(&path, bytes).unwrap();
        read(&path).map_err(|error| error.to_string())
    }

    #[test]
    fn points_and_colours_of_either_depth_are_read() {
        let points = read_bytes(&file(200)).unwrap();
        assert_eq!(points.positions, [DVec3::splat(1000.0), DVec3::new(1001.0, 998.0, 1003.0)]);
        assert_eq!(points.colours, [[0, 0, 1], [200, 0, 1]]);
        assert_eq!(read_bytes(&file(0x8000)).unwrap().colours[1], [128, 0, 0]);
    }

    #[test]
    fn compressed_and_damaged_files_are_refused() {
        let with = |edit: &dyn Fn(&mut Vec<u8>)| {
            let mut bytes = file(0);
            edit(&mut bytes);
            read_bytes(&bytes).unwrap_err()
        };
        assert!(with(&|bytes| bytes[104] |= 0x80).contains("LAZ"));
        assert!(with(&|bytes| bytes.truncate(250)).contains("of 279 bytes"));
        assert!(with(&|bytes| bytes[110] = 0xff).contains("not supported"));
        assert!(with(&|bytes| bytes[0] = 0).contains("not that of a LAS"));
        assert!(with(&|bytes| bytes.truncate(9)).contains("not that of a LAS"));
    }
}
