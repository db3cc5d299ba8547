//! Reads where the chunks of a LAZ file are, and how many points each has.
//!
//! Before the first chunk is the place of the table of chunks, which follows the last chunk.

use std::io::{self, Read, Seek, SeekFrom};
use std::path::Path;

use laz::laszip::{ChunkTable, ChunkTableEntry};

use super::Header;
use super::guards::{check_start, problem, without_panic};
use crate::error::LoadError;

/// Length of the place of the table `[bytes]`.
const PLACE: u64 = 8;

/// A chunk, which begins where the last one ends.
pub(super) struct Chunk {
    /// Number of points.
    pub(super) points: u64,
    /// Length `[bytes]`.
    pub(super) bytes: u64,
}

/// Reads the table of a file of this length, and moves the input to the first chunk. Each chunk but the last has
/// `chunk_size` points; without it, the table lists the numbers of points.
pub(super) fn read(
    path: &Path,
    input: &mut (impl Read + Seek),
    length: u64,
    header: &Header,
    chunk_size: Option<u32>,
) -> Result<Vec<Chunk>, LoadError> {
    let damaged = |problem: String| LoadError::damaged(path, "the table of chunks", problem);
    let broken = |error: io::Error| damaged(problem(&error));
    let first = header.begins + PLACE;
    let place = place_of_table(input, header.begins).map_err(broken)?;
    if !(first..length).contains(&place) {
        return Err(damaged(format!("its place is {place}, but the file has {length} bytes")));
    }
    let available = place - first;
    let number = number_of_chunks(input, place).map_err(broken)?;
    // Each chunk begins with a whole record. The crate takes memory for all chunks before it reads the first.
    if u64::from(number) > available / header.record as u64 {
        return Err(damaged(format!("{number} chunks do not fit into {available} bytes")));
    }
    input.seek(SeekFrom::Start(place)).map_err(LoadError::io(path))?;
    let table = without_panic(|| ChunkTable::read(input, chunk_size.is_none()));
    let table = table.map_err(broken)?;
    let chunk = |(index, entry): (usize, &ChunkTableEntry)| Chunk {
        // The crate extends numbers from 32 to 64 bits as if they had a sign.
        points: chunk_size.map_or(u64::from(entry.point_count as u32), |size| {
            let before = index as u64 * u64::from(size);
            header.count.saturating_sub(before).min(size.into())
        }),
        bytes: u64::from(entry.byte_count as u32),
    };
    let chunks: Vec<Chunk> = table.into_iter().enumerate().map(chunk).collect();
    let is_right = match chunk_size {
        Some(size) => chunks.len() as u64 == header.count.div_ceil(size.into()),
        None => chunks.iter().map(|chunk| chunk.points).sum::<u64>() == header.count,
    };
    if !is_right {
        let count = header.count;
        return Err(damaged(format!("it contradicts the number of points in the header, {count}")));
    }
    let bytes: u64 = chunks.iter().map(|chunk| chunk.bytes).sum();
    if bytes > available {
        return Err(damaged(format!("{bytes} bytes of chunks do not fit into {available} bytes")));
    }
    input.seek(SeekFrom::Start(first)).map_err(LoadError::io(path))?;
    Ok(chunks)
}

/// The place of the table in the file.
fn place_of_table(input: &mut (impl Read + Seek), begins: u64) -> io::Result<u64> {
    let mut place = [0; PLACE as usize];
    input.seek(SeekFrom::Start(begins))?;
    input.read_exact(&mut place)?;
    // Programs that cannot go back to fill it in write it at the end of the file instead.
    if place == [0xff; PLACE as usize] {
        input.seek(SeekFrom::End(-(PLACE as i64)))?;
        input.read_exact(&mut place)?;
    }
    Ok(u64::from_le_bytes(place))
}

/// The number of chunks, if the code after it, which lists them, begins correctly.
fn number_of_chunks(input: &mut (impl Read + Seek), place: u64) -> io::Result<u32> {
    let mut head = Vec::new();
    input.seek(SeekFrom::Start(place))?;
    input.take(12).read_to_end(&mut head)?;
    check_start(head.get(8..).unwrap_or_default())?;
    match head.get(4..8) {
        Some(&[a, b, c, d]) => Ok(u32::from_le_bytes([a, b, c, d])),
        _ => Err(io::ErrorKind::UnexpectedEof.into()),
    }
}
