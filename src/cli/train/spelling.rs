//! Knobs as words of a command line: those that are an option or a policy's parameter by another name
//! are spelled as these, so that they pass the same checks, take effect in the same place, and
//! contradict what they contradict.

use std::ffi::{OsStr, OsString};

use clap::parser::ValueSource;
use clap::{ArgMatches, Args, Command, FromArgMatches};
use densify_policies::parameters::parse_overrides;
use densify_policies::registry::find;

use super::TrainArgs;
use crate::cli::failure::Failure;
use crate::cli::number;
use crate::knobs::{self, DEFAULT_PRESET, Domain, How, Knob};

/// What parses the words after `train`.
pub(super) fn command() -> Command {
    TrainArgs::augment_args(Command::new("densify train").no_binary_name(true))
}

/// The words after `train` as matches.
pub(super) fn matches(words: &[OsString]) -> Result<ArgMatches, Failure> {
    command().try_get_matches_from(words).map_err(usage)
}

/// The words after `train` as arguments.
pub(super) fn arguments(words: &[OsString]) -> Result<TrainArgs, Failure> {
    TrainArgs::from_arg_matches(&matches(words)?).map_err(usage)
}

fn usage(error: clap::Error) -> Failure {
    Failure::input(error.to_string().trim().trim_start_matches("error: "))
}

pub(super) fn is_given(matches: &ArgMatches, id: &str) -> bool {
    matches.value_source(id) == Some(ValueSource::CommandLine)
}

/// The name of an argument as clap has it, from its flag.
pub(super) fn id(flag: &str) -> String {
    flag.trim_start_matches('-').replace('-', "_")
}

