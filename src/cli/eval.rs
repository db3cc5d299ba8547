//! `densify eval`: scores of a model against photographs and known geometry.

use std::fmt::Write as _;
use std::ops::ControlFlow;
use std::path::PathBuf;

use clap::{ArgMatches, Args};

use super::console::Console;
use super::mesh;
use super::render::{ModelArgument, RenderingArgs};
use densify_core::numbers::{grouped, percent};
use densify_data::meshes::is_mesh;
use densify_data::views::ViewSource;
use densify_inspect::{Limit, LimitError, Limits, Side, measured_values};
use densify_run::RunConfig;
use densify_run::coordinate_check::CoordinateCheck;
use densify_run::failure::{Failure, INPUT, LIMIT};
use densify_run::finished::{is_model, iteration};
use densify_train::evaluate::{Comparison, Evaluated, FittedScore, Mean, Split, evaluate};
use densify_train::metrics::Lpips;
use densify_train::metrics::geometry::{self, Geometry};
use densify_train::output::{write_geometry, write_scores};

/// Measures a model against the photographs of its scene: PSNR, SSIM, FLIP, and LPIPS on request.
///
/// Prints the scores of each view and their mean, and writes those of a run to results.json and
/// per_view.json in its folder (results_train.json and per_view_train.json for training views). For a file of
/// Gaussian splats, and with --antialias, nothing is written. For a file, every 8th photograph is measured unless
/// the dataset or an option selects others. Where the geometry is known (built-in scenes, and those that
/// `densify scenegen` wrote), also measures how well the Gaussians match it: in a second table, and in geometry.json
/// (geometry_train.json).
///
/// A triangle mesh (.ply with faces, .glb, .obj) in the dataset's coordinates is measured against the known surface
/// instead: mean distances in both directions, and F-scores, the harmonic means of the shares of the mesh and of the
/// surface (where two training views see it) that are within 0.5 and 1 % of the diagonal from the other.
#[derive(Debug, Args)]
#[command(after_help = EXAMPLES)]
pub(super) struct EvalArgs {
    /// Folder that `densify train` wrote, or a file of Gaussian splats (for SOG, also a folder), or a mesh
    #[arg(value_name = "RUN_OR_MODEL")]
    model: PathBuf,
    /// Saved iteration of the run `[default: the last]`
    #[arg(long, value_name = "N")]
    iteration: Option<u32>,
    /// Views to measure
    #[arg(long, value_enum, default_value_t = Split::Test)]
    split: Split,
    /// Folder or ZIP archive of the dataset: needed for a file, and for a run whose dataset has moved
    #[arg(long, value_name = "DIR")]
    scene: Option<PathBuf>,
    /// Also measure LPIPS, with the weights in this safetensors file (VGG-16 or AlexNet; they are not part
    /// of densify; docs/metrics.md explains how to make the file)
    #[arg(long, value_name = "FILE")]
    lpips: Option<PathBuf>,
    /// Measure each view a second time, with the factor and offset per channel that fit its photograph best
    /// (always on if the run learned exposures)
    #[arg(long)]
    fit_exposure: bool,
    /// Exit with code 4 if KEY is below VALUE; KEY is psnr, ssim, flip, lpips, or the path of a number in
    /// geometry.json, such as centres.f_score_one_percent; may be repeated
    #[arg(long, value_name = "KEY=VALUE")]
    fail_below: Vec<Limit>,
    /// Exit with code 4 if KEY, such as flip or depth.rmse, is above VALUE; may be repeated
    #[arg(long, value_name = "KEY=VALUE")]
    fail_above: Vec<Limit>,
    #[command(flatten)]
    rendering: RenderingArgs,
}

const EXAMPLES: &str = "\
Options under Scene are for a model file; a run brings its own.

Examples:
  densify eval output/garden-diet
  densify eval output/garden-diet --iteration 7000 --split train
  densify eval output/garden-diet --lpips lpips-vgg.safetensors
  densify eval others.spz --scene data/garden -r 4
  densify eval output/garden-diet --fail-below psnr=25 --fail-above flip=0.1
  densify eval room.ply --scene scene:room --fail-below f_score_one_percent=0.9";

