//! `densify compare` and `densify trade`.

use super::console::Console;
use super::flags::words;
use crate::failure::Failure;
use crate::study::Finished;
pub(super) use crate::study::{Comparison, Trade};

pub(super) fn compare(args: &Comparison, console: &Console) -> Result<(), Failure> {
    let train = words(&args.train, "densify compare ... --")?;
    finish(args.run(train, console)?, console)
}

pub(super) fn trade(args: &Trade, console: &Console) -> Result<(), Failure> {
    let train = words(&args.train, "densify trade ... --")?;
    finish(args.run(train, console)?, console)
}

fn finish(Finished { summary, report }: Finished, console: &Console) -> Result<(), Failure> {
    console.result(summary);
    console.result(format_args!("everything in {}", report.display()));
    Ok(())
}
