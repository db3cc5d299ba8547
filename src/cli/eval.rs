//! `densify eval`.

use std::path::PathBuf;

use clap::Args;

use super::console::Console;
use super::failure::Failure;
use super::run_files::{SplitArg, iteration, open_run};
use crate::evaluate::evaluate;
use crate::output::{Mean, write_scores};

/// Measures a trained scene against its photographs: PSNR and SSIM.
///
/// Prints the scores of each view and their mean, and writes them to results.json and
/// per_view.json in the run's folder (results_train.json and per_view_train.json for the views
/// trained on).
#[derive(Debug, Args)]
#[command(after_help = EXAMPLES)]
pub(super) struct EvalArgs {
    /// Folder that `densify train` wrote
    run: PathBuf,
    /// Saved iteration to measure `[default: the last]`
    #[arg(long, value_name = "N")]
    iteration: Option<u32>,
    /// Which views to measure
    #[arg(long, value_enum, default_value_t = SplitArg::Test)]
    split: SplitArg,
    /// Folder of the dataset, where it is no longer where it was
    #[arg(long, value_name = "DIR")]
    scene: Option<PathBuf>,
    /// Processor threads to use `[default: all]`
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..))]
    threads: Option<u16>,
}

const EXAMPLES: &str = "\
Examples:
  densify eval output/garden-diet
  densify eval output/garden-diet --iteration 7000 --split train";

pub(super) fn run(args: &EvalArgs, console: &Console) -> Result<(), Failure> {
    let run = &args.run;
    // A folder without config.toml is no run, whatever else it holds.
    crate::output::RunConfig::read(run)?;
    let iteration = iteration(run, args.iteration)?;
    let mut opened = open_run(run, iteration, args.scene.clone(), args.threads, console)?;
    let views = opened.views(args.split)?;
    let background = opened.scene.background.fixed();
    let width = opened.dataset.train.iter().chain(&opened.dataset.test);
    let width = width.map(|view| view.name.chars().count()).max().unwrap_or(0).max(4);
    console.result(format_args!("{:width$}  PSNR [dB]    SSIM", "view"));
    let scores = evaluate(opened.backend.as_mut(), &views, background, opened.sh_degree, |view| {
        console.result(format_args!("{:width$}  {:9.3}  {:.4}", view.name, view.psnr, view.ssim));
    })?;
    let Mean { psnr, ssim } = scores.mean();
    console.result(format_args!("{:width$}  {psnr:9.3}  {ssim:.4}", "mean"));
    write_scores(run, args.split.into(), iteration, &scores)?;
    Ok(())
}
