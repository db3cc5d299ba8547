//! Reads JSON that other programs have written.

use std::path::Path;

use serde_json::Value;

use super::DatasetError;

/// Largest file read `[bytes]`. (serde_json bounds the depth to 128.)
const MAX: u64 = 64 << 20;

/// The contents of a JSON file.
///
/// # Errors
/// When it cannot be read, or is none; the message names line and column.
pub(super) fn read(path: &Path) -> Result<Value, DatasetError> {
    let text = densify_core::files::read_text(path, MAX).map_err(DatasetError::io(path))?;
    serde_json::from_str(&text).map_err(|error| {
        let remedy = if is_at_no_number(&text, &error) {
            "NaN and Infinity, which Python writes, are no numbers of JSON: remove the frame that has them, or make \
             its pose anew"
        } else {
            "correct the file or export it again"
        };
        DatasetError::malformed(path, "JSON", &error, remedy)
    })
}

/// Whether it has NaN or an infinity where it could not be read.
fn is_at_no_number(text: &str, error: &serde_json::Error) -> bool {
    let line = text.lines().nth(error.line().saturating_sub(1)).unwrap_or_default();
    // The place is that of the first letter, or of one beside it.
    let places = error.column().saturating_sub(2)..=error.column();
    let mut rests = places.filter_map(|at| line.as_bytes().get(at..));
    rests.any(|rest| rest.starts_with(b"NaN") || rest.starts_with(b"Infinity"))
}
