//! How a row's gradients are added up over tiles: in slots, always in the same order, or by atomics, in
//! any order. The way is chosen when a device is opened.

use std::fmt;

/// How the gradients that a row gets from its tiles are added up.
///
/// On a device that adds by atomics the last bits of a sum depend on chance, and so does what training
/// arrives at, from run to run.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Accumulation {
    /// One record per (row, tile) pair, and a row's records summed in order: the same bytes every time.
    Slots,
    /// Within subgroups, then to the rows by comparing and exchanging whole numbers.
    SubgroupCas,
    /// Within subgroups, then to the rows by atomic addition of `f32`.
    SubgroupAtomics,
}

impl Accumulation {
    /// All of them, the fastest last, as measured in docs/studies/accumulation.tsv.
    pub const ALL: [Self; 3] = [Self::Slots, Self::SubgroupAtomics, Self::SubgroupCas];

    /// Its name, as the knob `accumulation` has it.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Slots => "slots",
            Self::SubgroupCas => "cas",
            Self::SubgroupAtomics => "atomics",
        }
    }

    /// The one of this name.
    #[must_use]
    pub fn of_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|way| way.name() == name)
    }

    /// Whether a device gives the same bytes every time.
    #[must_use]
    pub const fn is_deterministic(self) -> bool {
        matches!(self, Self::Slots)
    }
}

impl fmt::Display for Accumulation {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(self.name())
    }
}
