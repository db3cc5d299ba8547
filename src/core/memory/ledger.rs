//! The ledger: the size of every buffer of a run, known before training.
//!
//! Every buffer is allocated once, at the size that the budget requires. The ledger lists them, so that users
//! learn before training whether a run fits.

use std::fmt;

use serde::{Deserialize, Serialize};

use crate::numbers::grouped;

/// All buffers of a run.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Ledger {
    /// One line per buffer.
    pub lines: Vec<LedgerLine>,
}

/// One buffer.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct LedgerLine {
    /// The part of the program, or phase of the run, that uses it.
    pub section: Section,
    /// Its contents.
    pub what: String,
    /// Its size `[bytes]`.
    pub bytes: u64,
    /// True if it is in GPU memory.
    #[serde(default, skip_serializing_if = "is_false")]
    pub on_device: bool,
}

#[allow(clippy::trivially_copy_pass_by_ref, reason = "serde's interface")]
fn is_false(flag: &bool) -> bool {
    !flag
}

/// Sections of the ledger's table, in their order: parts of the program, or phases of a run.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Section {
    /// Parameters, optimiser moments and ages.
    Model,
    /// Gradients of the parameters.
    Gradients,
    /// Lists of (row, tile) pairs and the data per pair.
    Tiles,
    /// All other buffers of the renderer.
    Renderer,
    /// Signals, candidates and plans of the policy.
    Policy,
    /// Decoded images.
    Images,
    /// Allocated briefly during training, one at a time: evaluation, export.
    Passing,
    /// Allocated only while loading, and freed before training.
    Before,
    /// Allocated only after training, when the host's training buffers have been freed.
    After,
    /// The program itself.
    Process,
}

impl Section {
    /// The name in the table.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Model => "model",
            Self::Gradients => "gradients",
            Self::Tiles => "tile lists",
            Self::Renderer => "renderer",
            Self::Policy => "policy",
            Self::Images => "images",
            Self::Passing => "in passing",
            Self::Before => "before",
            Self::After => "after",
            Self::Process => "process",
        }
    }
}

impl Ledger {
    /// Adds a buffer to a section.
    pub fn add_to(&mut self, section: Section, what: impl Into<String>, bytes: u64) {
        self.lines.push(LedgerLine { section, what: what.into(), bytes, on_device: false });
    }

    /// Adds a buffer in GPU memory; adds its bytes to the section's line of the same name if there is one.
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

    /// Peak memory `[bytes]`: that of the process itself plus that of the largest phase (loading, training, or
    /// measuring after training).
    pub fn total(&self) -> u64 {
        peak(&self.lines.iter().collect::<Vec<_>>())
    }

    /// Peak host memory until the end of training `[bytes]`.
    pub fn on_host(&self) -> u64 {
        let lines = self.lines.iter();
        let lines = lines.filter(|line| !line.on_device && line.section != Section::After);
        peak(&lines.collect::<Vec<_>>())
    }

    /// Peak GPU memory `[bytes]`: all buffers that stay allocated from the start of training to the run's end, or those
    /// before.
    pub fn on_device(&self) -> u64 {
        let (before, lasting): (Vec<_>, Vec<_>) = self
            .lines
            .iter()
            .filter(|line| line.on_device)
            .partition(|line| line.section == Section::Before);
        let before = before.iter().map(|line| line.bytes).max().unwrap_or(0);
        before.max(sum(lasting.iter().map(|line| line.bytes)))
    }
}

fn sum(bytes: impl Iterator<Item = u64>) -> u64 {
    bytes.fold(0, u64::saturating_add)
}

fn peak(lines: &[&LedgerLine]) -> u64 {
    let held = held_at_peak(lines);
    sum(lines.iter().zip(held).filter(|(_, is_held)| *is_held).map(|(line, _)| line.bytes))
}

/// Finds the lines whose buffers exist at the peak: those of the process and those of the largest phase.
///
/// Only the largest line counts in each of [`Section::Passing`], [`Section::Before`] and [`Section::After`], as the
/// buffers of such a section never coexist; in [`Section::Before`], the largest in GPU memory counts too. All other buffers
/// in GPU memory coexist with those of [`Section::After`], but not with those of [`Section::Before`].
fn held_at_peak(lines: &[&LedgerLine]) -> Vec<bool> {
    let largest = |section, on_device| {
        let is_one = |i: &usize| lines[*i].section == section && lines[*i].on_device == on_device;
        (0..lines.len()).filter(is_one).rev().max_by_key(|&i| lines[i].bytes)
    };
    let [passing, before, after] =
        [Section::Passing, Section::Before, Section::After].map(|section| largest(section, false));
    let before_on_device = largest(Section::Before, true);
    let is_before = |i: usize| lines[i].section == Section::Before;
    let is_lasting = |i: usize| lines[i].section < Section::Passing;
    let phases: [&dyn Fn(usize) -> bool; 3] = [
        &|i| Some(i) == before || Some(i) == before_on_device,
        &|i| after.is_some() && (Some(i) == after || (lines[i].on_device && !is_before(i))),
        &|i| Some(i) == passing || is_lasting(i),
    ];
    let bytes = |is_held: &&dyn Fn(usize) -> bool| {
        sum((0..lines.len()).filter(|&i| is_held(i)).map(|i| lines[i].bytes))
    };
    // Of equally large phases, this is the last: training.
    let largest = phases.iter().copied().max_by_key(bytes);
    let is_held = |i: usize| {
        lines[i].section == Section::Process || largest.is_some_and(|is_held| is_held(i))
    };
    (0..lines.len()).map(is_held).collect()
}

