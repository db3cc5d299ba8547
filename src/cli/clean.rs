//! `densify clean`: removes floaters from a model.

use std::fmt::Write as _;
use std::path::PathBuf;

use clap::{ArgMatches, Args};

use super::console::Console;
use super::export::{check_output, format_from_extension};
use super::mesh::{BoxArgument, share};
use super::render::{RenderingArgs, refuse_scene_options};
use super::threads;
use super::train::Follower;
use densify_clean::{Cleaned, Options, Removed, Rule, Rules, clean};
use densify_core::numbers::{counted, gaussians, grouped, percent};
use densify_data::models::{Coordinates, find};
use densify_run::failure::Failure;
use densify_run::finished::{is_model, model_file, write_model};
use densify_run::refining::TrainedModel;
use densify_run::{DepthSpec, Fraction, Whole};
use densify_train::evaluate::Split;

/// Removes floaters from a trained model, and writes the rest to another file.
///
/// Removes Gaussians with over half of their weight (α·T, over all pixels of the training views) in front of the
/// surface, which is the median depth of each pixel as the model itself shows it (depth maps of the dataset are not
/// used); Gaussians that no training view shows; small groups far from all others; and, with --box, what is outside.
/// Prints how many Gaussians each rule removed, and the change in PSNR of the test views (of the training views, if no
/// views are held out). Floaters often hide errors of the surface behind them, so PSNR falls at first; --refine trains
/// the rest further, without new Gaussians.
///
/// Floaters that are nearly opaque count as surface, since the median depth is their own.
#[derive(Debug, Args)]
#[command(after_help = EXAMPLES)]
pub(super) struct CleanArgs {
    /// Folder that `densify train` wrote, or a file of Gaussian splats (for SOG, also a folder); it is not changed
    #[arg(value_name = "RUN_OR_MODEL")]
    model: PathBuf,
    /// File to write; its extension selects the format, as for `densify export`
    #[arg(short, long, value_name = "FILE")]
    output: PathBuf,
    /// Format of the file `[default: the one with FILE's extension]`
    #[arg(long, value_name = "NAME")]
    format: Option<String>,
    /// Replace a file that exists, other than the model
    #[arg(long)]
    overwrite: bool,
    /// Saved iteration of the run `[default: the last]`
    #[arg(long, value_name = "N")]
    iteration: Option<u32>,
    /// Folder or ZIP archive of the dataset: needed for a file, and for a run whose dataset has moved
    #[arg(long, value_name = "DIR")]
    scene: Option<PathBuf>,
    /// Apply the rules up to N times: without its floaters, the model shows another surface
    #[arg(long, value_name = "N", default_value = "1")]
    rounds: Whole<1, 100>,
    /// Training steps for the remaining Gaussians afterwards
    #[arg(long, value_name = "N", default_value = "0")]
    refine: Whole<0, { u32::MAX }>,
    /// Seed of all random choices in training
    #[arg(long, value_name = "N", default_value_t = 0, value_parser = clap::value_parser!(u64).range(..=i64::MAX as u64))]
    seed: u64,
    /// Distance from the surface from which on a Gaussian is in front of it, as a fraction of the surface's depth
    #[arg(long, value_name = "FRACTION", default_value = "0.05")]
    margin: Fraction,
    /// Keep Gaussians in front of the surface
    #[arg(long)]
    keep_in_front: bool,
    /// Keep Gaussians that no training view shows
    #[arg(long)]
    keep_unseen: bool,
    /// Remove separate groups of Gaussians with less than this share of all weight; 0: none. Groups are separate if
    /// there is a gap of 1/32 of the radius that holds four fifths of all Gaussians, or more farther out
    #[arg(long, value_name = "SHARE", default_value_t = 0.001, value_parser = share)]
    isolated: f64,
    /// Remove what is outside of this box, in the dataset's coordinates
    #[arg(long = "box", value_name = "X0,Y0,Z0,X1,Y1,Z1", allow_hyphen_values = true)]
    keep_box: Option<BoxArgument>,
    #[command(flatten)]
    rendering: RenderingArgs,
}

const EXAMPLES: &str = "\
Options under Scene are for a model file; a run brings its own.

