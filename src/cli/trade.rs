//! `densify trade`.

use std::path::PathBuf;

use clap::Args;

use super::console::Console;
use super::flags;
use crate::failure::Failure;
use crate::number;
use crate::run::DEFAULT_BUDGET;
use crate::study::Trade;

/// Measures what each shortcut costs and buys.
///
/// For every knob (`densify knobs`) and each of its levels: how far off the same model's images are,
/// against a renderer in float64; and what training with it arrives at, on views held out, with time
/// by stage and memory at its peak. One knob at a time from the preset `exact`, with the same seeds; then
/// those that stand out together, in a design of twelve runs.
///
/// A run that is finished is not run again: call the same command to go on after an interruption. The
/// folder then holds trade.md (tables and plots), trade.jsonl (a record per line), plots as SVG, and
/// the runs themselves. "Free" is said only of what costs less than can be seen, by all of its
/// intervals.
#[derive(Debug, Args)]
#[command(after_help = EXAMPLES)]
pub(super) struct TradeArgs {
    /// Folders of the scenes, or built-in scenes (scene:NAME)
    #[arg(required = true)]
    scenes: Vec<PathBuf>,
    /// Knobs, separated by commas; a knob with levels of its own as alpha_min:1/64:1/32
    /// `[default: all that the policy has]`
    #[arg(long, value_name = "NAMES", value_delimiter = ',')]
    knobs: Vec<String>,
    /// Runs of each kind, with seeds 0, 1, …
    #[arg(long, value_name = "K", default_value_t = 3, value_parser = clap::value_parser!(u32).range(1..=1000))]
    seeds: u32,
    /// Length of each run
    #[arg(short, long, value_name = "N", default_value_t = 7_000, value_parser = clap::value_parser!(u32).range(1..))]
    iterations: u32,
    /// Most Gaussians of each run
    #[arg(short, long, value_name = "ROWS", default_value_t = DEFAULT_BUDGET, value_parser = number::rows)]
    budget: usize,
    /// Leave out the runs in which several knobs are changed together
    #[arg(long)]
    no_factorial: bool,
    /// Folder for the results
    #[arg(short, long, value_name = "DIR", default_value = "trade")]
    output: PathBuf,
    /// Options of `densify train` for every run
    #[arg(last = true, value_name = "TRAIN OPTIONS")]
    train: Vec<String>,
}

const EXAMPLES: &str = "\
Examples:
  densify trade scene:room -i 2000 -b 20k
  densify trade data/garden --knobs alpha_min,ssim_every,sh_every --seeds 5 -- -r 4
  densify trade scene:spheres --knobs coarse_until:0.3:0.5 -i 1000 -b 5k -- --policy taming";

pub(super) fn run(args: &TradeArgs, console: &Console) -> Result<(), Failure> {
    let trade = Trade {
        scenes: args.scenes.clone(),
        knobs: args.knobs.clone(),
        seeds: args.seeds,
        iterations: args.iterations,
        budget: args.budget,
        factorial: !args.no_factorial,
        output: args.output.clone(),
        train: flags::parsed(&args.train, "densify trade ... --")?,
        train_words: args.train.join(" "),
    };
    let finished = trade.run(console)?;
    console.result(finished.summary);
    console.result(format_args!("everything in {}", finished.report.display()));
    Ok(())
}
