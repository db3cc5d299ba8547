//! Reads as many bytes as a header declares, compressed or not. Memory grows with the bytes that arrive, never with
//! the declared number.

use std::io::{self, ErrorKind, Read};
use std::path::Path;

use crate::error::LoadError;

/// Maximum number of bytes that are read after the expected ones to reach the checksum.
const MAX_TAIL: u64 = 1 << 20;

/// Message for damaged compressed data; the decoders' own messages are internal identifiers.
pub(super) const DAMAGED: &str = "the compressed data is damaged";

/// Reads `bytes` bytes for `field`.
///
/// # Errors
/// When there are fewer bytes, the compressed data is damaged, or the file cannot be read.
pub(super) fn read_exactly(
    path: &Path,
    field: &str,
    input: &mut dyn Read,
    bytes: u64,
) -> Result<Vec<u8>, LoadError> {
    let mut read = Vec::new();
    let result = input.take(bytes).read_to_end(&mut read);
    result.map_err(|source| read_error(path, field, source))?;
    if (read.len() as u64) < bytes {
        let problem = format!("{} of {bytes} bytes are there (truncated?)", read.len());
        return Err(LoadError::damaged(path, field, problem));
    }
    Ok(read)
}

/// Reads to the end of compressed data, so that the decoder checks the checksum there.
///
/// # Errors
/// As [`read_exactly`].
pub(super) fn read_to_end(path: &Path, field: &str, input: &mut dyn Read) -> Result<(), LoadError> {
    let rest = io::copy(&mut input.take(MAX_TAIL), &mut io::sink());
    rest.map(drop).map_err(|source| read_error(path, field, source))
}

/// Converts a read error: errors of the operating system are kept, all others mean damaged data.
pub(super) fn read_error(path: &Path, field: &str, source: io::Error) -> LoadError {
    match source.kind() {
        _ if source.raw_os_error().is_some() => LoadError::io(path)(source),
        ErrorKind::UnexpectedEof => {
            LoadError::damaged(path, field, "the file ends here (truncated?)")
        }
        _ => LoadError::damaged(path, field, DAMAGED),
    }
}
