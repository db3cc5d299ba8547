//! Writes scalars for TensorBoard.
//!
//! The file is a sequence of TFRecords, each of them an `Event` message in protobuf encoding. Only the
//! four fields of a scalar are written (`event.proto` and `summary.proto` of TensorFlow), so that no
//! protobuf library is needed.

use std::fs::{File, OpenOptions};
use std::io::Write;
use std::path::{Path, PathBuf};
use std::time::{SystemTime, UNIX_EPOCH};

use densify_core::files::FileError;
use densify_core::files::disk::{Operation, WatchedFile, attempt};

/// Prefix of the names of event files.
pub(super) const PREFIX: &str = "events.out.tfevents.";

/// An event file, open for appending.
#[derive(Debug)]
pub struct TensorBoard {
    file: File,
    path: PathBuf,
}

impl TensorBoard {
    /// Starts an event file in a folder.
    ///
    /// # Errors
    /// [`FileError::Io`].
    pub fn create(folder: &Path) -> Result<Self, FileError> {
        let now = wall_time();
        // TensorBoard reads any file whose name contains "tfevents", in the order of their names.
        let path = folder.join(format!("{PREFIX}{:010}.densify", now as u64));
        let file = attempt(Operation::Create, &path)
            .and_then(|()| OpenOptions::new().create(true).append(true).open(&path))
            .map_err(FileError::io("create", &path))?;
        let mut board = Self { file, path };
        board.append(&version_event(now))?;
        Ok(board)
    }

    /// Continues the event file `name` in a folder, truncated to the length that it had at the checkpoint. Starts
    /// another file if it is missing or shorter, or if `name` is not the name of an event file.
    ///
    /// # Errors
    /// [`FileError::Io`].
    pub fn resume(folder: &Path, name: &str, bytes: u64) -> Result<Self, FileError> {
        let path = folder.join(name);
        let is_event_file = name.starts_with(PREFIX) && !name.contains(['/', '\\']);
        let is_whole = || path.symlink_metadata().is_ok_and(|m| m.is_file() && m.len() >= bytes);
        if !is_event_file || !is_whole() {
            return Self::create(folder);
        }
        let file = OpenOptions::new().append(true).open(&path);
        let cut = file.and_then(|file| file.set_len(bytes).map(|()| file));
        Ok(Self { file: cut.map_err(FileError::io("truncate", &path))?, path })
    }

    /// Syncs the file to disk; returns its name and length `[bytes]`.
    ///
    /// # Errors
    /// [`FileError::Io`].
    pub fn synced(&self) -> Result<(String, u64), FileError> {
        let length = attempt(Operation::Sync, &self.path)
            .and_then(|()| self.file.sync_all())
            .and_then(|()| self.file.metadata());
        let length = length.map_err(FileError::io("write", &self.path))?.len();
        let name = self.path.file_name().map(|name| name.to_string_lossy().into_owned());
        Ok((name.unwrap_or_default(), length))
    }

    /// Appends the value of each tag at `step`.
    ///
    /// # Errors
    /// [`FileError::Io`].
    pub fn scalars(&mut self, step: u32, values: &[(&str, f32)]) -> Result<(), FileError> {
        self.append(&scalar_event(wall_time(), step, values))
    }

    fn append(&mut self, event: &[u8]) -> Result<(), FileError> {
        // One write per record, so that records are complete even for concurrent readers and if the process is killed.
        let Self { file, path } = self;
        WatchedFile { file, path }.write_all(&record(event)).map_err(FileError::io("write", path))
    }
}

/// Seconds since 1970.
fn wall_time() -> f64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0.0, |since| since.as_secs_f64())
}

/// A TFRecord: length, checksum of the length, data, checksum of the data (little-endian).
fn record(data: &[u8]) -> Vec<u8> {
    let length = (data.len() as u64).to_le_bytes();
    let mut out = Vec::with_capacity(data.len() + 16);
    out.extend(length);
    out.extend(masked_crc(&length).to_le_bytes());
    out.extend(data);
    out.extend(masked_crc(data).to_le_bytes());
    out
}

