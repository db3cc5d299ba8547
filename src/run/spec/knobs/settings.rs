//! The knobs of a run, and the settings of backends and of the trainer that follow from them.

use std::collections::BTreeMap;

use toml::{Table, Value};

use super::{KNOBS, Knob, KnobError, find};
use densify_render::Accumulation;
use densify_render::{Shortcuts, Storage};

/// Values of all knobs.
#[derive(Debug, Clone, PartialEq)]
pub struct Knobs {
    /// Computations that a backend skips.
    pub shortcuts: Shortcuts,
    /// Storage of parameters and moments.
    pub storage: Storage,
    /// Maximum number of (row, tile) pairs per row of the budget; `None`: it follows from `--tile-cap` and `--memory`.
    pub pairs_per_row: Option<usize>,
    /// The order in which a GPU adds up gradients; `None`: the fastest that it has.
    pub accumulation: Option<Accumulation>,
    /// The values that were set, by name of the knob, in the table's spelling.
    values: BTreeMap<&'static str, String>,
}

impl Default for Knobs {
    fn default() -> Self {
        let mut knobs = Self {
            shortcuts: Shortcuts::default(),
            storage: Storage::default(),
            pairs_per_row: None,
            accumulation: None,
            values: BTreeMap::new(),
        };
        for knob in KNOBS {
            (knob.set)(&mut knobs, knob.default);
        }
        knobs
    }
}

impl Knobs {
    /// The knobs of this table; the others have their defaults.
    ///
    /// # Errors
    /// When a name is not a knob, or its value is outside the knob's domain.
    pub fn from_table(table: &Table) -> Result<Self, KnobError> {
        let mut knobs = Self::default();
        for (name, value) in table {
            let text = match value {
                Value::String(text) => text.clone(),
                other => other.to_string(),
            };
            knobs.set(name, &text)?;
        }
        Ok(knobs)
    }

    /// Sets a knob.
    ///
    /// # Errors
    /// When a name is not a knob, or its value is outside the knob's domain.
    pub fn set(&mut self, name: &str, value: &str) -> Result<(), KnobError> {
        let knob = find(name)?;
        let value = knob.canonical(value)?;
        (knob.set)(self, &value);
        self.values.insert(knob.name, value);
        Ok(())
    }

    /// Each knob with its value.
    pub fn iter(&self) -> impl Iterator<Item = (&'static Knob, &str)> {
        KNOBS
            .iter()
            .map(|knob| (knob, self.values.get(knob.name).map_or(knob.default, String::as_str)))
    }

    /// Each knob whose value is not the default.
    pub fn changed(&self) -> impl Iterator<Item = (&'static Knob, &str)> {
        self.iter().filter(|(knob, value)| *value != knob.default)
    }

    /// All knobs by name, with their values, as in files.
    pub fn table(&self) -> Table {
        self.iter().map(|(knob, value)| (knob.name.to_owned(), value.into())).collect()
    }
}
