//! The instruction sets that the kernels are compiled for.

use std::fmt;
use std::str::FromStr;
use std::sync::OnceLock;

use pulp::Arch;

/// The environment variable that names the instruction set of the whole process, to compare sets on one machine.
pub const INSTRUCTIONS_VARIABLE: &str = "DENSIFY_INSTRUCTIONS";

/// Instruction sets of the native backend's kernels.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum InstructionSet {
    /// The set that [`INSTRUCTIONS_VARIABLE`] names, or the widest vectors that the machine supports.
    #[default]
    Best,
    /// No vectors.
    Scalar,
    /// AVX2, eight numbers at a time; [`Best`](Self::Best) on machines without it.
    Avx2,
}

impl InstructionSet {
    /// The set named by the environment variable [`INSTRUCTIONS_VARIABLE`], if it is set.
    ///
    /// # Errors
    /// When the variable names no set, or a set that this machine does not have.
    pub fn from_environment() -> Result<Option<Self>, String> {
        let Some(value) = std::env::var_os(INSTRUCTIONS_VARIABLE) else { return Ok(None) };
        let name = value.to_string_lossy();
        let set = name.parse().map_err(|problem| format!("{INSTRUCTIONS_VARIABLE}: {problem}"))?;
        Ok(Some(set))
    }

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
            _ => {
                static BEST: OnceLock<Arch> = OnceLock::new();
                *BEST.get_or_init(|| match Self::from_environment() {
                    Ok(Some(set)) if set != Self::Best => set.arch(),
                    _ => Arch::new(),
                })
            }
        }
    }

    /// True if the machine has the instructions.
    fn is_supported(self) -> bool {
        match self {
            Self::Best | Self::Scalar => true,
            #[cfg(target_arch = "x86_64")]
            Self::Avx2 => pulp::x86::V3::try_new().is_some(),
            #[cfg(not(target_arch = "x86_64"))]
            Self::Avx2 => false,
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

impl FromStr for InstructionSet {
    type Err = String;

    fn from_str(name: &str) -> Result<Self, String> {
        let set = match name {
            "best" => Self::Best,
            "avx2" => Self::Avx2,
            "scalar" => Self::Scalar,
            _ => {
                return Err(format!(
                    "`{name}` is not an instruction set; give best, avx2 or scalar"
                ));
            }
        };
        if set.is_supported() {
            Ok(set)
        } else {
            Err(format!("this machine has no {set}; give best or scalar"))
        }
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sets_are_named() {
        assert_eq!("best".parse(), Ok(InstructionSet::Best));
        assert_eq!("scalar".parse(), Ok(InstructionSet::Scalar));
        let avx2: Result<InstructionSet, String> = "avx2".parse();
        match avx2 {
            Ok(set) => assert_eq!(set.lanes(), 8),
            Err(problem) => assert!(problem.contains("this machine has no AVX2"), "{problem}"),
        }
        let problem = InstructionSet::from_str("sse").unwrap_err();
        assert!(problem.contains("`sse`") && problem.contains("avx2"), "{problem}");
    }
}
