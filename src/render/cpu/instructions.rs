//! The instruction sets that the kernels are compiled for.

use std::fmt;

use pulp::Arch;

/// What the kernels of the native backend may use of a processor.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum InstructionSet {
    /// All that the machine has.
    #[default]
    Best,
    /// One number at a time.
    Scalar,
    /// Eight numbers at a time; as [`Best`](Self::Best) where the machine lacks AVX2.
    Avx2,
}

impl InstructionSet {
    /// Those that differ on this machine, the plainest first.
    #[must_use]
    pub fn available() -> Vec<Self> {
        let mut all = vec![Self::Best, Self::Avx2, Self::Scalar];
        all.dedup_by_key(|set| set.lanes());
        all.reverse();
        all
    }

    pub(super) fn arch(self) -> Arch {
        match self {
            Self::Scalar => Arch::Scalar,
            #[cfg(target_arch = "x86_64")]
            Self::Avx2 => pulp::x86::V3::try_new().map_or_else(Arch::new, Arch::V3),
            _ => Arch::new(),
        }
    }

    /// Numbers that are processed at a time.
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
