//! `densify compare` and `densify trade`.

use super::console::Console;
use super::flags::parse_words;
use densify_run::failure::Failure;
use densify_study::Finished;
pub(super) use densify_study::{Comparison, StudyRun, Trade};

pub(super) fn compare(args: &Comparison, console: &Console) -> Result<(), Failure> {
    let train = parse_words(&args.train, "densify compare ... --")?;
    print_summary(args.run(train, console)?, console)
}

pub(super) fn trade(args: &Trade, console: &Console) -> Result<(), Failure> {
    let train = parse_words(&args.train, "densify trade ... --")?;
    print_summary(args.run(train, console)?, console)
}

pub(super) fn run(args: &StudyRun, _: &Console) -> Result<(), Failure> {
    args.train()
}

/// Prints the summary; there is none yet if the runs were submitted to a scheduler.
fn print_summary(finished: Option<Finished>, console: &Console) -> Result<(), Failure> {
    let Some(Finished { summary, report }) = finished else { return Ok(()) };
    console.result(summary);
    console.result(format_args!("the report is in {}", report.display()));
    Ok(())
}
