//! The instruction sets that the kernels are compiled for.

use std::fmt;

use pulp::Arch;

/// Instruction sets of the native backend's kernels.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum InstructionSet {
    /// The widest vectors that the machine supports.
    #[default]
    Best,
    /// No vectors.
    Scalar,
    /// AVX2, eight numbers at a time; [`Best`](Self::Best) on machines without it.
    Avx2,
}

impl InstructionSet {
    /// The sets that differ on this machine, the simplest first.
    pub fn available() -> Vec<Self> {
        let mut sets = vec![Self::Best, Self::Avx2, Self::Scalar];
        sets.dedup_by_key(|set| set.lanes());
        sets.reverse();
        sets
    }

    pub(super) fn arch(self) -> Arch {
        match self {
            Self::Scalar => Arch::Scalar,
            #[cfg(target_arch = "x86_64")]
            Self::Avx2 => pulp::x86::V3::try_new().map_or_else(Arch::new, Arch::V3),
            _ => Arch::new(),
        }
    }

    /// Numbers processed at a time.
    fn lanes(self) -> usize {
        struct Lanes;
        impl pulp::WithSimd for Lanes {
            type Output = usize;
            fn with_simd<S: pulp::Simd>(self, _: S) -> usize {
                S::F32_LANES
            }
        }
        self.arch().dispatch(Lanes)
    }
}

impl fmt::Display for InstructionSet {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Best => "best",
            Self::Scalar => "scalar",
            Self::Avx2 => "AVX2",
        })
    }
}
