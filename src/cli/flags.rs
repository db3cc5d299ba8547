//! The options of a run as flags: shows their defaults in the help, and finds those that were given.

use std::ffi::OsString;

use clap::parser::ValueSource;
use clap::{Arg, ArgMatches, Args, Command, FromArgMatches};
use toml::{Table, Value};

use densify_run::failure::Failure;
use densify_run::{Partial, RunSpec};

/// Gives every option of a run in `command` its default: that of the default preset, else that of [`RunSpec`].
pub(super) fn with_defaults(command: Command) -> Command {
    let spec = Partial::default().describe().unwrap_or_default();
    let defaults = spec.table().unwrap_or_default();
    command.mut_args(|arg| {
        let default = defaults.get(arg.get_id().as_str());
        match default.filter(|_| arg.get_default_values().is_empty()) {
            None | Some(Value::Array(_) | Value::Table(_)) => arg,
            Some(Value::Boolean(_)) => with_default(arg, "false").hide_default_value(true),
            Some(Value::String(text)) => with_default(arg, text),
            Some(other) => with_default(arg, &other.to_string()),
        }
    })
}

fn with_default(arg: Arg, default: &str) -> Arg {
    arg.required(false).default_value(default.to_owned())
}

/// The options of a run that were given on the command line.
pub(super) fn given(matches: &ArgMatches, spec: &RunSpec) -> Result<Partial, Failure> {
    Partial::given(spec, |name| matches.value_source(name) == Some(ValueSource::CommandLine))
}

/// Parses options of `densify train` after the `--` of another `command`; the scene is not among them.
pub(super) fn parse_words(words: &[String], command: &'static str) -> Result<Partial, Failure> {
    let command = Command::new(command).no_binary_name(true).disable_help_flag(true);
    let command = with_defaults(RunSpec::augment_args(command));
    let usage =
        |error: clap::Error| Failure::input(error.to_string().trim().trim_start_matches("error: "));
    let words = words.iter().map(OsString::from);
    let matches = command.try_get_matches_from(words).map_err(usage)?;
    let spec = RunSpec::from_arg_matches(&matches).map_err(usage)?;
    given(&matches, &spec)
}

/// Fails if `--policy-set` names a policy other than that of the run.
pub(super) fn check_policy(flags: &Partial, spec: &RunSpec) -> Result<(), Failure> {
    let policy = &spec.density.policy;
    let set = flags.get("policy_set").and_then(Value::as_table);
    match set.into_iter().flat_map(Table::keys).find(|name| *name != policy) {
        None => Ok(()),
        Some(other) => Err(Failure::input(format!(
            "--policy-set sets a parameter of `{other}`, but the policy of this run is `{policy}`; \
             choose it with --policy {other}"
        ))),
    }
}

/// The text of docs/options.md: every option of a run with its help.
#[cfg(test)]
fn options_markdown() -> String {
    use std::fmt::Write as _;

    use densify_run::{OPTIONS, OnResume};

    let command = with_defaults(RunSpec::augment_args(Command::new("train")));
    let mut text = String::from(
        "# Options of `densify train`\n\nThis table is generated from the description of a run \
         (`src/run/spec/mod.rs`); `cargo t options_table` says how to renew it. In a file for `--config` an \
         option has the name of its flag, with `_` for `-`: `tile_cap = 100000`.\n",
    );
    let mut heading = "";
    for option in OPTIONS {
        let Some(arg) = command.get_arguments().find(|arg| arg.get_id() == option.name) else {
            continue;
        };
        let next = arg.get_help_heading().unwrap_or_default();
        if next != heading {
            heading = next;
            let _ = write!(
                text,
                "\n## {heading}\n\n| option | default | what it is | with --resume |\n|---|---|---|---|\n"
            );
        }
        let default: Vec<String> = arg
            .get_default_values()
            .iter()
            .map(|value| value.to_string_lossy().into_owned())
            .collect();
        let help = arg.get_help().map(ToString::to_string).unwrap_or_default();
        let on_resume = match option.on_resume {
            OnResume::Fixed => "stays",
            OnResume::Free => "may change",
            OnResume::Longer => "may grow",
        };
        let _ = writeln!(
            text,
            "| `{}` | {} | {} | {on_resume} |",
            option.flag(),
            default.join(" "),
            help.replace('|', "\\|").replace('\n', " ")
        );
    }
    text
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;

    #[test]
    fn only_given_options_are_parsed() {
        let options = ["--near", "0.04", "--eval", "--knob", "alpha_min=1/64", "--lr=opacity=0.05"];
        let given = parse_words(&options.map(str::to_owned), "train").unwrap();
        let names: Vec<&str> = given.iter().map(|(name, _)| name).collect();
        assert_eq!(names, ["eval", "knob", "lr", "near"]);
        let spec = given.describe().unwrap();
        assert!(spec.data.eval && spec.schedule.iterations.0 == 24_000);
    }

    #[test]
    fn the_options_table_is_current() {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/options.md");
        if std::env::var_os("DENSIFY_WRITE_DOCS").is_some() {
            std::fs::write(&path, options_markdown()).unwrap();
        }
        let current = std::fs::read_to_string(&path).unwrap_or_default();
        assert!(
            current == options_markdown(),
            "docs/options.md is out of date: DENSIFY_WRITE_DOCS=1 cargo t options_table"
        );
    }
}
