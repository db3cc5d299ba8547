//! Rows in pieces of bounded size, so that no file needs a second copy of a model in memory.

use std::ops::Range;

/// Rows of an array, or of a model, that go to a file at a time: a few megabytes.
pub const ROWS_AT_A_TIME: usize = 1 << 14;

/// Cuts `rows` rows into pieces of at most [`ROWS_AT_A_TIME`]; no rows are one empty piece.
pub fn pieces(rows: usize) -> impl Iterator<Item = Range<usize>> {
    let starts = (0..rows.max(1)).step_by(ROWS_AT_A_TIME);
    starts.map(move |start| start..rows.min(start + ROWS_AT_A_TIME))
}
