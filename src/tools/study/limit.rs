//! What bounds the model of a run: a number of rows, or the memory of the run.

use std::fmt;

use densify_core::memory::Bytes;
use densify_core::numbers::grouped;
use densify_run::Partial;
use toml::Value;

/// The limit under which runs are compared.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Limit {
    /// At most this many Gaussians (`--budget`).
    Rows(usize),
    /// At most this much memory `[bytes]` (`--memory`): the number of Gaussians follows from what the policy needs.
    Memory(u64),
}

impl Limit {
    /// The option that sets the limit of a run.
    pub(super) fn option(self) -> Partial {
        let (name, number) = match self {
            Self::Rows(rows) => ("budget", u64::try_from(rows).unwrap_or(u64::MAX)),
            Self::Memory(bytes) => ("memory", bytes),
        };
        Partial::option(name, Value::from(i64::try_from(number).unwrap_or(i64::MAX)))
    }

    /// The limit as a word without spaces, for the names of files: `200000`, `512MiB`.
    pub(super) fn word(self) -> String {
        match self {
            Self::Rows(rows) => rows.to_string(),
            Self::Memory(bytes) if bytes.is_multiple_of(1 << 20) => format!("{}MiB", bytes >> 20),
            Self::Memory(bytes) => format!("{bytes}B"),
        }
    }
}

impl fmt::Display for Limit {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Rows(rows) => write!(f, "{} rows", grouped(*rows)),
            Self::Memory(bytes) => write!(f, "{}", Bytes(*bytes)),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_limit_has_an_option_a_word_and_a_text() {
        for (limit, option, word, text) in [
            (Limit::Rows(28_000), "budget = 28000\n", "28000", "28,000 rows"),
            (Limit::Memory(512 << 20), "memory = 536870912\n", "512MiB", "512.0 MiB"),
            (Limit::Memory(1_000_000), "memory = 1000000\n", "1000000B", "976.6 KiB"),
        ] {
            assert_eq!(toml::to_string(&limit.option()).expect("TOML"), option);
            assert_eq!((limit.word().as_str(), limit.to_string().as_str()), (word, text));
        }
    }
}
