//! `densify render`: pictures and films of a model.

use std::path::{Path, PathBuf};

use clap::parser::ValueSource;
use clap::{ArgMatches, Args};
use densify_policies::policy::Needs;

use super::console::Console;
use super::film::{self, FilmArgs};
use super::mesh::on_processor;
use super::threads::open_machine;
use densify_core::antialiasing::Antialiasing;
use densify_core::camera_path;
use densify_data::views::ViewSource;
use densify_inspect::{CameraRoute, Channels, FilmSource, PictureFolder, file_names};
use densify_render::DepthKind;
use densify_run::failure::Failure;
use densify_run::finished::{Opened, is_model, iteration, model_file, open, open_alone, open_run};
use densify_run::{DataSpec, DeviceSpec, Fraction, RunConfig};
use densify_train::evaluate::Split;

/// Renders a trained scene to PNG files.
///
/// Renders the held-out views or the training views of a run, or of any file of Gaussian splats (which needs
/// --scene for the cameras); or, with --path, a camera path through the scene, and a film of it.
///
/// Depth is the mean Σ α·T·z / Σ α·T along each ray (or the median: --depth-kind), measured along the
/// optical axis in the dataset's own units, and 0 where the opacity Σ α·T is below one half. It is written as a NumPy array
/// (NAME.depth.npy) and in 16 bits (NAME.depth.png), whose unit is in depth.json: thousandths, unless
/// another power of ten fits better.
#[derive(Debug, Args)]
#[command(after_help = EXAMPLES)]
pub(super) struct RenderArgs {
    /// Folder that `densify train` wrote, or a file of Gaussian splats (for SOG, also a folder)
    #[arg(value_name = "RUN_OR_MODEL")]
    model: PathBuf,
    /// Folder or ZIP archive of the dataset: needed for a run whose dataset has moved, and for a file unless --path is
    /// a file with cameras
    #[arg(long, value_name = "DIR")]
    scene: Option<PathBuf>,
    /// Folder for the pictures
    #[arg(short, long, value_name = "DIR")]
    output: PathBuf,
    /// Views to render
    #[arg(long, value_enum, default_value_t = Split::Test)]
    split: Split,
    /// Saved iteration of the run `[default: the last]`
    #[arg(long, value_name = "N")]
    iteration: Option<u32>,
    /// Also write the opacity of each pixel, as NAME.alpha.png
    #[arg(long)]
    alpha: bool,
    /// Also write depth, as NAME.depth.png and NAME.depth.npy
    #[arg(long)]
    depth: bool,
    /// Depth of a pixel: expected (the mean of the Gaussians blended into it), or median (of the one that reduces the
    /// transmittance to below one half; on the processor only)
    #[arg(long, value_name = "KIND", default_value_t = DepthKind::Expected, requires = "depth")]
    depth_kind: DepthKind,
    /// Also write photograph and render side by side, as NAME.pair.png
    #[arg(long)]
    side_by_side: bool,
    #[command(flatten)]
    film: FilmArgs,
    #[command(flatten)]
    rendering: RenderingArgs,
}

/// The device to render on, and the dataset options, which only a model file needs: a run has its own.
#[derive(Debug, Clone, Args)]
pub(super) struct RenderingArgs {
    /// Smallest distance from a camera at which Gaussians of a file are rendered, as a fraction of the
    /// scene's extent (default: 0.04, or less where the views show points that are nearer)
    #[arg(long, value_name = "FRACTION", help_heading = "Scene")]
    pub(super) near: Option<Fraction>,
    /// Antialiasing to render with, instead of what the file states: a kernel of 0.3 px² (most programs) or 0.1 (Brush,
    /// LichtFeld, Mip-Splatting), or none. PLY files of the original trainer do not state their antialiasing
    #[arg(
        long, value_name = "KERNEL", num_args = 0..=1, require_equals = true, default_missing_value = "0.3",
        help_heading = "Rendering"
    )]
    pub(super) antialias: Option<Antialiasing>,
    #[command(flatten)]
    pub(super) device: DeviceSpec,
    #[command(flatten)]
    pub(super) data: DataSpec,
}

const EXAMPLES: &str = "\
Options under Scene are for a model file; a run brings its own.

Examples:
  densify render output/garden-diet -o pictures --side-by-side
  densify render output/garden-diet -o frames --path orbit --video orbit.mp4
  densify render output/garden-diet -o frames --path camera_path.json --size 1920x1080
  densify render others.spz --scene data/garden --eval -o pictures --depth";

