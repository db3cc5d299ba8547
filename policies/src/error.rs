//! Errors of policies and of the registry.

use crate::signals::{AuxColumn, Signal};

/// The result of a policy's methods.
pub type PolicyResult<T = ()> = Result<T, PolicyError>;

/// The reason why a policy cannot be built or cannot continue.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum PolicyError {
    /// The policy read a signal that its [`needs`](crate::policy::DensityPolicy::needs) do not
    /// list.
    #[error("signal {signal:?} was read but not declared; list it in `needs`")]
    Undeclared {
        /// The undeclared signal.
        signal: Signal,
    },
    /// The policy read a column of an auxiliary view that its
    /// [`Needs::aux`](crate::policy::Needs::aux) does not list.
    #[error("column {column:?} was read but not declared; list it in `needs` under `aux`")]
    UndeclaredColumn {
        /// The undeclared column.
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
        /// The policy's parameter with the most similar name.
        nearest: Option<String>,
    },
    /// A parameter's value has the wrong type or is out of its range.
    #[error("parameter `{policy}.{parameter}`: {reason}")]
    BadParameter {
        /// The policy.
        policy: String,
        /// The parameter.
        parameter: String,
        /// The problem, and the values that are accepted.
        reason: String,
    },
    /// Two policies are registered under one name.
    #[error("policy `{name}` is registered twice: {first} and {second}; rename one")]
    DuplicateName {
        /// The name.
        name: String,
        /// Location of the first (file:line).
        first: String,
        /// Location of the second (file:line).
        second: String,
    },
    /// A saved state belongs to another policy.
    #[error("saved state does not fit: {0}")]
    State(String),
    /// Any other reason.
    #[error("{0}")]
    Other(String),
}

fn did_you_mean(nearest: Option<&str>) -> String {
    nearest.map_or_else(String::new, |n| format!(" (did you mean `{n}`?)"))
}
