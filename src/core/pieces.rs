//! Splits rows into pieces of bounded size, so that writing a file needs no second copy of the model.

use std::ops::Range;

/// Number of rows written to a file at a time: a few megabytes.
pub const ROWS_AT_A_TIME: usize = 1 << 14;

/// Splits `rows` rows into pieces of at most [`ROWS_AT_A_TIME`]; if there are no rows, into one empty piece.
pub fn pieces(rows: usize) -> impl Iterator<Item = Range<usize>> {
    let starts = (0..rows.max(1)).step_by(ROWS_AT_A_TIME);
    starts.map(move |start| start..rows.min(start + ROWS_AT_A_TIME))
}