/// A table of section, buffer and size, with the total below. Sizes of buffers that do not exist at the peak are in
/// parentheses; the others add up to the total, to the last digit.
impl fmt::Display for Ledger {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mut lines: Vec<_> = self.lines.iter().collect();
        lines.sort_by_key(|line| line.section);
        let min_width = if self.on_device() > 0 { "on the device".len() } else { 5 };
        let what_width =
            lines.iter().map(|line| line.what.chars().count()).max().unwrap_or(0).max(min_width);
        let (mut previous, mut sum) = (None, 0_u64);
        for (line, is_held) in lines.iter().zip(held_at_peak(&lines)) {
            let name = if previous == Some(line.section) { "" } else { line.section.name() };
            previous = Some(line.section);
            let before = sum;
            let size = if is_held {
                sum = sum.saturating_add(line.bytes);
                // The difference of two rounded sums, so that the printed sizes add up.
                format!("{:>14}", mebibytes(tenths(sum) - tenths(before)))
            } else {
                format!("{:>15}", format!("({})", mebibytes(tenths(line.bytes))))
            };
            writeln!(f, "  {name:<11} {:<what_width$} {size}", line.what)?;
        }
        let row = |name: &str, what: &str, bytes| {
            format!("  {name:<11} {what:<what_width$} {:>14}", mebibytes(tenths(bytes)))
        };
        f.write_str(&row("total", "", self.total()))?;
        match self.on_device() {
            0 => Ok(()),
            bytes => write!(f, "\n{}", row("", "on the device", bytes)),
        }
    }
}

/// Tenths of a mebibyte, rounded.
fn tenths(bytes: u64) -> u64 {
    ((u128::from(bytes) * 10 + (1 << 19)) >> 20) as u64
}

fn mebibytes(tenths: u64) -> String {
    let whole = usize::try_from(tenths / 10).unwrap_or(usize::MAX);
    format!("{}.{} MiB", grouped(whole), tenths % 10)
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
    fn only_the_largest_passing_buffer_counts() {
        assert_eq!(sample().total(), (40 << 20) + 1536);
        let mut full = Ledger::default();
        full.add_to(Section::Renderer, "a", u64::MAX);
        full.add_to(Section::Renderer, "b", 1);
        assert_eq!(full.total(), u64::MAX);
    }

    #[test]
    fn buffers_freed_before_training_count_only_if_they_are_the_peak() {
        let mut ledger = sample();
        let total = ledger.total();
        ledger.add_to(Section::Before, "loading", 30 << 20);
        ledger.add_to(Section::Before, "measuring", 37 << 20);
        assert_eq!(ledger.total(), total);
        ledger.add_to(Section::Before, "measuring more", 38 << 20);
        assert_eq!(ledger.total(), 41 << 20);
        // Buffers in GPU memory coexist with those allocated after training.
        ledger.add_to(Section::After, "measuring the model", 39 << 20);
        assert_eq!(ledger.total(), 42 << 20);
        ledger.add_on_device(Section::Renderer, "on the device", 2 << 20);
        assert_eq!((ledger.total(), ledger.on_host()), (44 << 20, 41 << 20));
        // Of buffers in GPU memory, those before training and the others never coexist.
        ledger.add_on_device(Section::Before, "measuring there", 1 << 20);
        assert_eq!((ledger.total(), ledger.on_device()), (44 << 20, 2 << 20));
        ledger.add_on_device(Section::Before, "measuring more there", 50 << 20);
        assert_eq!((ledger.total(), ledger.on_host()), (91 << 20, 41 << 20));
        assert_eq!(ledger.on_device(), 50 << 20);
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
    fn the_table_is_aligned_and_adds_up() {
        let mut ledger = sample();
        // Each size alone would be rounded down, but the sum is rounded up.
        for what in ["a", "b", "c"] {
            ledger.add_to(Section::Policy, what, 40 << 10);
        }
        let expected = "  model       parameters        10.0 MiB
              moments           20.0 MiB
  renderer    projections        0.0 MiB
  policy      a                  0.0 MiB
              b                  0.1 MiB
              c                  0.0 MiB
  in passing  evaluation        (5.0 MiB)
              export             7.0 MiB
  process     program            3.0 MiB
  total                         40.1 MiB";
        assert_eq!(ledger.to_string(), expected);
        ledger.add_to(Section::Before, "loading", 1 << 30);
        let table = ledger.to_string();
        for words in ["(10.0 MiB)", "(7.0 MiB)", " 1,024.0 MiB", " 1,027.0 MiB"] {
            assert!(table.contains(words), "{words}: {table}");
        }
    }
}
