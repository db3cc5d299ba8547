//! What the arrays of an SPZ file are packed in: one gzip stream up to version 3, zstd frames since version 4.

use std::io::{self, Write};

use flate2::Compression;
use flate2::write::GzEncoder;
use ruzstd::encoding::{CompressionLevel, compress};

use crate::import::spz::MAGIC;

/// An array of all rows: its bytes, and what writes them.
pub(super) type Array<'a> = (usize, &'a dyn Fn(&mut dyn Write) -> io::Result<()>);

/// Most memory of the compressor of gzip, with its window, tables and buffer `[bytes]`: measured 0.35 MiB.
pub(super) const GZIP: u64 = 1 << 19;
/// Of that of zstd: a block of 128 KiB and the places of its strings, as it is and as it was before.
const ZSTD: u64 = 4 << 20;
/// Where the table of frames begins: behind the header, as there are no extensions.
const TABLE: u32 = 32;

/// Most memory that frames of arrays of these sizes take `[bytes]`: all of them, and the array at hand.
pub(super) fn frames_bytes(arrays: &[usize]) -> u64 {
    let frames: usize = arrays.iter().map(|&bytes| most(bytes)).sum();
    (frames + arrays.iter().max().unwrap_or(&0)) as u64 + ZSTD
}

/// Most bytes of a frame: blocks of 128 KiB that cannot be packed stay as they are, behind three bytes.
fn most(bytes: usize) -> usize {
    bytes + 3 * bytes.div_ceil(1 << 17) + 32
}

/// The header that both have; `facts` are the degree of colour and the fractional bits of positions.
fn header(version: u32, rows: u32, facts: [u8; 2], frames: u8) -> Vec<u8> {
    let words = [MAGIC, version, rows].map(u32::to_le_bytes);
    [words.as_flattened(), &facts, &[0, frames]].concat()
}

/// Version 3.
pub(super) fn in_gzip(
    rows: u32,
    facts: [u8; 2],
    arrays: &[Array<'_>],
    out: &mut dyn Write,
) -> io::Result<()> {
    let mut out = GzEncoder::new(out, Compression::best());
    out.write_all(&header(3, rows, facts, 0))?;
    for (_, write) in arrays {
        write(&mut out)?;
    }
    out.finish().map(drop)
}

/// Version 4: the sizes of frames stand before the first, so that all are held.
pub(super) fn in_frames(
    rows: u32,
    facts: [u8; 2],
    arrays: &[Array<'_>; 6],
    out: &mut dyn Write,
) -> io::Result<()> {
    let (mut frames, mut table) = (Vec::new(), Vec::new());
    // Without bands there is no frame of them.
    let bands = usize::from(facts[0] > 0);
    for &(bytes, write) in &arrays[..5 + bands] {
        let mut plain = Vec::with_capacity(bytes);
        write(&mut plain)?;
        let mut frame = Vec::with_capacity(most(bytes));
        compress(&plain[..], &mut frame, CompressionLevel::Fastest);
        frame.shrink_to_fit();
        table.extend((frame.len() as u64).to_le_bytes());
        table.extend((bytes as u64).to_le_bytes());
        frames.push(frame);
    }
    out.write_all(&header(4, rows, facts, frames.len() as u8))?;
    out.write_all(&TABLE.to_le_bytes())?;
    out.write_all(&[0; 12])?;
    out.write_all(&table)?;
    frames.iter().try_for_each(|frame| out.write_all(frame))
}