pub(super) fn run(args: &EvalArgs, matches: &ArgMatches, console: &Console) -> Result<(), Failure> {
    let model = &args.model;
    let limits = Limits { lowest: &args.fail_below, highest: &args.fail_above };
    if is_mesh(model) {
        let scene = args.scene.as_deref();
        return mesh::evaluate((model, scene), (&args.rendering, limits), matches, console);
    }
    // A folder without config.toml is not a run, and is refused whatever other files it holds.
    let run = if is_model(model) {
        None
    } else {
        Some((RunConfig::read(model)?, iteration(model, args.iteration)?))
    };
    let mut rendering = args.rendering.clone();
    rendering.data.eval |= rendering.data.test_every.is_none();
    let lpips = args.lpips.as_deref().map(Lpips::open).transpose();
    let lpips = lpips.map_err(|e| Failure::input(format!("--lpips: {e}")))?;
    let argument = ModelArgument { model, scene: args.scene.as_deref(), iteration: args.iteration };
    let mut opened = argument.open(&rendering, geometry::needs(), matches, console)?;
    let views = opened.views(args.split)?;
    let knows_geometry = opened.dataset.surface_bytes.is_some();
    limits.check_keys(knows_geometry, lpips.is_some()).map_err(with_option_names)?;
    let background = opened.data.background.fixed();
    let width = opened.dataset.train.iter().chain(&opened.dataset.test);
    let width = width.map(|view| view.name.chars().count()).max().unwrap_or(0).max(6);
    let column = if lpips.is_some() { "   LPIPS" } else { "" };
    console.result(format_args!("{:width$}  PSNR [dB]    SSIM    FLIP{column}", "view"));
    let line = |name: &str, psnr: f64, ssim: f64, flip: f64, lpips: Option<f64>| {
        let lpips = lpips.map_or(String::new(), |value| format!("  {value:.4}"));
        console.result(format_args!("{name:width$}  {psnr:9.3}  {ssim:.4}  {flip:.4}{lpips}"));
    };
    let (backend, degree) = (opened.backend.as_mut(), opened.sh_degree);
    let has_exposures = run.as_ref().is_some_and(|(config, _)| config.resolved.has_exposures);
    let fits_exposure = args.fit_exposure || has_exposures;
    let comparison = Comparison { lpips: lpips.as_ref(), fits_exposure, fits_pose: false };
    let mut check = CoordinateCheck::new(views.count());
    let scores = evaluate(backend, &views, background, degree, comparison, |evaluated| {
        let Evaluated { view, score, rendering, image } = evaluated;
        line(&score.name, score.psnr, score.ssim, score.flip, score.lpips);
        check.add(view, rendering, image, background);
        ControlFlow::Continue(())
    })?;
    check.note(None, model, console);
    let mean = Mean::over(&scores);
    line("mean", mean.psnr, mean.ssim, mean.flip, mean.lpips);
    if let Some(FittedScore { psnr, ssim, flip, lpips }) = mean.fitted {
        line("fitted", psnr, ssim, flip, lpips);
    }
    // Scores with an antialiasing other than that of training are not scores of the run.
    let written = run.filter(|_| args.rendering.antialias.is_none());
    if let Some((_, iteration)) = written {
        write_scores(model, args.split, iteration, &scores)?;
    }
    let geometry = opened.geometry(&views, &|| false)?;
    if let Some(measured) = &geometry {
        console.result(format_table(measured));
        if let Some((_, iteration)) = written {
            write_geometry(model, args.split, iteration, measured)?;
        }
    }
    limits.check(&measured_values(&mean, geometry.as_ref())).map_err(with_option_names)
}

/// The failure; its message names the options.
pub(super) fn with_option_names(error: LimitError) -> Failure {
    let code = match error {
        LimitError::Unknown { .. } => INPUT,
        LimitError::Exceeded(_) => LIMIT,
    };
    let message = error.message(|side| match side {
        Side::Lowest => "--fail-below",
        Side::Highest => "--fail-above",
    });
    Failure::new(code, message)
}

/// The geometric measurements, one per line, with lengths as percentages of the scene's diagonal.
fn format_table(geometry: &Geometry) -> String {
    let Geometry {
        depth,
        normal_error,
        centres,
        floaters,
        weight_before_surface,
        thin,
        redundancy,
    } = geometry;
    let plain = |value: f64, unit: &str| {
        if value.is_finite() { format!("{value:.2}{unit}") } else { "–".into() }
    };
    let mut lines = vec![
        ("depth RMSE (of the diagonal)".to_owned(), percent(depth.rmse)),
        ("depth error, relative".to_owned(), percent(depth.abs_rel)),
        ("depth spread along rays (of the diagonal)".to_owned(), percent(depth.spread)),
        ("surface covered".to_owned(), percent(depth.coverage)),
        ("normal error, median".to_owned(), plain(*normal_error, "°")),
        ("centre to surface, mean (of the diagonal)".to_owned(), percent(centres.accuracy)),
        ("centre to surface, 95 % within".to_owned(), percent(centres.accuracy_p95)),
        ("surface to centre, mean".to_owned(), percent(centres.completeness)),
        ("Chamfer distance".to_owned(), percent(centres.chamfer)),
        ("F-score at 0.5 %".to_owned(), percent(centres.f_score_half_percent)),
        ("F-score at 1 %".to_owned(), percent(centres.f_score_one_percent)),
        ("floaters".to_owned(), grouped(floaters.count)),
        ("floaters, share of Gaussians".to_owned(), percent(floaters.of_rows)),
        ("floaters, share of weight".to_owned(), percent(floaters.of_weight)),
        ("weight before the surface".to_owned(), percent(*weight_before_surface)),
    ];
    for structures in thin {
        let name = format!("thin structures found, {} px wide", structures.width);
        lines.push((name, percent(structures.recall)));
    }
    lines.push(("Gaussians blended per pixel".to_owned(), plain(redundancy.blended_per_pixel, "")));
    lines.push((
        "Gaussians with weights below 1 %".to_owned(),
        percent(redundancy.below_one_percent),
    ));
    let width = lines.iter().map(|(name, _)| name.chars().count()).max().unwrap_or(0);
    let mut text = String::from("\ngeometry");
    for (name, value) in lines {
        let _ = write!(text, "\n{name:width$}  {value:>10}");
    }
    text
}
