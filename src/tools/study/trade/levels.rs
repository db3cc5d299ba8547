//! The factors of a study and their levels.

use super::Trade;
use densify_render::{BackendChoice, BackendKind};
use densify_run::failure::Failure;
use densify_run::knobs::{Class, KNOBS, Knob, find};
use densify_run::{Observer, Partial, RunOption};

/// A knob or option that the study varies.
#[derive(Debug, Clone)]
pub(super) struct Factor {
    pub(super) name: String,
    /// True if the factor must not change the model at all.
    pub(super) is_exact: bool,
    /// Levels to try, besides the level in the preset `exact`.
    pub(super) levels: Vec<String>,
}

/// Default levels of an option that is not a knob.
enum Levels {
    Values(&'static [&'static str]),
    TimesBudget(&'static [f64]),
    TimesIterations(&'static [f64]),
}

/// Options that are varied by default: name, [`Factor::is_exact`] and levels.
const OPTIONS: [(&str, bool, Levels); 6] = [
    ("tile_cap", true, Levels::TimesBudget(&[1.0, 4.0, 32.0])),
    ("image_cache", true, Levels::Values(&["0", "16777216"])),
    ("preset", false, Levels::Values(&["balanced", "fast", "tiny-memory"])),
    ("sh_degree", false, Levels::Values(&["0", "1", "2"])),
    ("iterations", false, Levels::TimesIterations(&[0.25, 0.5, 2.0])),
    ("budget", false, Levels::TimesBudget(&[0.25, 0.5, 2.0])),
];

/// The factors named by `--knobs`, or all that apply to these runs.
///
/// # Errors
/// If a knob or option does not exist, or does not accept a level.
pub(super) fn factors(
    study: &Trade,
    train: &Partial,
    observer: &dyn Observer,
) -> Result<Vec<Factor>, Failure> {
    let spec = train.clone().describe()?;
    let kind = match spec.device.backend {
        BackendChoice::Gpu => BackendKind::Gpu,
        _ if spec.device.gpu.is_some() => BackendKind::Gpu,
        _ => BackendKind::Cpu,
    };
    if study.knobs.is_empty() {
        let applies = |knob: &&Knob| knob.only_on.is_none_or(|only| only == kind);
        let knobs = KNOBS.iter().filter(applies).map(|knob| knob.name);
        let names = knobs.chain(OPTIONS.iter().map(|(name, ..)| *name));
        let mut factors = Vec::new();
        for name in names {
            match checked_factor(study, train, name, &[]) {
                Ok(factor) => factors.push(factor),
                Err(error) => observer.say(format_args!("note: {name} is left out: {error}")),
            }
        }
        return Ok(factors);
    }
    let mut factors: Vec<Factor> = Vec::new();
    for text in &study.knobs {
        let mut parts = text.split(':').map(str::trim);
        let name = parts.next().unwrap_or_default();
        let levels: Vec<&str> = parts.collect();
        if factors.iter().any(|factor| factor.name == name) {
            return Err(Failure::input(format!("--knobs names {name} twice")));
        }
        let factor = checked_factor(study, train, name, &levels);
        factors.push(factor.map_err(|failure| failure.within(&format!("--knobs {text}")))?);
    }
    Ok(factors)
}

/// The knob or option of this name at the given levels, or at its default levels if none are given.
///
/// # Errors
/// If a run would refuse the option or a level.
fn checked_factor(
    study: &Trade,
    train: &Partial,
    name: &str,
    levels: &[&str],
) -> Result<Factor, Failure> {
    let mut given: Vec<String> = levels.iter().map(|level| (*level).to_owned()).collect();
    let (is_exact, defaults) =
        if let Some((_, is_exact, levels)) = OPTIONS.iter().find(|(option, ..)| *option == name) {
            (*is_exact, levels.for_study(study))
        } else if RunOption::find(name).is_some() {
            if given.is_empty() {
                return Err(Failure::input(format!("give the levels, as in {name}:VALUE:VALUE")));
            }
            (false, Vec::new())
        } else {
            let knob = find(name).map_err(Failure::input)?;
            let canonical = |level: &String| knob.canonical(level).map_err(Failure::input);
            given = given.iter().map(canonical).collect::<Result<_, _>>()?;
            let defaults = knob.levels.iter().map(|level| (*level).to_owned()).collect();
            (knob.class == Class::Exact, defaults)
        };
    let levels = if given.is_empty() { defaults } else { given };
    for level in &levels {
        let setting = Partial::setting(name, level).into_table();
        Partial::new(setting, name)?.over(train.clone()).describe()?;
    }
    Ok(Factor { name: name.to_owned(), is_exact, levels })
}

impl Levels {
    /// The levels for runs with the budget and length of a study.
    fn for_study(&self, study: &Trade) -> Vec<String> {
        let scale = |base: f64, factors: &[f64]| {
            let level = |factor: &f64| ((base * factor).round().max(1.0) as u64).to_string();
            factors.iter().map(level).collect()
        };
        match self {
            Self::Values(values) => values.iter().map(|value| (*value).to_owned()).collect(),
            Self::TimesBudget(factors) => scale(study.budget as f64, factors),
            Self::TimesIterations(factors) => scale(f64::from(study.iterations), factors),
        }
    }
}
