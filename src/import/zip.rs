//! Reads the files of a ZIP archive (PKWARE APPNOTE 6.3), stored or deflated, below 4 GiB.

use std::io::{BufReader, Read, Seek, SeekFrom};
use std::path::Path;

use flate2::read::DeflateDecoder;

use super::model::{largest, malformed};
use super::unfold::{exactly, fault};
use crate::dataset::DatasetError;

/// Bytes of the record at the archive's end, without its comment.
const END: u64 = 22;
/// Most files that are listed: a model has eight.
const MAX_FILES: usize = 4096;

/// An archive, with its table of contents.
pub(super) struct Archive<'a, R> {
    path: &'a Path,
    input: BufReader<R>,
    length: u64,
    files: Vec<Entry>,
}

struct Entry {
    name: String,
    deflated: bool,
    packed: u64,
    unfolded: u64,
    crc: u32,
    offset: u64,
}

impl<'a, R: Read + Seek> Archive<'a, R> {
    /// Reads the table of contents.
    pub(super) fn open(path: &'a Path, input: R, length: u64) -> Result<Self, DatasetError> {
        let mut archive = Self { path, input: BufReader::new(input), length, files: Vec::new() };
        // The last record, before a comment of at most 64 KiB.
        let tail = length.min(END + 0xffff);
        let bytes = archive.at(length - tail, tail)?;
        let is_end = |at: &usize| bytes[*at..].starts_with(b"PK\x05\x06");
        let last = bytes.len().checked_sub(END as usize);
        let found = last.and_then(|last| (0..=last).rev().find(is_end));
        let at = found.ok_or_else(|| {
            malformed(path, "archive", "its table of contents is missing (truncated?)")
        })?;
        let (count, size) = (half(&bytes, at + 10), u64::from(word(&bytes, at + 12)));
        let start = u64::from(word(&bytes, at + 16));
        if start + size > length || usize::from(count) > MAX_FILES {
            return Err(malformed(
                path,
                "archive",
                "its table of contents cannot be where it says",
            ));
        }
        let table = archive.at(start, size)?;
        let mut at = 0;
        for _ in 0..count {
            let record = table.get(at..at + 46).filter(|record| record.starts_with(b"PK\x01\x02"));
            let record = record.ok_or_else(|| malformed(path, "archive", "an entry is damaged"))?;
            let [name, extra, comment] = [28, 30, 32].map(|at| usize::from(half(record, at)));
            let text = table.get(at + 46..at + 46 + name).unwrap_or_default();
            archive.files.push(Entry {
                name: String::from_utf8_lossy(text).into_owned(),
                deflated: match half(record, 10) {
                    0 => false,
                    8 => true,
                    other => {
                        let problem =
                            format!("its compression {other} is neither stored nor deflate");
                        return Err(malformed(path, "archive", problem));
                    }
                },
                crc: word(record, 16),
                packed: u64::from(word(record, 20)),
                unfolded: u64::from(word(record, 24)),
                offset: u64::from(word(record, 42)),
            });
            at += 46 + name + extra + comment;
        }
        Ok(archive)
    }

    /// The contents of a file.
    pub(super) fn read(&mut self, name: &str) -> Result<Vec<u8>, DatasetError> {
        let found = self.files.iter().position(|file| file.name == name);
        let missing = || malformed(self.path, "archive", format!("there is no {name:?} in it"));
        let index = found.ok_or_else(missing)?;
        let Entry { deflated, packed, unfolded, crc, offset, .. } = self.files[index];
        if unfolded > largest(self.length) || (!deflated && packed != unfolded) {
            let problem =
                format!("{unfolded} bytes are too many for an archive of {}", self.length);
            return Err(malformed(self.path, name, problem));
        }
        let local = self.at(offset, 30)?;
        if !local.starts_with(b"PK\x03\x04") {
            return Err(malformed(self.path, name, "it is not where the table of contents says"));
        }
        let start = offset + 30 + u64::from(half(&local, 26)) + u64::from(half(&local, 28));
        self.seek(start)?;
        let mut stored = (&mut self.input).take(packed);
        let bytes = match deflated {
            true => exactly(self.path, name, &mut DeflateDecoder::new(stored), unfolded)?,
            false => exactly(self.path, name, &mut stored, unfolded)?,
        };
        let mut sum = flate2::Crc::new();
        sum.update(&bytes);
        match sum.sum() == crc {
            true => Ok(bytes),
            false => Err(malformed(self.path, name, "its checksum is wrong")),
        }
    }

    fn seek(&mut self, to: u64) -> Result<(), DatasetError> {
        let sought = self.input.seek(SeekFrom::Start(to));
        sought.map(drop).map_err(|source| fault(self.path, "archive", source))
    }

    fn at(&mut self, offset: u64, bytes: u64) -> Result<Vec<u8>, DatasetError> {
        self.seek(offset)?;
        exactly(self.path, "archive", &mut self.input, bytes)
    }
}

fn half(bytes: &[u8], at: usize) -> u16 {
    u16::from_le_bytes([bytes[at], bytes[at + 1]])
}

fn word(bytes: &[u8], at: usize) -> u32 {
    u32::from_le_bytes(std::array::from_fn(|i| bytes[at + i]))
}
