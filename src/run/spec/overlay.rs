//! Partial descriptions of a run, and their overlays: defaults < preset < file < flags.

use std::path::Path;

use serde::{Deserialize, Serialize};
use toml::{Table, Value};

use super::knobs::{self, DEFAULT_PRESET};
use super::{OPTIONS, RunOption, RunSpec, add_missing_parameters};
use crate::failure::{Failure, OptionProblem};
use densify_core::files;
use densify_policies::parameters::{nearest, parse_value};
use densify_policies::policy::{PixelLoss, RateOverrides};

/// Keys of a run's `config.toml` that are not options: the version and the findings.
pub(crate) const NOT_OPTIONS: [&str; 2] = ["densify", "resolved"];

/// Some options of a run by name, each with a value that is valid by itself.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "Table")]
pub struct Partial(Table);

impl TryFrom<Table> for Partial {
    type Error = Failure;

    fn try_from(table: Table) -> Result<Self, Failure> {
        Self::new(table, "spec")
    }
}

impl Partial {
    /// Checks that every key is an option and every value is valid. Messages name `origin`, the source of the table.
    ///
    /// # Errors
    /// Names the key, the expected values, and the nearest valid name.
    pub fn new(table: Table, origin: &str) -> Result<Self, Failure> {
        Self::checked(table, check_policies).map_err(|failure| failure.within(origin))
    }

    /// Checks the table of a run that was made before, as [`new`](Self::new) does, except its policies: reading a run
    /// must not import the Python files that it names.
    pub(crate) fn recorded(table: Table, origin: &str) -> Result<Self, Failure> {
        Self::checked(table, |_| Ok(())).map_err(|failure| failure.within(origin))
    }

    fn checked(
        table: Table,
        check_more: impl Fn(&RunSpec) -> Result<(), Failure>,
    ) -> Result<Self, Failure> {
        for (name, value) in &table {
            if RunOption::find(name).is_none() {
                let nearest = nearest(name, OPTIONS.iter().map(|option| option.name));
                return Err(OptionProblem::UnknownOption { name: name.clone(), nearest }.into());
            }
            let alone: Table = [(name.clone(), value.clone())].into_iter().collect();
            let spec = RunSpec::deserialize(alone);
            let malformed = |error: toml::de::Error| OptionProblem::Malformed {
                origin: name.clone(),
                problem: error.to_string().trim().to_owned(),
            };
            let spec = spec.map_err(malformed)?;
            check_names(&spec)?;
            check_more(&spec)?;
        }
        Ok(Self(table))
    }

    /// Reads a TOML file with any of the options, such as the `config.toml` of a run, whose findings are ignored. If the
    /// policy of that run has got parameters since then, they keep to what the run did.
    ///
    /// # Errors
    /// As [`new`](Self::new), and when the file cannot be read.
    pub fn read(path: &Path) -> Result<Self, Failure> {
        let read = || {
            let text = files::read_text(path, files::MAX_OPTIONS_BYTES).map_err(Failure::input)?;
            let mut table: Table = text
                .parse()
                .map_err(|error: toml::de::Error| Failure::input(error.to_string().trim()))?;
            if NOT_OPTIONS.iter().any(|&key| table.contains_key(key)) {
                add_missing_parameters(&mut table);
            }
            table.retain(|key, _| !NOT_OPTIONS.contains(&key));
            Self::checked(table, check_policies)
        };
        read().map_err(|failure| failure.within_option("config", Some(path.display().to_string())))
    }

    /// The options of a description for which `is_given` returns true.
    ///
    /// # Errors
    /// When a value is invalid.
    pub fn given(spec: &RunSpec, is_given: impl Fn(&str) -> bool) -> Result<Self, Failure> {
        let Self(all) = Self::all(spec)?;
        check_policies(spec)?;
        Ok(Self(all.into_iter().filter(|(name, _)| is_given(name)).collect()))
    }

