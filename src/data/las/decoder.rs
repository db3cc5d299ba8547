//! Decompresses the points of LAZ files, chunk by chunk.

use std::io::{self, BufRead, Cursor, Read, Seek};
use std::path::Path;

use laz::las::{v1, v2};
use laz::record::{
    LayeredPointRecordDecompressor, RecordDecompressor, SequentialPointRecordDecompressor,
};
use laz::{DecompressionSelection, LazItem, LazItemType};

use super::compression::Compression;
use super::gps_times::GpsTimes;
use super::guards::{check_start, problem, without_panic};
use super::records::Records;
use super::{Header, chunks};
use crate::error::LoadError;

/// Reads all points of a file of this length. Beside the points, this takes the memory of the largest chunk.
pub(super) fn read(
    path: &Path,
    input: &mut (impl BufRead + Seek),
    length: u64,
    header: &Header,
    records: &mut Records,
) -> Result<(), LoadError> {
    if header.count == 0 {
        return Ok(());
    }
    let compression = Compression::read(path, input, header)?;
    let chunks = chunks::read(path, input, length, header, compression.chunk_size)?;
    let mut bytes = Vec::new();
    for (index, chunk) in chunks.iter().enumerate() {
        bytes.clear();
        input.by_ref().take(chunk.bytes).read_to_end(&mut bytes).map_err(LoadError::io(path))?;
        let decode = || decode(&bytes, chunk.points, header.record, &compression, records);
        without_panic(decode).map_err(|error| {
            let field = format!("chunk {} of {}", index + 1, chunks.len());
            LoadError::damaged(path, field, problem(&error))
        })?;
    }
    Ok(())
}

/// Decodes this many points, whose records have this length, from the bytes of a chunk.
fn decode(
    bytes: &[u8],
    points: u64,
    length: usize,
    compression: &Compression,
    records: &mut Records,
) -> io::Result<()> {
    if points == 0 {
        return Ok(());
    }
    let items = &compression.items;
    let mut decoder: Box<dyn RecordDecompressor<Cursor<&[u8]>> + '_> = if compression.is_layered {
        check_layers(bytes, length, items)?;
        Box::new(layered(Cursor::new(bytes), items)?)
    } else {
        check_start(bytes.get(length..).unwrap_or_default())?;
        Box::new(pointwise(Cursor::new(bytes), items)?)
    };
    let mut record = vec![0; length];
    for _ in 0..points {
        decoder.decompress_next(&mut record)?;
        records.push(&record);
    }
    Ok(())
}

/// A decoder of points that are stored one after another.
fn pointwise<'a>(
    input: Cursor<&'a [u8]>,
    items: &[LazItem],
) -> io::Result<SequentialPointRecordDecompressor<'a, Cursor<&'a [u8]>>> {
    let mut decoder = SequentialPointRecordDecompressor::new(input);
    for item in items {
        match item.item_type() {
            LazItemType::Point10 => {
                decoder.add_field_decompressor(v2::LasPoint0Decompressor::default());
            }
            LazItemType::GpsTime => decoder.add_field_decompressor(GpsTimes::new()),
            LazItemType::RGB12 => {
                decoder.add_field_decompressor(v2::LasRGBDecompressor::default());
            }
            LazItemType::WavePacket13 => {
                decoder.add_field_decompressor(v1::LasWavepacketDecompressor::default());
            }
            LazItemType::Byte(count) => {
                decoder.add_field_decompressor(v2::LasExtraByteDecompressor::new(count.into()));
            }
            other => return Err(io::Error::other(format!("{other:?} is in a layer"))),
        }
    }
    Ok(decoder)
}

/// A decoder of points whose fields are stored in layers.
fn layered<'a>(
    input: Cursor<&'a [u8]>,
    items: &Vec<LazItem>,
) -> io::Result<LayeredPointRecordDecompressor<'a, Cursor<&'a [u8]>>> {
    let mut decoder = LayeredPointRecordDecompressor::new(input);
    decoder.set_fields_from(items).map_err(io::Error::other)?;
    // Only these layers are needed. Besides, the crate's decoder of GPS times can overflow the stack (`gps_times.rs`).
    let needed = DecompressionSelection::xy_returns_channel().decompress_z().decompress_rgb();
    decoder.set_selection(needed);
    Ok(decoder)
}

/// Checks that a chunk has room for its layers, because the crate takes memory for a layer before reading it. A chunk
/// consists of the first record, of this length, the number of points, the length of each layer, and the layers.
fn check_layers(bytes: &[u8], length: usize, items: &[LazItem]) -> io::Result<()> {
    let layers = items.iter().map(|item| match item.item_type() {
        LazItemType::Point14 => 9,
        LazItemType::RGBNIR14 => 2,
        LazItemType::Byte14(count) => count.into(),
        _ => 1,
    });
    let lengths = length + 4;
    let mut begin = lengths + 4 * layers.sum::<usize>();
    let too_long = || io::Error::other("its layers do not fit");
    let lengths = bytes.get(lengths..begin).ok_or_else(too_long)?;
    for length in lengths.as_chunks().0 {
        let end = begin.saturating_add(u32::from_le_bytes(*length) as usize);
        check_start(bytes.get(begin..end).ok_or_else(too_long)?)?;
        begin = end;
    }
    Ok(())
}
