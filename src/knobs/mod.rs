//! Every setting that trades speed or memory for accuracy, in one table: what it is called, what it
//! may be, what it costs at worst, and how it is set.
//!
//! A *knob* is a name for a setting. Some knobs are options of `densify train` or parameters of a
//! policy by another name ([`How`]); the others are set by `--knob` alone, and stand in `[knobs]` of
//! `config.toml`. [`Settings`] holds these.

mod presets;
mod settings;
mod table;

use std::fmt;

pub use presets::{DEFAULT_PRESET, EXACT, Measured, PRESETS, Preset, preset};
pub use settings::Settings;
pub use table::KNOBS;

/// A setting that trades speed or memory for accuracy.
#[derive(Debug)]
pub struct Knob {
    /// Its name.
    pub name: &'static str,
    /// What it is where nobody says otherwise; words in brackets where that is not one value.
    pub default: &'static str,
    /// What it may be.
    pub domain: Domain,
    /// Of its values; empty for words and plain numbers.
    pub unit: &'static str,
    /// What it can do to the result, at worst.
    pub class: Class,
    /// Which backends have it.
    pub on: On,
    /// How it is set.
    pub how: How,
    /// What it is and what it buys, in a line.
    pub what: &'static str,
    /// Values that `densify trade` measures.
    pub levels: Levels,
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
    /// A whole number.
    Whole {
        /// The least.
        least: u64,
        /// The most.
        most: u64,
    },
}

/// What a knob can do to the result, at worst.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Class {
    /// The same bits.
    Exact,
    /// A numerical error: the same model looks a little different.
    Bounded,
    /// Another outcome of training.
    Heuristic,
}

/// Which backends have a knob.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum On {
    /// Both.
    Both,
    /// The native backend.
    Native,
    /// The GPU backend.
    Gpu,
}

/// How a knob is set.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum How {
    /// With `--knob NAME=VALUE`.
    Knob,
    /// With an option of `densify train`; `--knob` is another name for it.
    Flag(&'static str),
    /// With the first of these parameters that the policy has; `--knob` is another name for it.
    Parameter(&'static [&'static str]),
}

/// Values of a knob that `densify trade` measures, beside its default.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Levels {
    /// These.
    Values(&'static [&'static str]),
    /// So many times the budget of the run.
    TimesBudget(&'static [f64]),
    /// So many times the iterations of the run.
    TimesIterations(&'static [f64]),
}

/// Why a knob cannot be what it was to be: one message with the nearest that works.
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

/// Takes `NAME=VALUE` apart.
///
/// # Errors
/// When it has another form, no knob has the name, or the value is outside its domain.
pub fn parse(setting: &str) -> Result<(&'static Knob, String), KnobError> {
    let Some((name, value)) = setting.split_once('=') else {
        return Err(KnobError(format!(
            "`{setting}` is not of the form NAME=VALUE, such as alpha_min=1/128"
        )));
    };
    let knob = find(name.trim())?;
    let value = knob.canonical(value.trim())?;
    Ok((knob, value))
}

impl Knob {
    /// A value as the table spells it, so that equal values are equal texts.
    ///
    /// # Errors
    /// When it is outside the domain, with the nearest that is not.
    pub fn canonical(&self, text: &str) -> Result<String, KnobError> {
        let bad = |nearest: String| {
            let Self { name, domain, .. } = self;
            KnobError(format!(
                "knob {name}: `{text}` is outside its domain, {domain}; the nearest that works is \
                 {nearest}"
            ))
        };
        match self.domain {
            Domain::Choice(words) => {
                if words.contains(&text) {
                    return Ok(text.to_owned());
                }
                Err(bad(nearest_word(text, words).to_owned()))
            }
            Domain::Number { least, most } => match number(text) {
                Some(value) if (least..=most).contains(&value) => Ok(self.spelled(value)),
                Some(value) if value < least => Err(bad(self.spelled(least))),
                Some(value) if value > most => Err(bad(self.spelled(most))),
                _ => Err(bad(self.default.to_owned())),
            },
            Domain::Whole { least, most } => match text.parse::<f64>() {
                Ok(value) if value < least as f64 => Err(bad(least.to_string())),
                Ok(value) if value > most as f64 => Err(bad(most.to_string())),
                Ok(value) if value.fract() == 0.0 => Ok((value as u64).to_string()),
                Ok(value) if value.is_finite() => Err(bad((value.round() as u64).to_string())),
                _ => Err(bad(least.to_string())),
            },
        }
    }

    /// A number as the default, the levels or the ends of the domain spell it, else as a decimal.
    fn spelled(&self, value: f64) -> String {
        let levels = match self.levels {
            Levels::Values(values) => values,
            _ => &[],
        };
        let known = levels.iter().copied().chain([self.default]);
        let same =
            |text: &&str| number(text).is_some_and(|number| number.total_cmp(&value).is_eq());
        known.into_iter().find(same).map_or_else(|| plain(value), str::to_owned)
    }

    /// Whether a value, as [`canonical`](Self::canonical) spells it, is the default.
    #[must_use]
    pub fn is_default(&self, value: &str) -> bool {
        value == self.default
    }

    /// Fails where a backend would have to be what it cannot be.
    ///
    /// # Errors
    /// When the value is not the default and the backend that is to train lacks the knob.
    pub fn check_backend(&self, value: &str, gpu: bool) -> Result<(), KnobError> {
        let (here, other) = match (self.on, gpu) {
            (On::Native, true) => ("GPU", "cpu"),
            (On::Gpu, false) => ("native", "gpu"),
            (On::Both, _) | (On::Native, false) | (On::Gpu, true) => return Ok(()),
        };
        if self.is_default(value) {
            return Ok(());
        }
        let Self { name, default, .. } = self;
        Err(KnobError(format!(
            "knob {name}={value}: the {here} backend does not have it; the nearest that works there \
             is {name}={default}, or use --backend {other}"
        )))
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
            Self::Whole { least, most } if *most >= u64::from(u32::MAX) => {
                write!(f, "{least} or more")
            }
            Self::Whole { least, most } => write!(f, "{least} to {most}"),
        }
    }
}

impl fmt::Display for Class {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(match self {
            Self::Exact => "exact",
            Self::Bounded => "bounded",
            Self::Heuristic => "heuristic",
        })
    }
}

#[cfg(test)]
mod tests;
