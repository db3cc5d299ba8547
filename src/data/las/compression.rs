//! Reads how the points of a LAZ file are compressed, from the record of LASzip among the variable-length records.

use std::io::{BufRead, Read, Seek, SeekFrom};
use std::path::Path;

use laz::{LasZipError, LazItem, LazItemRecordBuilder, LazItemType, LazVlr};

use super::Header;
use super::guards::problem;
use crate::error::LoadError;

/// Length of the head of a variable-length record `[bytes]`.
const HEAD: usize = 54;
/// Name of the record in messages.
const FIELD: &str = "the record of LASzip";
/// Remedy for files that are sound, but compressed in an unusual way.
const UNPACK: &str = "unpack it, for instance with `pdal translate in.laz out.las`";
/// The compressors that divide points into chunks.
const POINTWISE: u16 = 2;
const LAYERED: u16 = 3;
/// Length of the records of each point format without extra bytes `[bytes]`.
pub(super) const LENGTHS: [u16; 11] = [20, 28, 26, 34, 57, 63, 30, 36, 38, 59, 67];
/// Most extra bytes of a record: the decoder of layers keeps 10 kB for each.
const MAX_EXTRA: usize = 1000;

/// How points are compressed.
pub(super) struct Compression {
    /// Number of points in each chunk but the last, unless the table of chunks lists the numbers.
    pub(super) chunk_size: Option<u32>,
    /// True if a chunk stores one field after another, as for the formats from 6 on, false if it stores one point after
    /// another.
    pub(super) is_layered: bool,
    /// The fields of a point.
    pub(super) items: Vec<LazItem>,
}

impl Compression {
    /// Reads the record of LASzip, and checks that it agrees with the header.
    pub(super) fn read(
        path: &Path,
        input: &mut (impl BufRead + Seek),
        header: &Header,
    ) -> Result<Self, LoadError> {
        let damaged = |problem: String| LoadError::damaged(path, FIELD, problem);
        let unusual = |problem: String| LoadError::malformed(path, FIELD, problem, UNPACK);
        let Some(record) = find(input, header).map_err(LoadError::io(path))? else {
            return Err(damaged("there is none, though the points are compressed".to_owned()));
        };
        let [kind, coder] = match record.first_chunk() {
            Some(&[a, b, c, d]) => [[a, b], [c, d]].map(u16::from_le_bytes),
            None => return Err(damaged("it is cut off".to_owned())),
        };
        let name = match kind {
            0 => " (none)",
            1 => " (without chunks)",
            _ => "",
        };
        if !matches!((kind, coder), (POINTWISE | LAYERED, 0)) {
            let problem = format!("compressor {kind}{name} with coder {coder} is not supported");
            return Err(unusual(problem));
        }
        let vlr = LazVlr::from_buffer(&record).map_err(|error| match error {
            LasZipError::IoError(error) => damaged(problem(&error)),
            other => damaged(other.to_string()),
        })?;
        let is_layered = header.format >= 6;
        if is_layered != (kind == LAYERED) || !items_agree(vlr.items(), header) {
            let Header { format, record, .. } = header;
            return Err(damaged(format!(
                "it contradicts the header, which has point format {format} with {record} bytes"
            )));
        }
        for item in vlr.items() {
            let is_known = match item.item_type() {
                LazItemType::WavePacket13 => matches!(item.version(), 1 | 2),
                _ if is_layered => matches!(item.version(), 3 | 4),
                _ => item.version() == 2,
            };
            if !is_known {
                let (version, item) = (item.version(), item.item_type());
                return Err(unusual(format!("version {version} of {item:?} is not supported")));
            }
        }
        let extra = header.record - usize::from(LENGTHS[usize::from(header.format)]);
        if extra > MAX_EXTRA {
            return Err(unusual(format!("{extra} extra bytes per point are not supported")));
        }
        let chunk_size = (!vlr.uses_variable_size_chunks()).then(|| vlr.chunk_size());
        Ok(Self { chunk_size, is_layered, items: vlr.items().clone() })
    }
}

/// True if these are the items of the header's point format, with its extra bytes.
fn items_agree(items: &[LazItem], header: &Header) -> bool {
    let Some(length) = LENGTHS.get(usize::from(header.format)) else { return false };
    let extra = u16::try_from(header.record).ok().and_then(|record| record.checked_sub(*length));
    let expected = extra.and_then(|extra| {
        LazItemRecordBuilder::default_for_point_format_id(header.format, extra).ok()
    });
    let kind = |item: &LazItem| (item.item_type(), item.size());
    expected.is_some_and(|expected| items.iter().map(kind).eq(expected.iter().map(kind)))
}

/// The contents of the record of LASzip.
fn find(input: &mut (impl BufRead + Seek), header: &Header) -> std::io::Result<Option<Vec<u8>>> {
    let mut at = u64::from(header.length);
    input.seek(SeekFrom::Start(at))?;
    let mut head = [0; HEAD];
    for _ in 0..header.extras {
        at += HEAD as u64;
        // What lies behind the points' beginning is not a record, whatever number of records the header states.
        if at > header.begins || input.read_exact(&mut head).is_err() {
            break;
        }
        let length = u16::from_le_bytes([head[20], head[21]]);
        let number = u16::from_le_bytes([head[18], head[19]]);
        at += u64::from(length);
        if head[2..].starts_with(LazVlr::USER_ID.as_bytes()) && number == LazVlr::RECORD_ID {
            let mut contents = Vec::new();
            input.by_ref().take(length.into()).read_to_end(&mut contents)?;
            return Ok(Some(contents));
        }
        input.seek_relative(length.into())?;
    }
    Ok(None)
}
