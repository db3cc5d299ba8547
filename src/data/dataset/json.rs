//! Reads JSON files of other programs.

use std::path::Path;

use serde_json::Value;

use super::LoadError;

/// Largest file read `[bytes]`. (serde_json limits the depth to 128.)
const MAX_BYTES: u64 = 64 << 20;

/// The contents of a JSON file.
///
/// # Errors
/// When the file cannot be read or is not JSON; the message names line and column.
pub(super) fn read(path: &Path) -> Result<Value, LoadError> {
    let text = densify_core::files::read_text(path, MAX_BYTES).map_err(LoadError::io(path))?;
    serde_json::from_str(&text).map_err(|error| {
        let remedy = if is_at_nonfinite_number(&text, &error) {
            "NaN and Infinity, which Python writes, are not valid JSON: remove the frame that has them, or estimate \
             its pose again"
        } else {
            "correct the file or export it again"
        };
        LoadError::malformed(path, "JSON", &error, remedy)
    })
}

/// Returns true if parsing failed at NaN or Infinity.
fn is_at_nonfinite_number(text: &str, error: &serde_json::Error) -> bool {
    let line = text.lines().nth(error.line().saturating_sub(1)).unwrap_or_default();
    // The reported column may be off by one.
    let places = error.column().saturating_sub(2)..=error.column();
    let mut rests = places.filter_map(|at| line.as_bytes().get(at..));
    rests.any(|rest| rest.starts_with(b"NaN") || rest.starts_with(b"Infinity"))
}
