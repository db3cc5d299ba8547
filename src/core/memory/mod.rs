//! Memory: the ledger of a run's buffers, and the memory of this process as measured.

mod ledger;
mod process;

use std::fmt;

pub use ledger::{Ledger, LedgerLine, Section};
pub use process::{parse_status, peak_resident, resident, status_line};

/// A number of bytes, displayed in binary units.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Bytes(pub u64);

impl fmt::Display for Bytes {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        const UNITS: [&str; 4] = ["KiB", "MiB", "GiB", "TiB"];
        if self.0 < 1024 {
            return write!(f, "{} B", self.0);
        }
        let mut value = self.0 as f64 / 1024.0;
        let mut unit = 0;
        // 1,023.95 would be rounded to 1024.0.
        while value >= 1023.95 && unit + 1 < UNITS.len() {
            value /= 1024.0;
            unit += 1;
        }
        write!(f, "{value:.1} {}", UNITS[unit])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bytes_are_shown_in_binary_units() {
        let shown = |n| Bytes(n).to_string();
        assert_eq!(
            [0, 1023, 1024, 1536, (1 << 20) - 1, 1 << 20, 1 << 30].map(shown),
            ["0 B", "1023 B", "1.0 KiB", "1.5 KiB", "1.0 MiB", "1.0 MiB", "1.0 GiB"]
        );
    }
}
