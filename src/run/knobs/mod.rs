//! The knobs: settings that trade speed or memory for accuracy, in one table with what each is called, what
//! it may be and what it costs at worst.
//!
//! A knob is set with `--knob NAME=VALUE`, or in the table `[knob]` of a file. [`Knobs`] holds those of a
//! run; [`Preset`]s are knobs and options that go together.

mod presets;
mod settings;
mod table;

use std::fmt;

pub use presets::{DEFAULT_PRESET, EXACT, Measured, PRESETS, Preset, preset};
pub use settings::Knobs;
pub use table::KNOBS;

/// A setting that trades speed or memory for accuracy.
#[derive(Debug)]
pub struct Knob {
    /// Its name.
    pub name: &'static str,
    /// Its default value.
    pub default: &'static str,
    /// What it may be.
    pub domain: Domain,
    /// The unit of its values; empty for words and plain numbers.
    pub unit: &'static str,
    /// What it can do to the result, at worst.
    pub class: Class,
    /// What it does and what that gains, in a line.
    pub effect: &'static str,
    /// Values that `densify trade` measures, besides the default.
    pub levels: &'static [&'static str],
    /// Sets it to a value in the table's spelling.
    pub(super) set: fn(&mut Knobs, &str),
}

/// What a knob may be.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Domain {
    /// One of these words.
    Choice(&'static [&'static str]),
    /// A number, written as a decimal or a fraction such as 1/255.
    Number {
        /// The least.
        least: f64,
        /// The most.
        most: f64,
    },
}

/// What a knob can do to the result, at worst.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Class {
    /// The same bits.
    Exact,
    /// A numerical error: the same model looks a little different.
    Bounded,
}

/// A rejected knob or value, with the nearest valid one.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{0}")]
pub struct KnobError(pub(crate) String);

/// The knob of this name.
///
/// # Errors
/// When there is none, with the name most like it.
pub fn find(name: &str) -> Result<&'static Knob, KnobError> {
    KNOBS.iter().find(|knob| knob.name == name).ok_or_else(|| {
        let alike = KNOBS.iter().map(|knob| (strsim::jaro_winkler(name, knob.name), knob.name));
        let nearest = alike.max_by(|a, b| a.0.total_cmp(&b.0)).map_or("", |(_, name)| name);
        KnobError(format!(
            "no knob is called `{name}`; the nearest is `{nearest}`, and `densify knobs` lists them"
        ))
    })
}

impl Knob {
    /// A value as the table spells it, so that equal values are equal texts.
    ///
    /// # Errors
    /// When it is outside the domain, with the nearest that is not.
    pub fn canonical(&self, text: &str) -> Result<String, KnobError> {
        let text = text.trim();
        let bad = |nearest: String| {
            let Self { name, domain, .. } = self;
            KnobError(format!(
                "knob {name}: `{text}` is outside its domain, {domain}; the nearest that works is \
                 {nearest}"
            ))
        };
        match self.domain {
            Domain::Choice(words) if words.contains(&text) => Ok(text.to_owned()),
            Domain::Choice(words) => Err(bad(nearest_word(text, words).to_owned())),
            Domain::Number { least, most } => match number(text) {
                Some(value) if (least..=most).contains(&value) => Ok(self.spelled(value)),
                Some(value) if value < least => Err(bad(self.spelled(least))),
                Some(value) if value > most => Err(bad(self.spelled(most))),
                _ => Err(bad(self.default.to_owned())),
            },
        }
    }

    /// A number as the default, the levels or the ends of the domain spell it, else as a decimal.
    fn spelled(&self, value: f64) -> String {
        let known = self.levels.iter().copied().chain([self.default]);
        let same =
            |text: &&str| number(text).is_some_and(|number| number.total_cmp(&value).is_eq());
        known.into_iter().find(same).map_or_else(|| plain(value), str::to_owned)
    }
}

/// A decimal or a fraction.
fn number(text: &str) -> Option<f64> {
    let value = match text.split_once('/') {
        Some((above, below)) => {
            above.trim().parse::<f64>().ok()? / below.trim().parse::<f64>().ok()?
        }
        None => text.parse().ok()?,
    };
    value.is_finite().then_some(value)
}

/// The shorter of the two ways to write a number.
fn plain(value: f64) -> String {
    let (decimal, power) = (format!("{value}"), format!("{value:e}"));
    if power.len() < decimal.len() { power } else { decimal }
}

/// The number among the words nearest to a number, else the word most like a word.
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
                    _ => plain(*x),
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