/// The knobs that are given, each once.
///
/// # Errors
/// When one is none, outside its domain, or given with two values.
pub(super) fn given_knobs(given: &ArgMatches) -> Result<Vec<(&'static Knob, String)>, Failure> {
    let mut found: Vec<(&'static Knob, String)> = Vec::new();
    for setting in given.get_many::<String>("knob").into_iter().flatten() {
        let (knob, value) = parse(setting)?;
        match found.iter().find(|(other, _)| other.name == knob.name) {
            Some((_, other)) if *other != value => {
                let name = knob.name;
                return Err(Failure::input(format!(
                    "--knob {name}={other} and --knob {name}={value} contradict each other; give one \
                     of them"
                )));
            }
            Some(_) => {}
            None => found.push((knob, value)),
        }
    }
    Ok(found)
}

/// A knob and its value from `NAME=VALUE`.
fn parse(setting: &str) -> Result<(&'static Knob, String), Failure> {
    let of = |setting: &str| {
        knobs::parse(setting).map_err(|error| Failure::input(format!("--knob: {error}")))
    };
    // Counts may be written as 200k or 1GiB here, as elsewhere.
    let counted = setting.split_once('=').and_then(|(name, value)| {
        let knob = knobs::find(name.trim()).ok()?;
        let count = match (knob.domain, knob.unit) {
            (Domain::Whole { .. }, "bytes") => number::bytes(value.trim()).ok()?,
            (Domain::Whole { .. }, _) => number::rows(value.trim()).ok()? as u64,
            _ => return None,
        };
        Some(format!("{}={count}", knob.name))
    });
    of(&counted.unwrap_or_else(|| setting.to_owned()))
}

/// Who sets a knob.
#[derive(Clone, Copy)]
enum Side {
    Knob,
    /// A preset that is given.
    Preset(&'static str),
    /// The preset of a run that names none: it yields to whatever is given.
    Default,
}

/// A knob that is set.
struct Wish {
    knob: &'static Knob,
    value: String,
    side: Side,
}

impl Wish {
    fn shown(&self) -> String {
        let (name, value) = (self.knob.name, &self.value);
        match self.side {
            Side::Knob => format!("--knob {name}={value}"),
            Side::Preset(preset) => format!("--preset {preset}, which sets {name}={value},"),
            Side::Default => format!("{name}={value}"),
        }
    }

    /// What another setting of the same says.
    fn against(&self, other: &str, same: bool) -> Result<Option<OsString>, Failure> {
        if same || matches!(self.side, Side::Default) {
            return Ok(None);
        }
        Err(Failure::input(format!(
            "{} and {other} contradict each other: they are one setting; give one of them",
            self.shown()
        )))
    }
}

/// The words of a call, those of its knobs that are something else by another name spelled as that,
/// and its preset spelled out. `resumed`: the policy of the run that goes on, which has all of its
/// knobs already.
///
/// # Errors
/// When a knob is none, outside its domain, not the policy's, or contradicts another word: one
/// message that names both sides.
pub(super) fn spelled(words: &[OsString], resumed: Option<&str>) -> Result<Vec<OsString>, Failure> {
    let given = matches(words)?;
    let named = given.get_one::<String>("policy").map_or("", String::as_str);
    let policy = resumed.filter(|_| !is_given(&given, "policy")).unwrap_or(named);
    let knobs = given_knobs(&given)?;
    let wish = |(knob, value): &(&'static Knob, String)| Wish {
        knob,
        value: value.clone(),
        side: Side::Knob,
    };
    let mut more: Vec<OsString> = Vec::new();
    for wish in knobs.iter().map(wish).chain(wishes(&given, &knobs, resumed.is_some())?) {
        more.extend(match wish.knob.how {
            How::Knob => own(&knobs, &wish)?,
            How::Flag(flag) => option(&given, &wish, flag)?,
            How::Parameter(names) => parameter(&given, &wish, policy, names)?,
        });
    }
    // In front, where nothing makes a value of them.
    more.extend(words.iter().cloned());
    Ok(more)
}

/// The levels of the preset.
fn wishes(
    given: &ArgMatches,
    knobs: &[(&'static Knob, String)],
    resumed: bool,
) -> Result<Vec<Wish>, Failure> {
    let by_knob = knobs.iter().find(|(knob, _)| knob.name == "preset").map(|(_, name)| name);
    let named = given.get_one::<String>("preset").or(by_knob);
    let preset = match named {
        Some(name) => {
            knobs::preset(name).map_err(|error| Failure::input(format!("--preset: {error}")))?
        }
        None if resumed => return Ok(Vec::new()),
        None => knobs::preset(DEFAULT_PRESET).map_err(Failure::input)?,
    };
    let side = if named.is_some() { Side::Preset(preset.name) } else { Side::Default };
    let wish = |&(name, value): &(&str, &str)| {
        let (knob, value) = parse(&format!("{name}={value}"))?;
        Ok(Wish { knob, value, side })
    };
    preset.levels.iter().map(wish).collect()
}

/// A knob that is set by `--knob` alone.
fn own(knobs: &[(&'static Knob, String)], wish: &Wish) -> Result<Option<OsString>, Failure> {
    let name = wish.knob.name;
    match knobs.iter().find(|(knob, _)| knob.name == name) {
        None => Ok(Some(format!("--knob={name}={}", wish.value).into())),
        Some((_, other)) => wish.against(&format!("--knob {name}={other}"), *other == wish.value),
    }
}

/// The knob as an option, unless that is given as well.
fn option(given: &ArgMatches, wish: &Wish, flag: &str) -> Result<Option<OsString>, Failure> {
    let (knob, value) = (wish.knob, &wish.value);
    if is_given(given, &id(flag)) {
        let words = given.get_raw(&id(flag)).into_iter().flatten();
        let other = words.last().map(OsStr::to_string_lossy).unwrap_or_default();
        let same = parse(&format!("{}={other}", knob.name)).is_ok_and(|(_, other)| other == *value);
        return wish.against(&format!("{flag} {other}"), same);
    }
    let by_knob = given_knobs(given)?.into_iter().find(|(other, _)| other.name == knob.name);
    match (wish.side, by_knob) {
        (Side::Preset(_) | Side::Default, Some((_, other))) => {
            wish.against(&format!("--knob {}={other}", knob.name), other == *value)
        }
        _ => Ok(Some(format!("{flag}={value}").into())),
    }
}

/// The knob as a parameter of the policy, unless that is given as well.
fn parameter(
    given: &ArgMatches,
    wish: &Wish,
    policy: &str,
    names: &[&str],
) -> Result<Option<OsString>, Failure> {
    let parameters = find(policy)?.parameters();
    let has = |name: &&&str| parameters.iter().any(|(parameter, _)| parameter == **name);
    let Some(name) = names.iter().find(has) else {
        return Err(Failure::input(format!(
            "{}: policy `{policy}` has no such setting ({}); leave it out, or choose another --policy",
            wish.shown(),
            names.join(" or ")
        )));
    };
    let settings: Vec<&String> = given.get_many("policy_set").into_iter().flatten().collect();
    let tables = parse_overrides(&settings)
        .map_err(|error| Failure::input(format!("--policy-set: {error}")))?;
    match tables.get(policy).and_then(|table| table.get(*name)) {
        None => Ok(Some(format!("--policy-set={policy}.{name}={}", wish.value).into())),
        Some(other) => {
            let same = other.to_string() == wish.value;
            wish.against(&format!("--policy-set {policy}.{name}={other}"), same)
        }
    }
}