pub(super) fn run(
    args: &RenderArgs,
    matches: &ArgMatches,
    console: &Console,
) -> Result<(), Failure> {
    let channels = Channels { alpha: args.alpha, depth: args.depth.then_some(args.depth_kind) };
    let device = match channels.depth {
        Some(DepthKind::Median) => on_processor(&args.rendering.device)?,
        _ => args.rendering.device.clone(),
    };
    let rendering = &RenderingArgs { device, ..args.rendering.clone() };
    if args.film.path.is_some() && args.side_by_side {
        return Err(Failure::input(
            "--side-by-side: a camera path has no photographs; leave it out",
        ));
    }
    let argument = ModelArgument {
        model: &args.model,
        scene: args.scene.as_deref(),
        iteration: args.iteration,
    };
    let path = args.film.path.as_ref();
    // A camera path from a file needs no dataset.
    if let Some(route @ CameraRoute::File(file)) = path
        && args.scene.is_none()
        && is_model(&args.model)
    {
        let source = argument.open_without_dataset(file, rendering, console)?;
        return film::run(&args.film, route, &args.output, channels, source, console);
    }
    let mut opened = argument.open(rendering, Needs::default(), matches, console)?;
    if let Some(route) = path {
        return film::run(&args.film, route, &args.output, channels, opened.into(), console);
    }
    let views = opened.views(args.split)?;
    let background = opened.data.background.fixed();
    let names: Vec<&str> = (0..views.count()).map(|view| views.name(view)).collect();
    let files = file_names(&names);
    let mut folder = PictureFolder::new(&args.output, channels, &opened.dataset.normalisation);
    for (view, name) in files.iter().enumerate() {
        let backend = opened.backend.as_mut();
        let rendering =
            channels.render(backend, views.camera(view), background, opened.sh_degree)?;
        folder.write(name, &rendering)?;
        if args.side_by_side {
            let image = views.image(view).map_err(Failure::input)?;
            folder.write_pair(name, &image, background, &rendering)?;
        }
    }
    folder.finish()?;
    console.result(format_args!("{} views in {}", files.len(), args.output.display()));
    Ok(())
}

/// Fails if an option was given that applies only to model files; a run has values of its own.
pub(super) fn refuse_scene_options(matches: &ArgMatches) -> Result<(), Failure> {
    let scene = DataSpec::augment_args(clap::Command::new("scene"));
    let names = scene.get_arguments().map(|argument| argument.get_id().as_str()).chain(["near"]);
    match given_option(names, matches) {
        None => Ok(()),
        Some(option) => Err(Failure::input(format!(
            "{option} is for a file with --scene DIR (a run brings its own); add --scene DIR to a file, or leave the \
             option out"
        ))),
    }
}

/// The first of the options with these names that was given on the command line.
pub(super) fn given_option<'a>(
    names: impl IntoIterator<Item = &'a str>,
    matches: &ArgMatches,
) -> Option<String> {
    let is_given = |name: &&str| matches.value_source(name) == Some(ValueSource::CommandLine);
    names.into_iter().find(is_given).map(|name| format!("--{}", name.replace('_', "-")))
}

/// The model that a command line names: a run, or a file with its dataset.
pub(super) struct ModelArgument<'a> {
    pub(super) model: &'a Path,
    pub(super) scene: Option<&'a Path>,
    pub(super) iteration: Option<u32>,
}

impl ModelArgument<'_> {
    /// Opens the model with its dataset; for a file, `rendering` has the options of the dataset.
    pub(super) fn open(
        &self,
        rendering: &RenderingArgs,
        needs: Needs,
        matches: &ArgMatches,
        console: &Console,
    ) -> Result<Opened, Failure> {
        let is_run = !is_model(self.model);
        if is_run {
            refuse_scene_options(matches)?;
        }
        let machine = open_machine(&rendering.device, console)?;
        if is_run {
            RunConfig::read(self.model)?;
            let iteration = iteration(self.model, self.iteration)?;
            let moved_to = self.scene.map(Path::to_owned);
            let options = (rendering.antialias, machine);
            return open_run(self.model, iteration, moved_to, options, needs, console);
        }
        let Some(scene) = self.scene else {
            return Err(Failure::input(format!(
                "{} is a file, which has no cameras; name a dataset with --scene DIR",
                self.model.display()
            )));
        };
        let model = model_file(self.model, self.iteration)?;
        let RenderingArgs { near, antialias, data, .. } = rendering;
        open(&model, scene, data.clone(), (*near, *antialias, machine), needs, console)
    }

    /// Opens a model file without a dataset, for the camera path in the file `path`.
    fn open_without_dataset(
        &self,
        path: &Path,
        rendering: &RenderingArgs,
        console: &Console,
    ) -> Result<FilmSource, Failure> {
        let machine = open_machine(&rendering.device, console)?;
        let model = model_file(self.model, self.iteration)?;
        // If the camera path cannot be read, `film::run` reports the error.
        let cameras = camera_path::read(path).map_or_else(|_| Vec::new(), |saved| saved.cameras());
        let (backend, normalisation, sh_degree) =
            open_alone(&model, (rendering.near, rendering.antialias, machine), &cameras, console)?;
        let background = rendering.data.background.fixed();
        Ok(FilmSource { backend, sh_degree, background, normalisation, cameras: Vec::new() })
    }
}
