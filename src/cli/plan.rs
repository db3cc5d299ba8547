//! `densify plan`: the memory that a run would need, without training.

use clap::ArgMatches;

use super::console::Console;
use super::threads;
use super::train::{Follower, TrainArgs};
use densify_run::failure::Failure;
use densify_run::plan;

/// Prints the ledger of a run, and the sizes of models that would fit into the same memory. Writes nothing.
pub(super) fn run(
    args: &TrainArgs,
    matches: &ArgMatches,
    console: &Console,
) -> Result<(), Failure> {
    if args.resume {
        return Err(Failure::input(
            "--resume: a resumed run has the size that it began with (config.toml); leave --resume \
             out to plan a new run",
        ));
    }
    let follower = Follower::new(console);
    let (spec, _) = args.describe(matches, &follower)?;
    threads::limit(spec.device.threads);
    let plan = plan(&spec, args.host(&follower))?;
    for line in &plan.lines {
        console.result(line);
    }
    console.result(plan.alternatives);
    Ok(())
}
