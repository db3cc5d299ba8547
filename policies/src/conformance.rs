//! The conformance suite: what every policy must do, whoever wrote it.
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
//! The suite builds the policy from its defaults and leads it through scripted runs: models that
//! are empty, have one row, are full, or have room, and plans that refuse all growth; statistics
//! that are plausible, zero, all equal, negative, infinite, NaN, or a mixture; auxiliary views with
//! the same. [`Check`] lists what must hold, for every plan:
//!
//! - the rows never exceed the budget, nor does the plan become another; one row is left;
//! - the same input gives the same plan, and a policy saved and restored in mid-run has the same
//!   future;
//! - nothing is read that was not declared, and what is declared is sound;
//! - any statistic, none at all, and every refusal are taken in stride;
//! - the manual page is complete.
//!
//! What the suite cannot know is whether a rule is the published one: identities of single policies
//! (shares that conserve opacity, splits that keep their end points, curves that end at the budget)
//! are tests of these.

use std::fmt;

use toml::{Table, Value};

use crate::parameters::parse_value;
use crate::policy::{PolicyError, SceneInfo};
use crate::registry::PolicyEntry;

mod pattern;
mod script;

/// What must hold of a policy.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
#[non_exhaustive]
pub enum Check {
    /// It can be built from its defaults for a run of any length, its step parameters are integer
    /// parameters, and an unknown parameter is refused.
    Builds,
    /// It reads no signal, no candidates, and no column or point of an auxiliary view that its needs
    /// do not list, not even when they are there.
    ReadsOnlyWhatItDeclares,
    /// It asks for fresh views if and only if it asks for the signal that is measured in them, and
    /// for auxiliary views only if its needs say what is to be measured there.
    AsksForWhole,
    /// Every number in its needs is one that a backend can work with, and at no step is its cadence
    /// longer than declared.
    DeclaresSoundly,
    /// It plans without error or panic, whatever the signals hold and whatever the plan refuses.
    GoesOn,
    /// Its plan is the one that it was given, for these rows and this budget.
    KeepsItsPlan,
    /// It leaves at least one row of a model that had any.
    LeavesARow,
    /// From the same inputs it makes the same plan, has the same needs and is due at the same steps.
    Repeats,
    /// Saved as JSON in the midst of a run and restored, it has the same future.
    Remembers,
    /// It refuses a saved state that is not its own.
    RefusesForeignState,
    /// Its manual page has a table `| name | default | range | unit | what |` of all parameters, with
    /// the defaults that they have, and of nothing else.
    IsDocumented,
}

impl fmt::Display for Check {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Builds => "can be built from its defaults",
            Self::ReadsOnlyWhatItDeclares => "reads only what it declares",
            Self::AsksForWhole => "asks for views and what is measured in them together",
            Self::DeclaresSoundly => "declares numbers that can be worked with",
            Self::GoesOn => "goes on whatever it sees",
            Self::KeepsItsPlan => "keeps the plan that it is given",
            Self::LeavesARow => "leaves at least one row",
            Self::Repeats => "makes the same plan from the same inputs",
            Self::Remembers => "has the same future after save and restore",
            Self::RefusesForeignState => "refuses a state that is not its own",
            Self::IsDocumented => "documents its parameters",
        })
    }
}

/// Checks that failed, each with its first instance.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Report {
    /// The policy's name and where it is registered.
    pub policy: String,
    /// What failed, and how.
    pub failures: Vec<(Check, String)>,
}

impl fmt::Display for Report {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "policy {} does not conform:", self.policy)?;
        for (check, how) in &self.failures {
            write!(f, "\n- it {check}: no; {how}")?;
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

    /// Keeps the first failure of each check.
    fn add(&mut self, check: Check, how: String) {
        if self.failures.iter().all(|(known, _)| *known != check) {
            self.failures.push((check, how));
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

/// Runs every check but [`Check::IsDocumented`], with some parameters set.
///
/// # Errors
/// A report of all checks that failed.
pub fn check_policy_with(entry: &PolicyEntry, set: &Table) -> Result<(), Report> {
    let mut report = Report::new(entry);
    check_building(entry, set, &mut report);
    if report.failures.is_empty() {
        for scenario in script::scenarios() {
            if let Err((check, how)) = script::run(entry, set, &scenario) {
                report.add(check, format!("{scenario}: {how}"));
            }
        }
    }
    report.result()
}

/// Runs [`Check::IsDocumented`].
///
/// # Errors
/// A report of all parameters that are not documented as they are.
pub fn check_manual(entry: &PolicyEntry) -> Result<(), Report> {
    let manual = entry.manual();
    let table = manual.lines().skip_while(|line| !line.starts_with("| name | default |")).skip(2);
    let rows: Vec<Vec<&str>> = table
        .take_while(|line| line.starts_with('|'))
        .map(|line| line.trim_matches('|').split('|').map(str::trim).collect())
        .collect();
    let parameters = entry.parameters();
    let mut wrong: Vec<String> = Vec::new();
    for (name, default) in &parameters {
        match rows.iter().find(|row| row[0] == name) {
            None => wrong.push(format!("`{name}` is missing")),
            Some(row) if row.len() != 5 => wrong.push(format!("`{name}` has {} cells", row.len())),
            Some(row) if !is_same(&parse_value(row[1]), default) => {
                wrong.push(format!("`{name}` has the default {default}, not {}", row[1]));
            }
            Some(_) => {}
        }
    }
    let known = entry.parameter_names();
    let unknown = rows.iter().map(|row| row[0]).filter(|name| known.iter().all(|k| k != name));
    wrong.extend(unknown.map(|name| format!("`{name}` is no parameter")));
    let mut report = Report::new(entry);
    if !wrong.is_empty() {
        report.add(Check::IsDocumented, wrong.join(", "));
    }
    report.result()
}

fn is_same(documented: &Value, default: &Value) -> bool {
    let number = |value: &Value| value.as_float().or_else(|| value.as_integer().map(|v| v as f64));
    match (number(documented), number(default)) {
        (Some(documented), Some(default)) => documented.total_cmp(&default).is_eq(),
        _ => documented == default,
    }
}

fn check_building(entry: &PolicyEntry, set: &Table, report: &mut Report) {
    for iterations in [1, 7, 600, 30_000, u32::MAX] {
        let scene = SceneInfo { iterations, ..script::scene(10, 100) };
        if let Err(error) = entry.build(set, &scene) {
            report.add(Check::Builds, format!("for {iterations} steps: {error}"));
        }
    }
    let parameters = entry.parameters();
    for step in entry.step_parameters() {
        if !parameters.iter().any(|(name, value)| name == step && value.is_integer()) {
            report.add(Check::Builds, format!("`{step}` counts steps but is no integer parameter"));
        }
    }
    let unknown = Table::from_iter([("no_such_parameter".to_owned(), Value::Integer(1))]);
    match entry.build(&unknown, &script::scene(10, 100)) {
        Err(PolicyError::UnknownParameter { .. }) => {}
        Err(error) => report.add(Check::Builds, format!("an unknown parameter gives: {error}")),
        Ok(_) => report.add(Check::Builds, "an unknown parameter is accepted".to_owned()),
    }
}

#[cfg(test)]
mod tests;
