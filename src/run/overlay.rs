//! Partial descriptions of a run, and how one lies over another: defaults < preset < file < flags.

use std::path::Path;

use serde::Deserialize;
use toml::{Table, Value};

use super::spec::{OPTIONS, RunOption, RunSpec};
use crate::failure::Failure;
use crate::knobs::{self, DEFAULT_PRESET};
use densify_core::files;
use densify_policies::parameters::{nearest, parse_value};
use densify_policies::policy::RateOverrides;

/// Keys of a run's `config.toml` that are not options: the version, and what was found out.
pub(super) const FOUND_OUT: [&str; 2] = ["densify", "resolved"];

/// Some options of a run, by name, each with a value that is sound by itself.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Partial(Table);

impl Partial {
    /// Checks that every key is an option and every value one that it may have. `origin` says in messages
    /// where the table is from.
    ///
    /// # Errors
    /// Names the key, what was expected, and the nearest that would work.
    pub fn new(table: Table, origin: &str) -> Result<Self, Failure> {
        for (name, value) in &table {
            if RunOption::find(name).is_none() {
                let like = nearest(name, OPTIONS.iter().map(|option| option.name));
                let like =
                    like.map_or_else(String::new, |like| format!(" (did you mean `{like}`?)"));
                return Err(Failure::input(format!(
                    "{origin}: no option is called `{name}`{like}; docs/options.md lists them all"
                )));
            }
            let alone: Table = [(name.clone(), value.clone())].into_iter().collect();
            let spec = RunSpec::deserialize(alone);
            let spec = spec.map_err(|error| {
                let problem = error.to_string();
                Failure::input(format!("{origin}: {name}: {}", problem.trim()))
            })?;
            check_names(&spec).map_err(|error| error.within(origin))?;
        }
        Ok(Self(table))
    }

    /// Reads a TOML file that holds any of the options. The `config.toml` of a run is one; what was found
    /// out about that run is passed over.
    pub fn read(path: &Path) -> Result<Self, Failure> {
        let origin = format!("--config {}", path.display());
        let text = files::read_text(path, files::MAX_OPTIONS)
            .map_err(|e| Failure::input(e).within(&origin))?;
        let table = text.parse::<Table>();
        let mut table = table.map_err(|e| Failure::input(e.to_string().trim()).within(&origin))?;
        table.retain(|key, _| !FOUND_OUT.contains(&key));
        Self::new(table, &origin)
    }

    /// Those options of a description that `is_given` names.
    pub fn given(spec: &RunSpec, is_given: impl Fn(&str) -> bool) -> Result<Self, Failure> {
        let all = spec.table()?;
        check_names(spec)?;
        Ok(Self(all.into_iter().filter(|(name, _)| is_given(name)).collect()))
    }

    /// Everything that a description says.
    pub fn all(spec: &RunSpec) -> Result<Self, Failure> {
        Self::given(spec, |_| true)
    }

    /// A single option.
    #[must_use]
    pub fn option(name: &str, value: impl Into<Value>) -> Self {
        Self([(name.to_owned(), value.into())].into_iter().collect())
    }

    /// The levels of a preset.
    pub fn preset(name: &str) -> Result<Self, Failure> {
        let preset =
            knobs::preset(name).map_err(|error| Failure::input(format!("--preset: {error}")))?;
        Ok(preset
            .levels
            .iter()
            .fold(Self::default(), |all, (name, value)| Self::setting(name, value).over(all)))
    }

    /// An option, or else a knob, by name, with its value as text.
    #[must_use]
    pub fn setting(name: &str, value: &str) -> Self {
        let value = parse_value(value);
        match RunOption::find(name) {
            Some(_) => Self::option(name, value),
            None => Self::option("knob", [(name.to_owned(), value)].into_iter().collect::<Table>()),
        }
    }

    /// These options over others: where both have one, this one holds; tables are joined key by key.
    #[must_use]
    pub fn over(self, mut lower: Self) -> Self {
        lay(self.0, &mut lower.0);
        lower
    }

    /// The value of an option, if it is there.
    #[must_use]
    pub fn get(&self, name: &str) -> Option<&Value> {
        self.0.get(name)
    }

    /// Takes an option out.
    pub fn remove(&mut self, name: &str) {
        self.0.remove(name);
    }

    /// The options with their values.
    pub fn iter(&self) -> impl Iterator<Item = (&str, &Value)> {
        self.0.iter().map(|(name, value)| (&**name, value))
    }

    /// Whether a file with this table says the same.
    #[must_use]
    pub fn is_table(&self, table: &Table) -> bool {
        self.0 == *table
    }

    /// The table of a file that says this.
    #[must_use]
    pub fn into_table(self) -> Table {
        self.0
    }

    /// The run that these options describe, over their preset (`balanced` where they name none) and the
    /// defaults.
    pub fn describe(self) -> Result<RunSpec, Failure> {
        let name = self.get("preset").and_then(Value::as_str).unwrap_or(DEFAULT_PRESET);
        let preset = Self::preset(name)?;
        self.over(preset).spec()
    }

    /// The run that these options describe, over the defaults.
    pub(super) fn spec(self) -> Result<RunSpec, Failure> {
        RunSpec::deserialize(self.0).map_err(Failure::input)
    }
}

fn lay(upper: Table, lower: &mut Table) {
    for (key, value) in upper {
        match (value, lower.get_mut(&key)) {
            (Value::Table(upper), Some(Value::Table(lower))) => lay(upper, lower),
            (value, _) => _ = lower.insert(key, value),
        }
    }
}

/// Checks the names and values within options that hold several: knobs, learning rates, policies.
fn check_names(spec: &RunSpec) -> Result<(), Failure> {
    spec.knobs()?;
    spec.learning_rates(&RateOverrides::default())?;
    for setting in &spec.density.policy_set {
        if let [policy, _] = &setting.path[..] {
            densify_policies::registry::find(policy)
                .map_err(|error| Failure::input(format!("--policy-set: {error}")))?;
        } else {
            let name = setting.path.join(".");
            return Err(Failure::input(format!(
                "--policy-set: `{name}={}` is not of the form policy.parameter=value, such as diet.rho=0.2",
                setting.value
            )));
        }
    }
    Ok(())
}
