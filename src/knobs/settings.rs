//! The knobs of a run, with what follows from them for backends and for the trainer.

use toml::{Table, Value};

use super::{KNOBS, Knob, KnobError, parse_setting};
use crate::backend::gpu::Accumulation;
use crate::backend::{Shortcuts, Storage};
use crate::trainer::Savings;

/// All knobs, each set.
#[derive(Debug, Clone, PartialEq)]
pub struct Knobs {
    /// Where a backend computes less than it could.
    pub shortcuts: Shortcuts,
    /// How parameters and moments are stored.
    pub storage: Storage,
    /// Where the trainer computes less than it could.
    pub savings: Savings,
    /// (Row, tile) pairs held per row of the budget; `None`: as `--tile-cap` and `--memory` say.
    pub pairs_per_row: Option<usize>,
    /// How a GPU adds up gradients; `None`: the fastest way that it has.
    pub accumulation: Option<Accumulation>,
    /// Each knob's value as the table spells it, in the table's order.
    values: Vec<String>,
}

impl Default for Knobs {
    fn default() -> Self {
        let mut knobs = Self {
            shortcuts: Shortcuts::default(),
            storage: Storage::default(),
            savings: Savings::NONE,
            pairs_per_row: None,
            accumulation: None,
            values: KNOBS.iter().map(|knob| knob.default.to_owned()).collect(),
        };
        for knob in KNOBS {
            (knob.set)(&mut knobs, knob.default);
        }
        knobs
    }
}

impl Knobs {
    /// The defaults, with these values by name.
    ///
    /// # Errors
    /// When there is no such knob, or its value is outside its domain.
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
    /// As [`from_table`](Self::from_table).
    pub fn set(&mut self, name: &str, value: &str) -> Result<(), KnobError> {
        let (number, value) = parse_setting(name, value)?;
        (KNOBS[number].set)(self, &value);
        self.values[number] = value;
        Ok(())
    }

    /// Each knob with its value.
    pub fn iter(&self) -> impl Iterator<Item = (&'static Knob, &str)> {
        KNOBS.iter().zip(&self.values).map(|(knob, value)| (knob, &**value))
    }

    /// Each knob that is not as it is by default.
    pub fn changed(&self) -> impl Iterator<Item = (&'static Knob, &str)> {
        self.iter().filter(|(knob, value)| !knob.is_default(value))
    }

    /// Every knob by name, as a file has them.
    #[must_use]
    pub fn table(&self) -> Table {
        self.iter().map(|(knob, value)| (knob.name.to_owned(), value.into())).collect()
    }
}