Examples:
  densify clean output/garden-diet -o garden-clean.ply
  densify clean output/garden-diet -o garden-clean.ply --rounds 3 --refine 1000
  densify clean others.spz --scene data/garden -o clean.spz --box -2,-1,-2,2,1.5,2
  densify clean output/garden-diet -o cut.ply --keep-in-front --keep-unseen --isolated 0 --box 0,0,0,1,1,1";

pub(super) fn run(
    args: &CleanArgs,
    matches: &ArgMatches,
    console: &Console,
) -> Result<(), Failure> {
    let format = match args.format.as_deref() {
        Some(name) => find(name).map_err(|error| Failure::input(format!("--format: {error}")))?,
        None => format_from_extension(&args.output)?,
    };
    check_output(&args.output, args.overwrite)?;
    let file = model_file(&args.model, args.iteration)?;
    let is_input = |path: &PathBuf| path.canonicalize().ok() == args.output.canonicalize().ok();
    if args.output.exists() && (is_input(&file) || is_input(&args.model)) {
        return Err(Failure::input(format!(
            "-o: {} is the model itself; choose another file",
            args.output.display()
        )));
    }
    let RenderingArgs { near, antialias, device, data } = &args.rendering;
    let mut data = data.clone();
    if is_model(&args.model) {
        // Test views are held out as in `densify eval`.
        data.eval |= data.test_every.is_none();
    } else {
        refuse_scene_options(matches)?;
    }
    let given = (data, DepthSpec::default(), *near);
    let model = TrainedModel::find(&args.model, file, args.scene.clone(), given, "--scene DIR")?;
    let options = Options {
        model,
        antialias: *antialias,
        device: device.clone(),
        rules: Rules {
            keep_box: args.keep_box.map(|BoxArgument { low, high }| (low, high)),
            unseen: !args.keep_unseen,
            in_front: !args.keep_in_front,
            margin: args.margin.0,
            isolated: args.isolated,
        },
        rounds: args.rounds.0,
        refine: args.refine.0,
        seed: args.seed,
        output: &args.output,
    };
    let follower = Follower::new(console);
    follower.listen();
    threads::limit(device.threads);
    let cleaned = clean(&options, &follower)?;
    write_model(format, &args.output, &cleaned.model, Coordinates::Auto, console)?;
    console.result(format_report(&cleaned));
    console.result(format_args!(
        "{} in {} ({})",
        gaussians(cleaned.model.len()),
        args.output.display(),
        format.name
    ));
    Ok(())
}

/// What went, and what that changed.
fn format_report(cleaned: &Cleaned) -> String {
    let mut text = String::new();
    for (number, removed) in (1..).zip(&cleaned.rounds) {
        let _ = writeln!(text, "{}", round_text(number, removed));
    }
    let views = match cleaned.split {
        Split::Test => "test",
        Split::Train => "training",
    };
    let _ = write!(text, "\n{:<8} {:>10}  PSNR of the {views} views [dB]", "", "Gaussians");
    let (_, before) = cleaned.stages[0];
    for (name, (rows, psnr)) in ["before", "cleaned", "refined"].into_iter().zip(&cleaned.stages) {
        let _ = write!(text, "\n{name:<8} {:>10}  {psnr:.3}", grouped(*rows));
        if name != "before" {
            let _ = write!(text, " ({:+.3})", psnr - before);
        }
    }
    text
}

fn round_text(number: u32, removed: &[Removed]) -> String {
    if removed.is_empty() {
        return format!("round {number}  nothing to remove");
    }
    let name = |rule: Rule| match rule {
        Rule::OutsideBox => "outside of the box",
        Rule::Unseen => "in no training view",
        Rule::InFront => "in front of the surface",
        Rule::Isolated => "in small groups",
    };
    let line = |removed: &Removed| {
        let (rows, share) = (counted(removed.rows, "Gaussian"), percent(removed.weight));
        format!("{:<24} {rows:>18}, {share} of the weight", name(removed.rule))
    };
    let lines: Vec<String> = removed.iter().map(line).collect();
    format!("round {number}  {}", lines.join("\n         "))
}
