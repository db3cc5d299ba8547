//! `densify compare` and `densify trade`.

use std::ffi::OsString;

use clap::{Args, Command, FromArgMatches};

use super::console::Console;
use super::flags::{given, with_defaults};
use crate::failure::Failure;
use crate::run::{Partial, RunSpec};
use crate::study::Finished;
pub(super) use crate::study::{Comparison, Trade};

pub(super) fn compare(args: &Comparison, console: &Console) -> Result<(), Failure> {
    let train = parsed(&args.train, "densify compare ... --")?;
    finish(args.run(train, console)?, console)
}

pub(super) fn trade(args: &Trade, console: &Console) -> Result<(), Failure> {
    let train = parsed(&args.train, "densify trade ... --")?;
    finish(args.run(train, console)?, console)
}

fn finish(Finished { summary, report }: Finished, console: &Console) -> Result<(), Failure> {
    console.result(summary);
    console.result(format_args!("everything in {}", report.display()));
    Ok(())
}

/// The options of a run in words like those after `densify train`, but for the scene.
fn parsed(words: &[String], of: &'static str) -> Result<Partial, Failure> {
    let command = Command::new(of).no_binary_name(true).disable_help_flag(true);
    let command = with_defaults(RunSpec::augment_args(command));
    let usage =
        |error: clap::Error| Failure::input(error.to_string().trim().trim_start_matches("error: "));
    let words = words.iter().map(OsString::from);
    let matches = command.try_get_matches_from(words).map_err(usage)?;
    let spec = RunSpec::from_arg_matches(&matches).map_err(usage)?;
    given(&matches, &spec)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_what_is_given_is_given() {
        let words = ["--near", "0.04", "--eval", "--knob", "alpha_min=1/64", "--lr=opacity=0.05"];
        let found = parsed(&words.map(str::to_owned), "train").unwrap();
        let names: Vec<&str> = found.iter().map(|(name, _)| name).collect();
        assert_eq!(names, ["eval", "knob", "lr", "near"]);
        let spec = found.describe().unwrap();
        assert!(spec.data.eval && spec.schedule.iterations.0 == 24_000);
    }
}
