//! The conformance suite: tests that every policy must pass, built-in or not.
//!
//! Call [`check_policy`] in a test of the crate that defines the policy:
//!
//! ```
//! # use densify_policies::{conformance, registry};
//! let entry = registry::find("vanilla")?;
//! conformance::check_policy(entry)?;
//! conformance::check_manual(entry)?;
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! The suite builds the policy with its defaults and takes it through scripted runs. Models are empty, have
//! one row, are full or have room, and some plans refuse all growth. Statistics, also those of auxiliary
//! views, are plausible, zero, all equal, negative, extreme, infinite, NaN or a mixture. The suite checks these
//! properties, which [`Check`] defines:
//!
//! - the budget holds, and at least one row is left;
//! - the policy edits at least one of the models (some have thousands of rows, so that a small fraction is
//!   still several rows);
//! - the same input gives the same plan, and a policy saved and restored in mid-run continues identically;
//! - only declared inputs are read, and declarations are valid;
//! - neither statistics nor refusals cause an error or a panic;
//! - the manual page lists all parameters with their defaults and ranges.
//!
//! The suite cannot tell whether your rules match the paper. Test the identities of your policy yourself:
//! children that together are as opaque as their parent, splits that together keep its extent, curves that
//! end at the budget.

use std::fmt;

use toml::{Table, Value};

use crate::policy::{PolicyError, SceneInfo};
use crate::registry::PolicyEntry;

mod manual;
mod run;
mod scenarios;
mod synthetic;

pub use manual::check_manual;

/// A property that every policy must have. "It" is the policy.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
#[non_exhaustive]
pub enum Check {
    /// It can be built from its defaults for a run of any length, its step parameters are integer
    /// parameters, and an unknown parameter is refused.
    Builds,
    /// It reads no signal, no candidates, and no column or point of an auxiliary view that its needs
    /// do not list, not even if they are present.
    ReadsOnlyDeclared,
    /// It requests auxiliary views only if its needs say what to measure there.
    RequestsConsistently,
    /// Only if its needs declare [detailed edits](crate::policy::Needs::detailed_edits) does it rewrite rows, rotate
    /// children, set their scales, or change their scales separately for each axis.
    DeclaresEdits,
    /// Every number in its needs is in its range, and at no step is its cadence longer or its resolution
    /// lower than declared.
    DeclaresValidNumbers,
    /// It plans without error or panic for any statistics and any refusals.
    NeverFails,
    /// It does not replace the plan it was given by one for another number of rows or another budget.
    KeepsPlan,
    /// It leaves at least one row, unless the model was empty.
    LeavesARow,
    /// It edits a model in at least one of the scripted runs; otherwise the other checks prove nothing.
    Edits,
    /// From the same inputs it makes the same plan, has the same needs and is due at the same steps.
    IsDeterministic,
    /// Saved as JSON in mid-run and restored, it continues identically.
    RestoresState,
    /// It refuses a saved state that is not its own.
    RejectsForeignState,
    /// Its manual page has a table `| name | default | range | unit | meaning |` of exactly its
    /// parameters, with their defaults, and with ranges that the policy enforces.
    IsDocumented,
}

impl fmt::Display for Check {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Builds => "can be built from its defaults",
            Self::ReadsOnlyDeclared => "reads only what it declares",
            Self::RequestsConsistently => {
                "requests auxiliary views only if it declares what to measure in them"
            }
            Self::DeclaresEdits => "declares detailed edits",
            Self::DeclaresValidNumbers => "declares valid numbers",
            Self::NeverFails => "plans without error for any input",
            Self::KeepsPlan => "keeps the plan that it is given",
            Self::LeavesARow => "leaves at least one row",
            Self::Edits => "edits a model",
            Self::IsDeterministic => "makes the same plan from the same inputs",
            Self::RestoresState => "continues identically after save and restore",
            Self::RejectsForeignState => "refuses a state that is not its own",
            Self::IsDocumented => "documents its parameters",
        })
    }
}

/// The checks that failed, each with its first failure.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Report {
    /// The policy's name and where it is registered.
    pub policy: String,
    /// The failed checks, each with an explanation.
    pub failures: Vec<(Check, String)>,
}

impl fmt::Display for Report {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "policy {} does not conform:", self.policy)?;
        for (check, reason) in &self.failures {
            write!(f, "\n- fails the check \"{check}\": {reason}")?;
        }
        Ok(())
    }
}

impl std::error::Error for Report {}

impl Report {
    fn new(entry: &PolicyEntry) -> Self {
        let policy = format!("`{}` ({})", entry.name, entry.location());
        Self { policy, failures: Vec::new() }
    }

    /// Adds a failure, unless its check has failed before.
    fn add(&mut self, check: Check, reason: String) {
        if self.failures.iter().all(|(known, _)| *known != check) {
            self.failures.push((check, reason));
        }
    }

    fn result(self) -> Result<(), Self> {
        if self.failures.is_empty() { Ok(()) } else { Err(self) }
    }
}

/// Runs every check but [`Check::IsDocumented`], with the policy's defaults.
///
/// # Errors
/// A report of all checks that failed.
pub fn check_policy(entry: &PolicyEntry) -> Result<(), Report> {
    check_policy_with(entry, &Table::new())
}

/// Runs every check but [`Check::IsDocumented`], with the parameters in `set`.
///
/// # Errors
/// A report of all checks that failed.
pub fn check_policy_with(entry: &PolicyEntry, set: &Table) -> Result<(), Report> {
    let mut report = Report::new(entry);
    check_building(entry, set, &mut report);
    if report.failures.is_empty() {
        let mut edits_rows = false;
        for scenario in scenarios::scenarios() {
            match run::run(entry, set, &scenario) {
                Ok(edited) => edits_rows |= edited,
                Err((check, reason)) => report.add(check, format!("{scenario}: {reason}")),
            }
        }
        if !edits_rows && report.failures.is_empty() {
            let reason = "no plan of any run changed a row, although models had up to 5,000 rows and room \
                       to grow; check it with parameters with which it acts";
            report.add(Check::Edits, reason.to_owned());
        }
    }
    report.result()
}

fn check_building(entry: &PolicyEntry, set: &Table, report: &mut Report) {
    for iterations in [1, 7, 600, 30_000, u32::MAX] {
        let scene = SceneInfo { iterations, ..scenarios::scene(10, 100) };
        if let Err(error) = entry.build(set, &scene) {
            report.add(Check::Builds, format!("in a run of {iterations} steps: {error}"));
        }
    }
    let parameters = entry.parameters();
    for step in entry.step_parameters().iter().map(|step| step.name()) {
        if !parameters.iter().any(|(name, value)| name == step && value.is_integer()) {
            report.add(Check::Builds, format!("`{step}` counts steps but is not an integer"));
        }
    }
    let unknown = Table::from_iter([("no_such_parameter".to_owned(), Value::Integer(1))]);
    match entry.build(&unknown, &scenarios::scene(10, 100)) {
        Err(PolicyError::UnknownParameter { .. }) => {}
        Err(error) => report.add(Check::Builds, format!("an unknown parameter gives: {error}")),
        Ok(_) => report.add(Check::Builds, "an unknown parameter is accepted".to_owned()),
    }
}

#[cfg(test)]
mod tests;
