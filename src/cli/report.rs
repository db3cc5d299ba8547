//! `densify report`: runs as one HTML file.

use std::path::PathBuf;

use clap::Args;

use super::console::Console;
use super::export::check_output;
use super::threads;
use densify_core::files::FileError;
use densify_core::memory::Bytes;
use densify_report as report;
use densify_report::ReportOptions;
use densify_run::DeviceSpec;
use densify_run::failure::Failure;

/// Writes the results of one or more runs as one HTML file.
///
/// The file is self-contained and loads nothing: it can be mailed, and opens in any browser. It holds the
/// scores, the worst and the best held-out views with a slider between photograph and render, an orbit of the
/// scene, curves of loss, Gaussians, PSNR and memory, the edits, the automatic reductions, and the settings. Runs
/// that differ only in their seed form a group: their results are averaged, with 95 % intervals if there are three
/// or more, and the pictures are those of the smallest seed. Groups of the same scene share their diagrams.
#[derive(Debug, Args)]
#[command(after_help = EXAMPLES)]
pub(super) struct ReportArgs {
    /// Folders that `densify train` wrote
    #[arg(value_name = "RUN", required = true)]
    runs: Vec<PathBuf>,
    /// File to write; its name ends in .html
    #[arg(short, long, value_name = "FILE")]
    output: PathBuf,
    /// Replace a file that exists
    #[arg(long)]
    overwrite: bool,
    /// Saved iteration of the runs `[default: the last of each]`
    #[arg(long, value_name = "N")]
    iteration: Option<u32>,
    /// Folder or ZIP archive of the dataset, if the dataset has moved
    #[arg(long, value_name = "DIR")]
    scene: Option<PathBuf>,
    #[command(flatten)]
    device: DeviceSpec,
}

const EXAMPLES: &str = "\
The file has no paths of this machine, but it has the names of the run folders, the dataset and the photographs.

Examples:
  densify report output/garden-diet -o garden.html
  densify report output/garden-diet output/garden-mcmc -o garden.html
  densify report output/seed0 output/seed1 output/seed2 -o seeds.html --overwrite";

pub(super) fn run(args: &ReportArgs, console: &Console) -> Result<(), Failure> {
    let file = &args.output;
    let is_html = file.extension().is_some_and(|ending| {
        ["html", "htm"].iter().any(|known| ending.eq_ignore_ascii_case(known))
    });
    if !is_html {
        let file = file.display();
        return Err(Failure::input(format!(
            "-o: {file}: a report is HTML; name a file that ends in .html"
        )));
    }
    check_output(file, args.overwrite)?;
    let options = ReportOptions {
        runs: &args.runs,
        iteration: args.iteration,
        dataset: args.scene.as_deref(),
        device: &args.device,
    };
    threads::limit(args.device.threads);
    report::write(&options, file, console)?;
    let size = file.metadata().map_err(FileError::io("read", file))?.len();
    console.result(format_args!("report   {} ({})", file.display(), Bytes(size)));
    Ok(())
}
