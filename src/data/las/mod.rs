//! Reads point clouds in LAS files, versions 1.0 to 1.4, and in LAZ files, their compressed form.
//!
//! The header has the offset, the format and the length of the point records, and for each axis the scale and offset
//! that turn 32-bit integers into coordinates (ASPRS, *LAS Specification 1.4 R15*, sections 2.4 and 2.6).

mod chunks;
mod compression;
mod decoder;
mod gps_times;
mod guards;
mod records;
#[cfg(test)]
mod tests;

use std::io::{BufRead, BufReader, Read, Seek, SeekFrom};
use std::path::Path;

use glam::DVec3;

use crate::error::LoadError;
use crate::points::PointCloud;
use densify_core::files;
use records::Records;

/// The first bytes of a file.
pub(crate) const MAGIC: &[u8] = b"LASF";
/// Length of the header of versions up to 1.2 `[bytes]`.
const HEADER: usize = 227;
/// Length of the header of version 1.4 `[bytes]`.
const LONG_HEADER: usize = 375;
/// Largest accepted number of points.
const MAX_POINTS: u64 = 1 << 28;
/// The bits of the point format that mark LAZ.
const COMPRESSED: u8 = 0xc0;

/// What the header says.
struct Header {
    /// Length of the header; then come the variable-length records `[bytes]`.
    length: u16,
    /// Number of variable-length records.
    extras: u32,
    /// Place of the points in the file `[bytes]`.
    begins: u64,
    /// Format of the points, without the bits that mark LAZ.
    format: u8,
    is_compressed: bool,
    /// Length of a record `[bytes]`.
    record: usize,
    /// Number of points.
    count: u64,
    scale: DVec3,
    offset: DVec3,
}

/// Reads all points.
///
/// # Errors
/// When the file is cut off, contradicts itself, or is compressed in an unusual way.
pub fn read(path: &Path) -> Result<PointCloud, LoadError> {
    let file = files::open(path).map_err(LoadError::io(path))?;
    read_from(path, BufReader::new(file))
}

/// Reads all points of a file whose path is for messages only.
fn read_from(path: &Path, mut input: impl BufRead + Seek) -> Result<PointCloud, LoadError> {
    let header = Header::read(path, &mut input)?;
    let length = input.seek(SeekFrom::End(0)).map_err(LoadError::io(path))?;
    let mut records = Records::new(&header);
    if header.is_compressed {
        decoder::read(path, &mut input, length, &header, &mut records)?;
        return Ok(records.finish());
    }
    let needed = header.begins.saturating_add(header.count * header.record as u64);
    if length < needed {
        return Err(cut_off(path, length, needed));
    }
    input.seek(SeekFrom::Start(header.begins)).map_err(LoadError::io(path))?;
    let mut record = vec![0; header.record];
    for _ in 0..header.count {
        input.read_exact(&mut record).map_err(LoadError::io(path))?;
        records.push(&record);
    }
    Ok(records.finish())
}

/// The error for a file that is too short.
fn cut_off(path: &Path, length: u64, needed: u64) -> LoadError {
    LoadError::damaged(path, "the file", format!("it has {length} of {needed} bytes"))
}

impl Header {
    fn read(path: &Path, input: impl Read) -> Result<Self, LoadError> {
        let bad = |problem: String| Err(LoadError::damaged(path, "the header", problem));
        let mut bytes = Vec::with_capacity(LONG_HEADER);
        input.take(LONG_HEADER as u64).read_to_end(&mut bytes).map_err(LoadError::io(path))?;
        if bytes.len() < HEADER || !bytes.starts_with(MAGIC) {
            return bad("it is not that of a LAS file".to_owned());
        }
        let u16_at = |at: usize| u16::from_le_bytes([bytes[at], bytes[at + 1]]);
        let u32_at = |at: usize| u32::from_le_bytes([0, 1, 2, 3].map(|byte| bytes[at + byte]));
        let u64_at =
            |at: usize| u64::from_le_bytes([0, 1, 2, 3, 4, 5, 6, 7].map(|byte| bytes[at + byte]));
        let axes =
            |at: usize| DVec3::from([0, 8, 16].map(|axis| f64::from_bits(u64_at(at + axis))));
        let mut header = Self {
            length: u16_at(94),
            extras: u32_at(100),
            begins: u32_at(96).into(),
            format: bytes[104] & !COMPRESSED,
            is_compressed: bytes[104] & COMPRESSED != 0,
            record: u16_at(105).into(),
            count: u32_at(107).into(),
            scale: axes(131),
            offset: axes(155),
        };
        // Version 1.4 may have more points than fit the older field, which is then 0.
        if header.count == 0 && usize::from(header.length) >= LONG_HEADER {
            if bytes.len() < LONG_HEADER {
                return Err(cut_off(path, bytes.len() as u64, LONG_HEADER as u64));
            }
            header.count = u64_at(247);
        }
        let Self { count, record, .. } = header;
        if !(header.scale.is_finite() && header.offset.is_finite()) {
            return bad("its scale or offset is not finite".to_owned());
        }
        if count > MAX_POINTS || record < 20 {
            return bad(format!("{count} points of {record} bytes are not supported"));
        }
        Ok(header)
    }
}