    /// All options of a description. Its policies are not looked up.
    ///
    /// # Errors
    /// When a value is invalid.
    pub fn all(spec: &RunSpec) -> Result<Self, Failure> {
        check_names(spec)?;
        Ok(Self(spec.table()?))
    }

    /// A single option.
    pub fn option(name: &str, value: impl Into<Value>) -> Self {
        Self([(name.to_owned(), value.into())].into_iter().collect())
    }

    /// The options and knobs that a preset sets.
    ///
    /// # Errors
    /// When there is no such preset.
    pub fn preset(name: &str) -> Result<Self, Failure> {
        let preset = knobs::preset(name).map_err(|error| OptionProblem::value("preset", error))?;
        Ok(preset
            .levels
            .iter()
            .fold(Self::default(), |all, (name, value)| Self::setting(name, value).over(all)))
    }

    /// An option of this name, or else a knob, with its value as text.
    pub fn setting(name: &str, value: &str) -> Self {
        let value = parse_value(value);
        match RunOption::find(name) {
            Some(_) => Self::option(name, value),
            None => Self::option("knob", [(name.to_owned(), value)].into_iter().collect::<Table>()),
        }
    }

    /// Overlays `lower` with these options, which win; tables are joined key by key.
    #[must_use]
    pub fn over(self, mut lower: Self) -> Self {
        join(self.0, &mut lower.0);
        lower
    }

    /// The value of an option, if it is set.
    pub fn get(&self, name: &str) -> Option<&Value> {
        self.0.get(name)
    }

    /// Removes an option.
    pub fn remove(&mut self, name: &str) {
        self.0.remove(name);
    }

    /// The options with their values.
    pub fn iter(&self) -> impl Iterator<Item = (&str, &Value)> {
        self.0.iter().map(|(name, value)| (&**name, value))
    }

    /// True if `table` has exactly these options and values.
    pub fn is_table(&self, table: &Table) -> bool {
        self.0 == *table
    }

    /// The options as the table of a file.
    pub fn into_table(self) -> Table {
        self.0
    }

    /// The run that these options describe, overlaid on their preset (`balanced` if they name none) and the defaults.
    ///
    /// # Errors
    /// When the preset does not exist.
    pub fn describe(self) -> Result<RunSpec, Failure> {
        let name = self.get("preset").and_then(Value::as_str).unwrap_or(DEFAULT_PRESET);
        let preset = Self::preset(name)?;
        self.over(preset).spec()
    }

    /// The run that these options describe, overlaid on the defaults.
    pub(crate) fn spec(self) -> Result<RunSpec, Failure> {
        RunSpec::deserialize(self.0).map_err(Failure::input)
    }
}

fn join(upper: Table, lower: &mut Table) {
    for (key, value) in upper {
        match (value, lower.get_mut(&key)) {
            (Value::Table(upper), Some(Value::Table(lower))) => join(upper, lower),
            (value, _) => _ = lower.insert(key, value),
        }
    }
}

/// Checks the names in options that have several members: knobs, learning rates, settings of policies.
fn check_names(spec: &RunSpec) -> Result<(), Failure> {
    spec.knobs()?;
    spec.learning_rates(&RateOverrides::default(), PixelLoss::L1, 1.0)?;
    for setting in &spec.density.policy_set {
        if setting.path.len() != 2 {
            let name = setting.path.join(".");
            let setting = format!("{name}={}", setting.value);
            return Err(OptionProblem::PolicySetting { setting }.into());
        }
    }
    Ok(())
}

/// Imports the policies of `policy_file`, and checks that those in `policy_set` exist.
fn check_policies(spec: &RunSpec) -> Result<(), Failure> {
    spec.import_policies()?;
    spec.density.policy_set.iter().filter_map(|setting| setting.path.first()).try_for_each(|name| {
        let found = densify_policies::registry::find(name);
        found.map(drop).map_err(|error| OptionProblem::value("policy_set", error).into())
    })
}
