//! The ledger: bytes per buffer, promised before training.

use serde::Serialize;

/// What is allocated, line by line.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize)]
pub struct Ledger {
    /// One line per buffer.
    pub lines: Vec<LedgerLine>,
}

/// One buffer.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct LedgerLine {
    /// What it holds.
    pub what: String,
    /// Its size [bytes].
    pub bytes: u64,
}

impl Ledger {
    /// Adds a buffer.
    pub fn add(&mut self, what: impl Into<String>, bytes: u64) {
        self.lines.push(LedgerLine {
            what: what.into(),
            bytes,
        });
    }

    /// Sum of all lines [bytes].
    #[must_use]
    pub fn total(&self) -> u64 {
        self.lines.iter().map(|line| line.bytes).sum()
    }
}
