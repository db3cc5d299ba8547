//! `densify compare`.

use std::path::PathBuf;

use clap::Args;

use super::console::Console;
use super::flags;
use crate::failure::Failure;
use crate::study::{Comparison, SceneBudget};

/// Trains a scene with several policies, under the same conditions, and says which did best.
///
/// Every policy runs with every budget and every seed, one run after another. A run that is
/// finished is not run again: call the same command to go on after an interruption. The folder then
/// holds compare.md (tables and pictures), compare.jsonl (a record per run), plots as SVG, and the
/// runs themselves.
///
/// Quality is measured on views held out. Differences are taken between runs of the same scene,
/// budget and seed, against the first policy named, with 95 % bootstrap intervals of their mean. A
/// run whose peak exceeded its budget is marked, and takes no part in the ranking. Where the geometry
/// is known (built-in scenes, and those that `densify scenegen` wrote), the tables also say how well
/// the Gaussians sit on it.
#[derive(Debug, Args)]
#[command(after_help = EXAMPLES)]
pub(super) struct CompareArgs {
    /// Folders of the scenes, or built-in scenes (scene:NAME)
    #[arg(required = true)]
    scenes: Vec<PathBuf>,
    /// Policies, separated by commas; the others are compared with the first. A policy with
    /// parameters of its own is one more: diet:rho=0, or diet:rho=0:split=random
    #[arg(long, value_name = "NAMES", value_delimiter = ',', required = true)]
    policies: Vec<String>,
    /// Budgets in Gaussians, separated by commas; SCENE=ROWS for one scene alone, by its folder's
    /// name, which then takes part with these only
    #[arg(short, long, value_name = "ROWS", value_delimiter = ',', required = true, value_parser = SceneBudget::parse)]
    budget: Vec<SceneBudget>,
    /// Runs of each kind, with seeds 0, 1, …
    #[arg(long, value_name = "K", default_value_t = 3, value_parser = clap::value_parser!(u32).range(1..=1000))]
    seeds: u32,
    /// Length of each run
    #[arg(short, long, value_name = "N", default_value_t = 7_000, value_parser = clap::value_parser!(u32).range(1..))]
    iterations: u32,
    /// Folder for the results
    #[arg(short, long, value_name = "DIR", default_value = "comparison")]
    output: PathBuf,
    /// Options of `densify train` for every run
    #[arg(last = true, value_name = "TRAIN OPTIONS")]
    train: Vec<String>,
}

const EXAMPLES: &str = "\
Examples:
  densify compare data/garden --policies vanilla,diet --budget 200k
  densify compare data/room data/cup --policies diet,taming,mcmc --budget 15k,30k,60k --seeds 5
  densify compare data/garden --policies vanilla,diet --budget 1M -- -r 4 --sh-degree 2
  densify compare data/room data/cup --policies vanilla,diet --budget room=28k,30k
  densify compare data/garden --policies diet,diet:rho=0,diet:full_depth=0 --budget 200k
  densify compare scene:table scene:thin --policies vanilla,diet --budget 10k --iterations 3000";

pub(super) fn run(args: &CompareArgs, console: &Console) -> Result<(), Failure> {
    let comparison = Comparison {
        scenes: args.scenes.clone(),
        policies: args.policies.clone(),
        budgets: args.budget.clone(),
        seeds: args.seeds,
        iterations: args.iterations,
        output: args.output.clone(),
        train: flags::parsed(&args.train, "densify compare ... --")?,
    };
    let finished = comparison.run(console)?;
    console.result(finished.summary);
    console.result(format_args!("everything in {}", finished.report.display()));
    Ok(())
}
