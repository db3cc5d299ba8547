//! `densify compare` and `densify trade`.

use super::console::Console;
use super::flags::words;
use densify_run::failure::Failure;
use densify_study::Finished;
pub(super) use densify_study::{Comparison, StudyRun, Trade};

pub(super) fn compare(args: &Comparison, console: &Console) -> Result<(), Failure> {
    let train = words(&args.train, "densify compare ... --")?;
    finish(args.run(train, console)?, console)
}

pub(super) fn trade(args: &Trade, console: &Console) -> Result<(), Failure> {
    let train = words(&args.train, "densify trade ... --")?;
    finish(args.run(train, console)?, console)
}

pub(super) fn run(args: &StudyRun, _: &Console) -> Result<(), Failure> {
    args.train()
}

/// Prints the results, unless a scheduler still has runs to do.
fn finish(done: Option<Finished>, console: &Console) -> Result<(), Failure> {
    let Some(Finished { summary, report }) = done else { return Ok(()) };
    console.result(summary);
    console.result(format_args!("everything in {}", report.display()));
    Ok(())
}
