//! `densify compress`: reduces a model or its file with the least loss of quality.

use std::path::PathBuf;

use clap::{ArgMatches, Args};

use super::console::Console;
use super::export::{check_output, format_from_extension};
use super::render::{RenderingArgs, refuse_scene_options};
use super::threads;
use super::train::Follower;
use densify_compress::{Attempt, Compressed, Options, Target, compress, file};
use densify_core::numbers::{self, grouped, percent};
use densify_data::models::{Format, compress_formats, find};
use densify_run::failure::Failure;
use densify_run::finished::{is_model, model_file};
use densify_run::refining::TrainedModel;
use densify_run::{DepthSpec, Whole};

/// Reduces a trained model to a number of Gaussians, or to a file size.
///
/// Prunes the Gaussians that contribute least to the training views, at most half of them at once, and trains the rest
/// in between. For a file size it tries the model's SH degree and lower ones, and coarser colour where the format has
/// it, because both leave room for more Gaussians. It keeps the attempt whose file reproduces the training views best.
/// Held-out views are measured, too, but do not affect the choice. The printed table shows quality against size: of
/// the whole model, of the file after each intermediate pruning, and of the attempts at the final size.
#[derive(Debug, Args)]
#[command(after_help = EXAMPLES)]
pub(super) struct CompressArgs {
    /// Folder that `densify train` wrote, or a file of Gaussian splats (for SOG, also a folder)
    #[arg(value_name = "RUN_OR_MODEL")]
    model: PathBuf,
    /// Maximum size of the file, such as 5MiB or 800kB, or a number of Gaussians, such as 20k
    #[arg(long, value_name = "SIZE|ROWS", value_parser = parse_target)]
    to: Target,
    /// File to write; its extension selects the format, as for `densify export`
    #[arg(short, long, value_name = "FILE")]
    output: PathBuf,
    /// Format of the file; any: the format that holds the most Gaussians, whose extension is then added to FILE
    /// `[default: the one with FILE's extension]`
    #[arg(long, value_name = "NAME")]
    format: Option<String>,
    /// Replace a file that exists
    #[arg(long)]
    overwrite: bool,
    /// Training steps of each attempt
    #[arg(short, long, value_name = "N", default_value = "3000")]
    iterations: Whole<1, { u32::MAX }>,
    /// Seed of all random choices
    #[arg(long, value_name = "N", default_value_t = 0, value_parser = clap::value_parser!(u64).range(..=i64::MAX as u64))]
    seed: u64,
    /// Saved iteration of the run `[default: the last]`
    #[arg(long, value_name = "N")]
    iteration: Option<u32>,
    /// Folder or ZIP archive of the dataset: needed for a model file, and for a run whose dataset has moved
    #[arg(long, value_name = "DIR")]
    scene: Option<PathBuf>,
    #[command(flatten)]
    rendering: RenderingArgs,
}

const EXAMPLES: &str = "\
Options under Scene are for a model file; a run brings its own.

Examples:
  densify compress output/garden-diet --to 5MiB -o garden.sog
  densify compress output/garden-diet --to 800kB --format any -o garden
  densify compress output/garden-diet --to 20k -o small.ply
  densify compress others.ply --scene data/garden --to 800kB -o garden.spz";

/// Value of `--format` that selects the format that holds the most Gaussians.
const ANY: &str = "any";

/// Parses the value of `--to`.
fn parse_target(text: &str) -> Result<Target, String> {
    let target = if text.trim_end().ends_with(['b', 'B']) {
        numbers::bytes(text).map(Target::Bytes)
    } else {
        numbers::rows(text).map(Target::Rows)
    };
    target.map_err(|error| {
        format!("{error}; give a size such as 5MiB, or a number of Gaussians such as 20k")
    })
}

pub(super) fn run(
    args: &CompressArgs,
    matches: &ArgMatches,
    console: &Console,
) -> Result<(), Failure> {
    let formats = candidate_formats(args)?;
    for format in &formats {
        check_output(&file(&args.output, &formats, format), args.overwrite)?;
    }
    let RenderingArgs { near, antialias, device, data } = &args.rendering;
    let file = model_file(&args.model, args.iteration)?;
    if !is_model(&args.model) {
        refuse_scene_options(matches)?;
    }
    let given = (data.clone(), DepthSpec::default(), *near);
    let model = TrainedModel::find(&args.model, file, args.scene.clone(), given, "--scene DIR")?;
    let options = Options {
        model,
        antialias: *antialias,
        device: device.clone(),
        to: args.to,
        iterations: args.iterations.0,
        seed: args.seed,
        formats: &formats,
        output: &args.output,
    };
    let follower = Follower::new(console);
    follower.listen();
    threads::limit(device.threads);
    let compressed = compress(&options, &follower)?;
    console.result(format_table(&compressed));
    let format = compressed.attempts[compressed.best].format;
    console.result(format_args!("{} ({format})", compressed.file.display()));
    Ok(())
}

/// The formats to choose from.
fn candidate_formats(args: &CompressArgs) -> Result<Vec<&'static Format>, Failure> {
    match args.format.as_deref() {
        Some(ANY) => Ok(compress_formats()),
        Some(name) => {
            let wrong = |error| Failure::input(format!("--format: {error}, {ANY}"));
            Ok(vec![find(name).map_err(wrong)?])
        }
        None => Ok(vec![format_from_extension(&args.output)?]),
    }
}

/// Quality against size: the whole model, each intermediate pruning, and the attempts at the final size.
fn format_table(compressed: &Compressed) -> String {
    let Compressed { whole, stages, attempts, best, .. } = compressed;
    let mut text = format!(
        "\n{:<10} {:>10} {:>7} {:>14} {:>13} {:>11} {:>11}",
        "", "Gaussians", "degree", "format", "bytes", "train [dB]", "test [dB]"
    );
    let mut line = |name: &str, attempt: &Attempt, share: &str| {
        let Attempt { rows, sh_degree, format, bytes, train_psnr, test_psnr } = attempt;
        let test_psnr = test_psnr.map_or_else(|| "–".to_owned(), |test| format!("{test:.2}"));
        let bytes = grouped(usize::try_from(*bytes).unwrap_or(usize::MAX));
        let rows = grouped(*rows);
        text += &format!(
            "\n{name:<10} {rows:>10} {sh_degree:>7} {format:>14} {bytes:>13} {train_psnr:>11.2} {test_psnr:>11}{share}"
        );
    };
    line("whole PLY", whole, "");
    let others = attempts.iter().enumerate().map(|(place, attempt)| {
        let name = if place == *best { "written" } else { "tried" };
        (name, attempt)
    });
    for (name, attempt) in stages.iter().map(|attempt| ("in between", attempt)).chain(others) {
        let share = percent(attempt.bytes as f64 / whole.bytes as f64);
        line(name, attempt, &format!("  {share} of the PLY"));
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn targets_with_a_unit_are_bytes_and_other_targets_are_gaussians() {
        assert_eq!(parse_target("5MiB"), Ok(Target::Bytes(5 << 20)));
        assert_eq!(parse_target("800kB"), Ok(Target::Bytes(800_000)));
        assert_eq!(parse_target("20k"), Ok(Target::Rows(20_000)));
        for wrong in ["", "much", "-3", "0"] {
            assert!(parse_target(wrong).is_err_and(|error| error.contains("20k")), "{wrong}");
        }
    }
}
