//! What can go wrong with a policy.

use crate::policy::{AuxColumn, Signal};

/// Why a policy cannot be built or cannot go on.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum PolicyError {
    /// A signal was read that [`DensityPolicy::needs`](crate::policy::DensityPolicy::needs) did not list, or that
    /// [`DensityPolicy::wants_fresh`](crate::policy::DensityPolicy::wants_fresh) did not want at this event.
    #[error("signal {signal:?} was read but not declared; list it in `needs`{}", and_ask(*.signal))]
    Undeclared {
        /// The signal in question.
        signal: Signal,
    },
    /// A column of an auxiliary view was read that [`Needs::aux`](crate::policy::Needs::aux) did not list.
    #[error("column {column:?} was read but not declared; list it in `needs` under `aux`")]
    UndeclaredColumn {
        /// The column in question.
        column: AuxColumn,
    },
    /// No policy has this name.
    #[error("unknown policy `{name}`{}; `densify policies` lists them", did_you_mean(.nearest.as_deref()))]
    UnknownPolicy {
        /// The name asked for.
        name: String,
        /// The registered name most like it.
        nearest: Option<String>,
    },
    /// The policy has no such parameter.
    #[error("policy `{policy}` has no parameter `{parameter}`{}; `densify policies {policy}` lists them", did_you_mean(.nearest.as_deref()))]
    UnknownParameter {
        /// The policy.
        policy: String,
        /// The parameter asked for.
        parameter: String,
        /// Its parameter most like it.
        nearest: Option<String>,
    },
    /// A parameter's value has the wrong type or is out of its range.
    #[error("parameter `{policy}.{parameter}`: {reason}")]
    BadParameter {
        /// The policy.
        policy: String,
        /// The parameter.
        parameter: String,
        /// What is wrong, and what would be right.
        reason: String,
    },
    /// Two policies are registered under one name.
    #[error("policy `{name}` is registered twice: {first} and {second}; rename one")]
    DuplicateName {
        /// The name.
        name: String,
        /// Where the first is (file:line).
        first: String,
        /// Where the second is (file:line).
        second: String,
    },
    /// A saved state is not this policy's.
    #[error("saved state does not fit: {0}")]
    State(String),
    /// Anything else that makes going on pointless.
    #[error("{0}")]
    Other(String),
}

fn and_ask(signal: Signal) -> &'static str {
    match signal {
        Signal::FreshWeightMax => " with `fresh_views`, and want it at this event (`wants_fresh`)",
        _ => "",
    }
}

fn did_you_mean(nearest: Option<&str>) -> String {
    nearest.map_or_else(String::new, |n| format!(" (did you mean `{n}`?)"))
}
