//! Errors of policies and of the registry.

use crate::signals::{AuxColumn, Signal};

/// What a policy returns: nothing or a value, unless it cannot go on.
pub type PolicyResult<T = ()> = Result<T, PolicyError>;

/// Why a policy cannot be built or cannot go on.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum PolicyError {
    /// The policy read a signal that its [`needs`](crate::policy::DensityPolicy::needs) do not
    /// list.
    #[error("signal {signal:?} was read but not declared; list it in `needs`")]
    Undeclared {
        /// The signal in question.
        signal: Signal,
    },
    /// The policy read a column of an auxiliary view that its
    /// [`Needs::aux`](crate::policy::Needs::aux) do not list.
    #[error("column {column:?} was read but not declared; list it in `needs` under `aux`")]
    UndeclaredColumn {
        /// The column in question.
        column: AuxColumn,
    },
    /// No policy has this name.
    #[error("unknown policy `{name}`{}; `densify policies` lists them", did_you_mean(.nearest.as_deref()))]
    UnknownPolicy {
        /// The requested name.
        name: String,
        /// The registered name most similar to it.
        nearest: Option<String>,
    },
    /// The policy has no such parameter.
    #[error("policy `{policy}` has no parameter `{parameter}`{}; `densify policies {policy}` lists them", did_you_mean(.nearest.as_deref()))]
    UnknownParameter {
        /// The policy.
        policy: String,
        /// The requested parameter.
        parameter: String,
        /// Its parameter most similar to it.
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
    /// Any other reason to stop.
    #[error("{0}")]
    Other(String),
}

fn did_you_mean(nearest: Option<&str>) -> String {
    nearest.map_or_else(String::new, |n| format!(" (did you mean `{n}`?)"))
}
