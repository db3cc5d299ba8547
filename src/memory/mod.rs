//! The ledger: the bytes of every buffer, promised before training; and the memory measured.
//!
//! Every buffer is allocated once, at the size of the budget. The ledger lists them, so that users
//! learn before training whether a run fits.

mod fit;
mod grant;

use std::fmt;

use serde::{Deserialize, Serialize};

pub(crate) use fit::IMAGES;
pub use fit::{Fit, PAIRS, RunSize, SizeRequest, fit, min_memory};
pub use grant::{MemoryLimit, grant};

/// All buffers of a run.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Ledger {
    /// One line per buffer.
    pub lines: Vec<LedgerLine>,
}

/// One buffer.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct LedgerLine {
    /// Part of the program that it belongs to.
    pub section: Section,
    /// What it holds.
    pub what: String,
    /// Its size `[bytes]`.
    pub bytes: u64,
    /// Whether it is in the memory of a GPU.
    #[serde(default, skip_serializing_if = "is_false")]
    pub on_device: bool,
}

#[allow(clippy::trivially_copy_pass_by_ref, reason = "serde's interface")]
fn is_false(flag: &bool) -> bool {
    !flag
}

/// Part of the program, in the order of the table.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Section {
    /// Parameters, moments, age.
    Model,
    /// Gradients of the parameters.
    Gradients,
    /// Lists of (row, tile) pairs and what belongs to each pair.
    Tiles,
    /// Buffers of the renderer that belong to no other section.
    Renderer,
    /// Signals, candidates and plans of the policy.
    Policy,
    /// Decoded images.
    Images,
    /// Held only for a moment, one at a time: evaluation, export.
    Passing,
    /// Held only while loading, and freed before any of the above is allocated.
    Before,
    /// The program itself before any of the above.
    Process,
}

impl Section {
    const fn name(self) -> &'static str {
        match self {
            Self::Model => "model",
            Self::Gradients => "gradients",
            Self::Tiles => "tile lists",
            Self::Renderer => "renderer",
            Self::Policy => "policy",
            Self::Images => "images",
            Self::Passing => "in passing",
            Self::Before => "before",
            Self::Process => "process",
        }
    }
}

impl Ledger {
    /// Adds a buffer to a section.
    pub fn add_to(&mut self, section: Section, what: impl Into<String>, bytes: u64) {
        self.lines.push(LedgerLine { section, what: what.into(), bytes, on_device: false });
    }

    /// Adds a buffer in the memory of a GPU, or adds its bytes to the line of that name.
    pub fn add_on_device(&mut self, section: Section, what: &str, bytes: u64) {
        let same =
            |line: &&mut LedgerLine| line.on_device && line.section == section && line.what == what;
        match self.lines.iter_mut().find(same) {
            Some(line) => line.bytes = line.bytes.saturating_add(bytes),
            None => {
                let what = what.to_owned();
                self.lines.push(LedgerLine { section, what, bytes, on_device: true });
            }
        }
    }

    /// The most memory held at a time `[bytes]`. Of [`Section::Passing`] and [`Section::Before`] only the
    /// largest lines count, as they are never held together; beside [`Section::Before`] there is only
    /// the process.
    #[must_use]
    pub fn total(&self) -> u64 {
        self.most_at_a_time(|_| true)
    }

    /// The same without the memory of a GPU `[bytes]`.
    #[must_use]
    pub fn on_host(&self) -> u64 {
        self.most_at_a_time(|line| !line.on_device)
    }

    fn most_at_a_time(&self, counts: impl Fn(&LedgerLine) -> bool) -> u64 {
        let (mut process, mut before, mut passing, mut lasting) = (0_u64, 0_u64, 0_u64, 0_u64);
        for line in self.lines.iter().filter(|line| counts(line)) {
            match line.section {
                Section::Process => process = process.saturating_add(line.bytes),
                Section::Before => before = before.max(line.bytes),
                Section::Passing => passing = passing.max(line.bytes),
                _ => lasting = lasting.saturating_add(line.bytes),
            }
        }
        process.saturating_add(before.max(lasting.saturating_add(passing)))
    }

    /// Sum of the buffers in the memory of a GPU, which are all held throughout `[bytes]`.
    #[must_use]
    pub fn on_device(&self) -> u64 {
        let lines = self.lines.iter().filter(|line| line.on_device);
        lines.fold(0, |sum, line| sum.saturating_add(line.bytes))
    }
}

/// A table: section, buffer, size; the total below.
impl fmt::Display for Ledger {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mut lines: Vec<_> = self.lines.iter().collect();
        lines.sort_by_key(|line| line.section);
        let least = if self.on_device() > 0 { "on the device".len() } else { 5 };
        let what_width =
            lines.iter().map(|line| line.what.chars().count()).max().unwrap_or(0).max(least);
        let mut previous = None;
        for line in lines {
            let name = if previous == Some(line.section) { "" } else { line.section.name() };
            previous = Some(line.section);
            let LedgerLine { what, bytes, .. } = line;
            writeln!(f, "  {name:<11} {what:<what_width$} {:>12}", Bytes(*bytes).to_string())?;
        }
        let total = Bytes(self.total()).to_string();
        write!(f, "  {:<11} {:<what_width$} {total:>12}", "total", "")?;
        match self.on_device() {
            0 => Ok(()),
            bytes => {
                let bytes = Bytes(bytes).to_string();
                write!(f, "\n  {:<11} {:<what_width$} {bytes:>12}", "", "on the device")
            }
        }
    }
}

