//! Accumulation of a row's gradients over tiles: in slots, always in the same order, or by atomics, in any order. The
//! kind is chosen when a device is opened.

use std::fmt;

/// Accumulation of the gradients that a row receives from tiles.
///
/// With atomics the last bits of a sum vary, so that results of training vary slightly between runs.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Accumulation {
    /// One record per (row, tile) pair; the records of a row are summed in order. Reproducible byte for byte.
    Slots,
    /// Sums within subgroups, then atomic compare-and-exchange per row.
    SubgroupCas,
    /// Sums within subgroups, then atomic `f32` addition per row.
    SubgroupAtomics,
}

impl Accumulation {
    /// All kinds, the fastest last, as measured in docs/studies/accumulation.tsv.
    pub const ALL: [Self; 3] = [Self::Slots, Self::SubgroupAtomics, Self::SubgroupCas];

    /// Value of the knob `accumulation`.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Slots => "slots",
            Self::SubgroupCas => "cas",
            Self::SubgroupAtomics => "atomics",
        }
    }

    /// The kind that has this name.
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|accumulation| accumulation.name() == name)
    }

    /// True if runs are reproducible byte for byte.
    pub const fn is_deterministic(self) -> bool {
        matches!(self, Self::Slots)
    }
}

impl fmt::Display for Accumulation {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(self.name())
    }
}
