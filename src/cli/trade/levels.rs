//! Which knobs are measured, at which levels.

use std::ffi::OsString;

use super::TradeArgs;
use crate::cli::console::Console;
use crate::cli::failure::Failure;
use crate::cli::train;
use crate::knobs::{KNOBS, Knob, Levels, On, find};

/// A knob that is measured.
#[derive(Debug, Clone)]
pub(super) struct Chosen {
    pub(super) knob: &'static Knob,
    /// Its levels beside that of `exact`, as the table spells them.
    pub(super) levels: Vec<String>,
}

/// Options of `densify train` that are the study's to set.
const OWN_OPTIONS: [&str; 9] =
    ["--budget", "-b", "--seed", "--iterations", "-i", "--output", "-o", "--knob", "--preset"];

/// The knobs that are asked for, or all that can be set.
///
/// # Errors
/// When a knob or a level is none, or cannot be set in these runs, or an option of the runs is the
/// study's own.
pub(super) fn chosen(args: &TradeArgs, console: &Console) -> Result<Vec<Chosen>, Failure> {
    for flag in &args.train {
        let name = flag.split('=').next().unwrap_or_default();
        if OWN_OPTIONS.contains(&name) {
            return Err(Failure::input(format!(
                "{name} is set by the study itself; leave it out after `--`"
            )));
        }
    }
    if args.knobs.is_empty() {
        let mut all = Vec::new();
        let is_there = |knob: &&Knob| knob.on != On::Gpu || is_on_gpu(&args.train);
        for knob in KNOBS.iter().filter(is_there) {
            let one = Chosen { knob, levels: levels(knob, args) };
            match check(args, &one) {
                Ok(()) => all.push(one),
                Err(failure) => {
                    console
                        .say(format_args!("note: {} is left out: {}", knob.name, failure.message));
                }
            }
        }
        return Ok(all);
    }
    let mut all: Vec<Chosen> = Vec::new();
    for text in &args.knobs {
        let mut parts = text.split(':');
        let fail = |error| Failure::input(format!("--knobs {text}: {error}"));
        let knob = find(parts.next().unwrap_or_default().trim()).map_err(fail)?;
        if all.iter().any(|one| one.knob.name == knob.name) {
            return Err(Failure::input(format!("--knobs names {} twice", knob.name)));
        }
        let own: Result<Vec<String>, _> = parts.map(|level| knob.canonical(level.trim())).collect();
        let own = own.map_err(fail)?;
        let levels = if own.is_empty() { levels(knob, args) } else { own };
        let one = Chosen { knob, levels };
        check(args, &one)?;
        all.push(one);
    }
    Ok(all)
}

/// Whether these options of `train` ask for a GPU.
fn is_on_gpu(train: &[String]) -> bool {
    let names_one = |word: &String| word == "--gpu" || word.starts_with("--gpu=");
    let backend = train.windows(2).any(|words| words[0] == "--backend" && words[1] == "gpu");
    backend || train.iter().any(|word| names_one(word) || word == "--backend=gpu")
}

/// The levels of a knob in runs of this size.
fn levels(knob: &Knob, args: &TradeArgs) -> Vec<String> {
    let times = |factors: &[f64], base: f64| {
        let level = |factor: &f64| ((base * factor).round().max(1.0) as u64).to_string();
        factors.iter().map(level).collect()
    };
    match knob.levels {
        Levels::Values(values) => values.iter().map(|v| (*v).to_owned()).collect(),
        Levels::TimesBudget(factors) => times(factors, args.budget as f64),
        Levels::TimesIterations(factors) => times(factors, f64::from(args.iterations)),
    }
}

/// Fails where a run with the knob would be refused for it.
fn check(args: &TradeArgs, one: &Chosen) -> Result<(), Failure> {
    for level in &one.levels {
        let setting = format!("{}={level}", one.knob.name);
        let words = ["scene".to_owned(), "--knob".to_owned(), setting];
        let words = words.iter().chain(&args.train).map(OsString::from);
        train::arguments(&words.collect::<Vec<_>>())?;
    }
    Ok(())
}