/// A number of bytes, displayed with a binary unit.
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
        // 1,023.95 would print as 1024.0.
        while value >= 1023.95 && unit + 1 < UNITS.len() {
            value /= 1024.0;
            unit += 1;
        }
        write!(f, "{value:.1} {}", UNITS[unit])
    }
}

/// Resident memory of this process now `[bytes]`; `None` if unknown.
#[must_use]
pub fn resident() -> Option<u64> {
    status_line("VmRSS:")
}

/// Largest resident memory of this process so far `[bytes]`; `None` if unknown.
#[must_use]
pub fn peak_resident() -> Option<u64> {
    status_line("VmHWM:")
}

fn status_line(key: &str) -> Option<u64> {
    parse_status(&std::fs::read_to_string("/proc/self/status").ok()?, key)
}

/// Reads a line of `/proc/<pid>/status`, "VmRSS:     1234 kB" (proc(5): kB means 1,024 bytes).
fn parse_status(status: &str, key: &str) -> Option<u64> {
    let value = status.lines().find_map(|line| line.strip_prefix(key))?;
    let kibibytes: u64 = value.trim().strip_suffix("kB")?.trim().parse().ok()?;
    kibibytes.checked_mul(1024)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sample() -> Ledger {
        let mut ledger = Ledger::default();
        ledger.add_to(Section::Process, "program", 3 << 20);
        ledger.add_to(Section::Model, "parameters", 10 << 20);
        ledger.add_to(Section::Model, "moments", 20 << 20);
        ledger.add_to(Section::Renderer, "projections", 1536);
        ledger.add_to(Section::Passing, "evaluation", 5 << 20);
        ledger.add_to(Section::Passing, "export", 7 << 20);
        ledger
    }

    #[test]
    fn of_passing_buffers_only_the_largest_counts() {
        assert_eq!(sample().total(), (40 << 20) + 1536);
        let mut full = Ledger::default();
        full.add_to(Section::Renderer, "a", u64::MAX);
        full.add_to(Section::Renderer, "b", 1);
        assert_eq!(full.total(), u64::MAX);
    }

    #[test]
    fn buffers_freed_before_training_count_only_if_they_are_the_most() {
        let mut ledger = sample();
        let total = ledger.total();
        ledger.add_to(Section::Before, "loading", 30 << 20);
        ledger.add_to(Section::Before, "measuring", 37 << 20);
        assert_eq!(ledger.total(), total);
        ledger.add_to(Section::Before, "measuring more", 38 << 20);
        assert_eq!(ledger.total(), 41 << 20);
    }

    #[test]
    fn the_host_holds_the_buffers_that_are_not_on_the_device() {
        let mut ledger = sample();
        let total = ledger.total();
        ledger.add_on_device(Section::Model, "more moments", 50 << 20);
        ledger.add_to(Section::Before, "loading", 39 << 20);
        assert_eq!(ledger.on_device(), 50 << 20);
        assert_eq!(ledger.total(), total + (50 << 20));
        assert_eq!(ledger.on_host(), 42 << 20);
    }

    #[test]
    fn the_table_is_aligned_and_ordered() {
        let table = sample().to_string();
        let expected = "  model       parameters      10.0 MiB
              moments         20.0 MiB
  renderer    projections      1.5 KiB
  in passing  evaluation       5.0 MiB
              export           7.0 MiB
  process     program          3.0 MiB
  total                       40.0 MiB";
        assert_eq!(table, expected);
    }

    #[test]
    fn bytes_read_well() {
        let shown = |n| Bytes(n).to_string();
        assert_eq!(
            [0, 1023, 1024, 1536, (1 << 20) - 1, 1 << 20, 1 << 30].map(shown),
            ["0 B", "1023 B", "1.0 KiB", "1.5 KiB", "1.0 MiB", "1.0 MiB", "1.0 GiB"]
        );
    }

    #[test]
    fn status_lines() {
        let status = "Name:\tx\nVmHWM:\t   2048 kB\nVmRSS:\t     10 kB\n";
        assert_eq!(parse_status(status, "VmHWM:"), Some(2 << 20));
        assert_eq!(parse_status(status, "VmRSS:"), Some(10 << 10));
        assert_eq!(parse_status(status, "VmPeak:"), None);
        assert_eq!(parse_status("VmHWM: many kB", "VmHWM:"), None);
        if let (Some(now), Some(peak)) = (resident(), peak_resident()) {
            assert!(now > 0 && peak > 0);
        }
    }
}
