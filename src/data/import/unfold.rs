//! Decompression of exactly as many bytes as are expected, which are there before memory is taken for them.

use std::io::{self, ErrorKind, Read};
use std::path::Path;

use super::model::malformed;
use crate::dataset::DatasetError;

/// Most bytes after what is expected that are looked at for the checksum behind them.
const TAIL: u64 = 1 << 20;

/// What is said of data that no decoder takes; what they say themselves are names in their code.
pub(super) const DAMAGED: &str = "the compressed data is damaged";

/// Reads so many bytes of `field`, compressed or not.
///
/// # Errors
/// When there are fewer, the compressed data is damaged, or the file cannot be read.
pub(super) fn exactly(
    path: &Path,
    field: &str,
    input: &mut dyn Read,
    bytes: u64,
) -> Result<Vec<u8>, DatasetError> {
    let mut read = Vec::new();
    let found = input.take(bytes).read_to_end(&mut read);
    found.map_err(|source| fault(path, field, source))?;
    if (read.len() as u64) < bytes {
        let problem = format!("{} of {bytes} bytes are there (truncated?)", read.len());
        return Err(malformed(path, field, problem));
    }
    Ok(read)
}

/// Reads on to the end of compressed data, whose checksum stands there.
///
/// # Errors
/// As [`exactly`].
pub(super) fn to_the_end(
    path: &Path,
    field: &str,
    input: &mut dyn Read,
) -> Result<(), DatasetError> {
    let rest = io::copy(&mut input.take(TAIL), &mut io::sink());
    rest.map(drop).map_err(|source| fault(path, field, source))
}

/// Why data could not be read: the system, or the data.
pub(super) fn fault(path: &Path, field: &str, source: io::Error) -> DatasetError {
    match source.kind() {
        _ if source.raw_os_error().is_some() => DatasetError::io(path)(source),
        ErrorKind::UnexpectedEof => malformed(path, field, "the file ends here (truncated?)"),
        _ => malformed(path, field, DAMAGED),
    }
}