/// The checksum of a TFRecord: CRC-32C, rotated and offset, so that CRCs of data that contains CRCs are not
/// degenerate.
fn masked_crc(data: &[u8]) -> u32 {
    crc32c::crc32c(data).rotate_right(15).wrapping_add(0xa282_ead8)
}

/// The first event of a file, `Event { wall_time = 1, file_version = 3 }`.
fn version_event(wall_time: f64) -> Vec<u8> {
    let mut event = Vec::new();
    put_fixed(&mut event, 1, &wall_time.to_le_bytes());
    put_bytes(&mut event, 3, b"brain.Event:2");
    event
}

/// An event `Event { wall_time = 1, step = 2, summary = 5 { value = 1 { tag = 1, simple_value = 2 } … } }`.
fn scalar_event(wall_time: f64, step: u32, values: &[(&str, f32)]) -> Vec<u8> {
    let mut summary = Vec::new();
    for (tag, scalar) in values {
        let mut value = Vec::new();
        put_bytes(&mut value, 1, tag.as_bytes());
        put_fixed(&mut value, 2, &scalar.to_le_bytes());
        put_bytes(&mut summary, 1, &value);
    }
    let mut event = Vec::new();
    put_fixed(&mut event, 1, &wall_time.to_le_bytes());
    event.push(2 << 3);
    put_varint(&mut event, u64::from(step));
    put_bytes(&mut event, 5, &summary);
    event
}

/// Appends a field of 8 or 4 bytes (wire types 1 and 5).
fn put_fixed(out: &mut Vec<u8>, field: u8, bytes: &[u8]) {
    out.push(field << 3 | if bytes.len() == 8 { 1 } else { 5 });
    out.extend(bytes);
}

/// Appends a length-delimited field (wire type 2).
fn put_bytes(out: &mut Vec<u8>, field: u8, bytes: &[u8]) {
    out.push(field << 3 | 2);
    put_varint(out, bytes.len() as u64);
    out.extend(bytes);
}

fn put_varint(out: &mut Vec<u8>, mut value: u64) {
    while value >= 0x80 {
        out.push(value as u8 | 0x80);
        value >>= 7;
    }
    out.push(value as u8);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_first_record_has_the_signature_of_event_files() {
        let first = record(&version_event(1.7e9));
        // Length 24, checksum of the length, then the tag of a double: the signature of event files.
        assert_eq!(&first[..13], b"\x18\0\0\0\0\0\0\0\xa3\x7fK\"\x09");
        assert_eq!(&first[21..36], b"\x1a\x0dbrain.Event:2");
    }

    #[test]
    fn scalar_events_have_the_expected_bytes() {
        let event = scalar_event(0.5, 300, &[("loss", 1.0), ("n", -2.0)]);
        let expected = [
            &[0x09][..],
            &0.5_f64.to_le_bytes(),
            &[0x10, 0xac, 0x02, 0x2a, 23],
            &[0x0a, 11, 0x0a, 4],
            b"loss",
            &[0x15, 0, 0, 0x80, 0x3f],
            &[0x0a, 8, 0x0a, 1],
            b"n",
            &[0x15, 0, 0, 0, 0xc0],
        ]
        .concat();
        assert_eq!(event, expected);
    }

    #[test]
    fn a_file_continues_at_the_checkpoint() {
        let root = tempfile::tempdir().unwrap();
        let mut board = TensorBoard::create(root.path()).unwrap();
        board.scalars(1, &[("loss", 0.25)]).unwrap();
        let (name, bytes) = board.synced().unwrap();
        board.scalars(2, &[("loss", 0.5)]).unwrap();
        let board = TensorBoard::resume(root.path(), &name, bytes).unwrap();
        assert_eq!(board.synced().unwrap(), (name.clone(), bytes));
        // Other files are not modified.
        let other = root.path().join("notes");
        std::fs::write(&other, "mine").unwrap();
        for foreign in ["notes", "../notes", "events.out.tfevents./../notes"] {
            let board = TensorBoard::resume(root.path(), foreign, 1).unwrap();
            assert!(board.path.file_name().unwrap().to_str().unwrap().starts_with(PREFIX));
        }
        assert_eq!(std::fs::read(&other).unwrap(), b"mine");
    }
}
