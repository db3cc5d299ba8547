//! Compresses the arrays of an SPZ file: all in one gzip stream (version 3), or each in a zstd frame (version 4).

use std::io::{self, Write};

use flate2::Compression;
use flate2::write::GzEncoder;
use ruzstd::encoding::{CompressionLevel, compress};

use super::layout::{HEADER_OF_VERSION_4, MAGIC};

/// An array over all Gaussians: its size `[bytes]`, and a function that writes it.
pub(super) type Array<'a> = (usize, &'a dyn Fn(&mut dyn Write) -> io::Result<()>);

/// Upper bound on the memory of the gzip encoder, with its window, tables and buffer `[bytes]`; 0.35 MiB were measured.
pub(super) const GZIP_MEMORY: u64 = 1 << 19;
/// Upper bound on the memory of the zstd encoder `[bytes]`: the current and the previous block of 128 KiB, each with a
/// table of its strings.
const ZSTD_MEMORY: u64 = 4 << 20;

/// Upper bound on the memory that [`write_frames`] takes for arrays of these sizes `[bytes]`: all frames, and the
/// current array.
pub(super) fn frames_bytes(arrays: &[usize]) -> u64 {
    let frames: usize = arrays.iter().map(|&bytes| largest_frame(bytes)).sum();
    (frames + arrays.iter().max().unwrap_or(&0)) as u64 + ZSTD_MEMORY
}

/// Largest size of a frame `[bytes]`: blocks of 128 KiB that cannot be compressed are stored after a header of three
/// bytes.
fn largest_frame(bytes: usize) -> usize {
    bytes + 3 * bytes.div_ceil(1 << 17) + 32
}

/// The first 16 bytes of the header. `bytes` are the SH degree, the fractional bits of positions, and the flags.
fn header(version: u32, rows: u32, bytes: [u8; 3], frames: u8) -> Vec<u8> {
    let words = [MAGIC, version, rows].map(u32::to_le_bytes);
    [words.as_flattened(), &bytes, &[frames]].concat()
}

/// Writes version 3.
pub(super) fn write_gzip(
    rows: u32,
    bytes: [u8; 3],
    arrays: &[Array<'_>],
    out: &mut dyn Write,
) -> io::Result<()> {
    let mut out = GzEncoder::new(out, Compression::best());
    out.write_all(&header(3, rows, bytes, 0))?;
    for (_, write) in arrays {
        write(&mut out)?;
    }
    out.finish().map(drop)
}

/// Writes version 4. All frames are held, because a table of their sizes precedes them.
pub(super) fn write_frames(
    rows: u32,
    bytes: [u8; 3],
    arrays: &[Array<'_>; 6],
    out: &mut dyn Write,
) -> io::Result<()> {
    let (mut frames, mut table) = (Vec::new(), Vec::new());
    // Without bands above 0 there is no frame for them.
    let bands = usize::from(bytes[0] > 0);
    for &(size, write) in &arrays[..5 + bands] {
        let mut plain = Vec::with_capacity(size);
        write(&mut plain)?;
        let mut frame = Vec::with_capacity(largest_frame(size));
        compress(&plain[..], &mut frame, CompressionLevel::Fastest);
        frame.shrink_to_fit();
        table.extend((frame.len() as u64).to_le_bytes());
        table.extend((size as u64).to_le_bytes());
        frames.push(frame);
    }
    out.write_all(&header(4, rows, bytes, frames.len() as u8))?;
    out.write_all(&HEADER_OF_VERSION_4.to_le_bytes())?;
    out.write_all(&[0; 12])?;
    out.write_all(&table)?;
    frames.iter().try_for_each(|frame| out.write_all(frame))
}
