//! What a study varies, and at which levels.

use super::Trade;
use densify_render::{BackendChoice, BackendKind};
use densify_run::failure::Failure;
use densify_run::knobs::{Class, KNOBS, Knob, find};
use densify_run::{Observer, Partial, RunOption};

/// A knob or an option of a run that a study varies.
#[derive(Debug, Clone)]
pub(super) struct Factor {
    pub(super) name: String,
    /// Whether it may change no bit of a model.
    pub(super) is_exact: bool,
    /// Its levels besides that of `exact`.
    pub(super) levels: Vec<String>,
}

/// Levels of an option that is no knob.
enum Levels {
    These(&'static [&'static str]),
    TimesBudget(&'static [f64]),
    TimesIterations(&'static [f64]),
}

/// Options that are varied unless knobs are named, and whether they may change no bit of a model.
const OPTIONS: [(&str, bool, Levels); 6] = [
    ("tile_cap", true, Levels::TimesBudget(&[1.0, 4.0, 32.0])),
    ("image_cache", true, Levels::These(&["0", "16777216"])),
    ("preset", false, Levels::These(&["balanced", "fast", "tiny-memory"])),
    ("sh_degree", false, Levels::These(&["0", "1", "2"])),
    ("iterations", false, Levels::TimesIterations(&[0.25, 0.5, 2.0])),
    ("budget", false, Levels::TimesBudget(&[0.25, 0.5, 2.0])),
];

/// The factors that are asked for, or all that these runs have.
///
/// # Errors
/// When there is no such knob or option, or a level is outside its domain.
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
        let here = |knob: &&Knob| knob.only_on.is_none_or(|only| only == kind);
        let knobs = KNOBS.iter().filter(here).map(|knob| knob.name);
        let names = knobs.chain(OPTIONS.iter().map(|(name, ..)| *name));
        let mut all = Vec::new();
        for name in names {
            match factor(study, name, &[]).and_then(|one| check(train, &one).map(|()| one)) {
                Ok(one) => all.push(one),
                Err(failure) => {
                    observer.say(format_args!("note: {name} is left out: {failure}"));
                }
            }
        }
        return Ok(all);
    }
    let mut all: Vec<Factor> = Vec::new();
    for text in &study.knobs {
        let mut parts = text.split(':').map(str::trim);
        let name = parts.next().unwrap_or_default();
        let levels: Vec<&str> = parts.collect();
        if all.iter().any(|one| one.name == name) {
            return Err(Failure::input(format!("--knobs names {name} twice")));
        }
        let one = factor(study, name, &levels);
        let one = one.and_then(|one| check(train, &one).map(|()| one));
        all.push(one.map_err(|failure| failure.within(&format!("--knobs {text}")))?);
    }
    Ok(all)
}

/// A knob or an option by name, at these levels, or at its own where there are none.
fn factor(study: &Trade, name: &str, levels: &[&str]) -> Result<Factor, Failure> {
    let given = levels.iter().map(|level| (*level).to_owned()).collect::<Vec<_>>();
    let of_option = OPTIONS.iter().find(|(option, ..)| *option == name);
    let (is_exact, own) = match (of_option, RunOption::find(name), find(name)) {
        (Some((_, is_exact, levels)), ..) => (*is_exact, sized(study, levels)),
        (None, Some(_), _) if given.is_empty() => {
            return Err(Failure::input(format!("say at which levels, as {name}:VALUE:VALUE")));
        }
        (None, Some(_), _) => (false, Vec::new()),
        (None, None, Ok(knob)) => {
            let canonical = |level: &String| knob.canonical(level).map_err(Failure::input);
            let given = given.iter().map(canonical).collect::<Result<Vec<_>, _>>()?;
            let own = knob.levels.iter().map(|level| (*level).to_owned()).collect();
            let levels = if given.is_empty() { own } else { given };
            let is_exact = knob.class == Class::Exact;
            return Ok(Factor { name: name.to_owned(), is_exact, levels });
        }
        (None, None, Err(error)) => return Err(Failure::input(error)),
    };
    let levels = if given.is_empty() { own } else { given };
    Ok(Factor { name: name.to_owned(), is_exact, levels })
}

/// The levels for runs of this size.
fn sized(study: &Trade, levels: &Levels) -> Vec<String> {
    let times = |factors: &[f64], base: f64| {
        let level = |factor: &f64| ((base * factor).round().max(1.0) as u64).to_string();
        factors.iter().map(level).collect()
    };
    match levels {
        Levels::These(values) => values.iter().map(|v| (*v).to_owned()).collect(),
        Levels::TimesBudget(factors) => times(factors, study.budget as f64),
        Levels::TimesIterations(factors) => times(factors, f64::from(study.iterations)),
    }
}

/// Fails where a run with the factor at one of its levels would be refused for it.
fn check(train: &Partial, one: &Factor) -> Result<(), Failure> {
    for level in &one.levels {
        let setting = Partial::setting(&one.name, level).into_table();
        Partial::new(setting, &one.name)?.over(train.clone()).describe()?;
    }
    Ok(())
}
