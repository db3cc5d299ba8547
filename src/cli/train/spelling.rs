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
use crate::knobs::{self, Domain, How, Knob};

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
    // Counts may be written as 200k here, as elsewhere.
    let counted = setting.split_once('=').and_then(|(name, value)| {
        let knob = knobs::find(name.trim()).ok()?;
        let count = number::rows(value.trim()).ok()?;
        matches!(knob.domain, Domain::Whole { .. }).then(|| format!("{}={count}", knob.name))
    });
    of(&counted.unwrap_or_else(|| setting.to_owned()))
}

/// The words of a call, those of its knobs that are something else by another name spelled as that.
/// `policy`: that of the run, where the words do not name it.
///
/// # Errors
/// When a knob is none, outside its domain, not the policy's, or contradicts another word: one
/// message that names both sides.
pub(super) fn spelled(words: &[OsString], policy: Option<&str>) -> Result<Vec<OsString>, Failure> {
    let given = matches(words)?;
    let named = given.get_one::<String>("policy").map_or("", String::as_str);
    let policy = policy.filter(|_| !is_given(&given, "policy")).unwrap_or(named);
    let mut more: Vec<OsString> = Vec::new();
    for (knob, value) in given_knobs(&given)? {
        more.extend(match knob.how {
            How::Knob | How::BuiltIn => None,
            How::Flag(flag) => option(&given, knob, &value, flag)?,
            How::Parameter(names) => parameter(&given, knob, &value, policy, names)?,
        });
    }
    // In front, where nothing makes a value of them.
    more.extend(words.iter().cloned());
    Ok(more)
}

/// The knob as an option, unless that is given as well.
fn option(
    given: &ArgMatches,
    knob: &Knob,
    value: &str,
    flag: &str,
) -> Result<Option<OsString>, Failure> {
    if !is_given(given, &id(flag)) {
        return Ok(Some(format!("{flag}={value}").into()));
    }
    let words = given.get_raw(&id(flag)).into_iter().flatten();
    let other = words.last().map(OsStr::to_string_lossy).unwrap_or_default();
    let same = parse(&format!("{}={other}", knob.name)).is_ok_and(|(_, other)| other == value);
    if same { Ok(None) } else { Err(contradiction(knob, value, &format!("{flag} {other}"))) }
}

/// The knob as a parameter of the policy, unless that is given as well.
fn parameter(
    given: &ArgMatches,
    knob: &Knob,
    value: &str,
    policy: &str,
    names: &[&str],
) -> Result<Option<OsString>, Failure> {
    let parameters = find(policy)?.parameters();
    let has = |name: &&&str| parameters.iter().any(|(parameter, _)| parameter == **name);
    let Some(name) = names.iter().find(has) else {
        return Err(Failure::input(format!(
            "--knob {}={value}: policy `{policy}` has no such setting ({}); leave it out, or choose \
             another --policy",
            knob.name,
            names.join(" or ")
        )));
    };
    let settings: Vec<&String> = given.get_many("policy_set").into_iter().flatten().collect();
    let tables = parse_overrides(&settings)
        .map_err(|error| Failure::input(format!("--policy-set: {error}")))?;
    match tables.get(policy).and_then(|table| table.get(*name)) {
        None => Ok(Some(format!("--policy-set={policy}.{name}={value}").into())),
        Some(other) if other.to_string() == value => Ok(None),
        Some(other) => {
            Err(contradiction(knob, value, &format!("--policy-set {policy}.{name}={other}")))
        }
    }
}

fn contradiction(knob: &Knob, value: &str, other: &str) -> Failure {
    Failure::input(format!(
        "--knob {}={value} and {other} contradict each other: they are one setting; give one of them",
        knob.name
    ))
}
