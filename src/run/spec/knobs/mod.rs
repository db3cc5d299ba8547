//! The knobs: settings that trade speed or memory for accuracy. One table lists their names, domains and worst-case
//! cost.
//!
//! A knob is set with `--knob NAME=VALUE`, or in the table `[knob]` of a file. [`Knobs`] holds the knobs of a run;
//! [`Preset`]s are knobs and options that are set together.

mod presets;
mod settings;
mod table;

use std::fmt;

use crate::failure::BadInput;
use densify_render::BackendKind;

pub use presets::{DEFAULT_PRESET, EXACT, Measured, PRESETS, Preset, preset};
pub use settings::Knobs;
pub use table::KNOBS;

/// A setting that trades speed or memory for accuracy.
#[derive(Debug)]
pub struct Knob {
    /// Name, such as `alpha_min`.
    pub name: &'static str,
    /// Its value if none is set.
    pub default: &'static str,
    /// The values that it may have.
    pub domain: Domain,
    /// The unit of its values; empty for words and plain numbers.
    pub unit: &'static str,
    /// The only backend that has this knob; `None`: all backends have it.
    pub only_on: Option<BackendKind>,
    /// The worst effect on the result.
    pub class: Class,
    /// Its effect and gain, in one line.
    pub effect: &'static str,
    /// Values that `densify trade` measures, besides the default.
    pub levels: &'static [&'static str],
    /// Sets the knob to a value in the table's spelling.
    pub(super) set: fn(&mut Knobs, &str),
}

/// The values that a knob may have.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Domain {
    /// One of these words.
    Choice(&'static [&'static str]),
    /// A number, written as a decimal or a fraction such as 1/255.
    Number {
        /// Minimum.
        least: f64,
        /// Maximum.
        most: f64,
    },
}

/// The worst effect of a knob on the result.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Class {
    /// No effect: the result has the same bits.
    Exact,
    /// A bounded numerical error: the same model looks slightly different.
    Bounded,
}

/// A rejected knob, value or preset, with the nearest valid one.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum KnobError {
    /// No knob has this name.
    #[error(
        "no knob is called `{name}`; the nearest is `{nearest}`, and `densify knobs` lists them"
    )]
    Unknown {
        /// The name given.
        name: String,
        /// The name most like it.
        nearest: &'static str,
    },
    /// A value that the knob cannot have.
    #[error(
        "knob {knob}: `{value}` is outside its domain, {domain}; the nearest that works is {nearest}"
    )]
    OutOfDomain {
        /// The knob.
        knob: &'static str,
        /// The value given.
        value: String,
        /// The values that it may have.
        domain: Domain,
        /// The nearest of them.
        nearest: String,
    },
    /// No preset has this name.
    #[error("no preset is called `{name}`; the presets are {}", presets::names())]
    UnknownPreset {
        /// The name given.
        name: String,
    },
}

impl BadInput for KnobError {}

/// The knob of this name.
///
/// # Errors
/// When there is none; names the most similar knob.
pub fn find(name: &str) -> Result<&'static Knob, KnobError> {
    KNOBS.iter().find(|knob| knob.name == name).ok_or_else(|| {
        let alike = KNOBS.iter().map(|knob| (strsim::jaro_winkler(name, knob.name), knob.name));
        let nearest = alike.max_by(|a, b| a.0.total_cmp(&b.0)).map_or("", |(_, name)| name);
        KnobError::Unknown { name: name.to_owned(), nearest }
    })
}

impl Knob {
    /// A value in the table's spelling, so that equal values have equal texts.
    ///
    /// # Errors
    /// When it is outside the domain; names the nearest valid value.
    pub fn canonical(&self, text: &str) -> Result<String, KnobError> {
        let text = text.trim();
        let bad = |nearest: String| KnobError::OutOfDomain {
            knob: self.name,
            value: text.to_owned(),
            domain: self.domain,
            nearest,
        };
        match self.domain {
            Domain::Choice(words) if words.contains(&text) => Ok(text.to_owned()),
            Domain::Choice(words) => Err(bad(nearest_word(text, words).to_owned())),
            Domain::Number { least, most } => match number(text) {
                Some(value) if (least..=most).contains(&value) => Ok(self.spell(value)),
                Some(value) if value < least => Err(bad(self.spell(least))),
                Some(value) if value > most => Err(bad(self.spell(most))),
                _ => Err(bad(self.default.to_owned())),
            },
        }
    }

    /// A number as the default or a level spells it, else in the shorter of the decimal and the scientific notation.
    fn spell(&self, value: f64) -> String {
        let known = self.levels.iter().copied().chain([self.default]);
        let same =
            |text: &&str| number(text).is_some_and(|number| number.total_cmp(&value).is_eq());
        known.into_iter().find(same).map_or_else(|| shorter_notation(value), str::to_owned)
    }
}

/// Parses a decimal or a fraction.
fn number(text: &str) -> Option<f64> {
    let value = match text.split_once('/') {
        Some((above, below)) => {
            above.trim().parse::<f64>().ok()? / below.trim().parse::<f64>().ok()?
        }
        None => text.parse().ok()?,
    };
    value.is_finite().then_some(value)
}

/// The shorter of the decimal and the scientific notation of a number.
fn shorter_notation(value: f64) -> String {
    let (decimal, power) = (format!("{value}"), format!("{value:e}"));
    if power.len() < decimal.len() { power } else { decimal }
}

/// The word with the nearest number if `text` is a number, else the word most like `text`.
fn nearest_word(text: &str, words: &'static [&'static str]) -> &'static str {
    let distance = |word: &str| match (number(text), number(word)) {
        (Some(a), Some(b)) => (a - b).abs(),
        _ => 1.0 - strsim::jaro_winkler(text, word),
    };
    let nearest = words.iter().min_by(|a, b| distance(a).total_cmp(&distance(b)));
    nearest.copied().unwrap_or_default()
}

impl fmt::Display for Domain {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Choice(words) => f.write_str(&words.join("|")),
            Self::Number { least, most } => {
                let shown = |x: &f64| match 1.0 / x {
                    // 1/1024 rather than 0.0009765625.
                    inverse if inverse > 1.0 && inverse.fract() == 0.0 && *x != 0.0 => {
                        let power = format!("{x:e}");
                        if power.len() < 5 { power } else { format!("1/{inverse}") }
                    }
                    _ => shorter_notation(*x),
                };
                write!(f, "{} to {}", shown(least), shown(most))
            }
        }
    }
}

impl fmt::Display for Class {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(match self {
            Self::Exact => "exact",
            Self::Bounded => "bounded",
        })
    }
}

#[cfg(test)]
mod tests;
