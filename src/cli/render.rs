//! `densify render`.

use std::collections::{BTreeMap, HashSet};
use std::path::{Path, PathBuf};

use clap::{ArgMatches, Args};
use densify_policies::policy::Needs;
use image::{DynamicImage, ImageBuffer, Luma};

use super::console::Console;
use super::film::{self, FilmArgs, Filmed, Route};
use super::threads::open_machine;
use densify_render::Rendering;

use densify_core::image::Image8;
use densify_data::dataset::normalise::Normalisation;
use densify_data::views::ViewSource;
use densify_run::failure::Failure;
use densify_run::finished::{Opened, is_model, iteration, model_file, open, open_alone, open_run};
use densify_run::{DataSpec, DeviceSpec, Fraction, RunConfig};
use densify_train::evaluate::Split;
use densify_train::output::write_json;
use densify_train::pictures::{photograph, picture, side_by_side, to_u8, write_png};

/// Renders a trained scene to PNG files.
///
/// Renders the views held out, or those trained on, of a run or of any file of Gaussian splats
/// (which needs --scene for the cameras); or with --path a flight through the scene, and a film of it.
///
/// Depth is Σ α·T·z along each ray, in the dataset's own units: opaque surfaces show their
/// distance along the optical axis. It is written in 16 bits, 65535 standing for the largest
/// depth of the picture; depth.json says how much that is.
#[derive(Debug, Args)]
#[command(after_help = EXAMPLES)]
pub(super) struct RenderArgs {
    /// Folder that `densify train` wrote, or a file (of SOG also a folder) of Gaussian splats
    #[arg(value_name = "RUN_OR_MODEL")]
    model: PathBuf,
    /// Folder or ZIP archive of the dataset: needed for a file, unless --path names one of cameras, and for a run whose
    /// dataset has moved
    #[arg(long, value_name = "DIR")]
    scene: Option<PathBuf>,
    /// Folder for the pictures
    #[arg(short, long, value_name = "DIR")]
    output: PathBuf,
    /// Which views to render
    #[arg(long, value_enum, default_value_t = Split::Test)]
    split: Split,
    /// Saved iteration of the run `[default: the last]`
    #[arg(long, value_name = "N")]
    iteration: Option<u32>,
    /// Also write how opaque each pixel is, as NAME.alpha.png
    #[arg(long)]
    alpha: bool,
    /// Also write depth, as NAME.depth.png
    #[arg(long)]
    depth: bool,
    /// Also write photograph and rendering beside each other, as NAME.pair.png
    #[arg(long)]
    side_by_side: bool,
    #[command(flatten)]
    film: FilmArgs,
    #[command(flatten)]
    rendering: RenderingArgs,
}

/// How a model is rendered, and with which dataset if it brings none.
#[derive(Debug, Clone, Args)]
pub(super) struct RenderingArgs {
    /// Nearest distance to a camera at which anything of a file is drawn, as a fraction of the
    /// scene's extent
    #[arg(long, value_name = "FRACTION", help_heading = "Scene")]
    pub(super) near: Fraction,
    #[command(flatten)]
    pub(super) device: DeviceSpec,
    #[command(flatten)]
    pub(super) data: DataSpec,
}

const EXAMPLES: &str = "\
Options under Scene are for a file; a run brings its own.

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
    let extras = Extras { alpha: args.alpha, depth: args.depth };
    if args.film.path.is_some() && args.side_by_side {
        return Err(Failure::input("--side-by-side: a flight has no photographs; leave it out"));
    }
    let named =
        Named { model: &args.model, scene: args.scene.as_deref(), iteration: args.iteration };
    let path = args.film.path.as_ref();
    // A camera path in a file brings its cameras with it.
    if let Some(route @ Route::File(_)) = path
        && args.scene.is_none()
        && is_model(&args.model)
    {
        let filmed = named.alone(&args.rendering, console)?;
        return film::run(&args.film, route, &args.output, extras, filmed, console);
    }
    let mut opened = named.open(&args.rendering, Needs::default(), matches, console)?;
    if let Some(route) = path {
        return film::run(&args.film, route, &args.output, extras, opened.into(), console);
    }
    let views = opened.views(args.split)?;
    let background = opened.data.background.fixed();
    let names: Vec<&str> = (0..views.count()).map(|view| views.name(view)).collect();
    let files = file_names(&names);
    let mut depths = extras.depths(&opened.dataset.normalisation);
    for (view, name) in files.iter().enumerate() {
        let rendering = opened.backend.render(views.camera(view), background, opened.sh_degree)?;
        write_pictures(&args.output, name, &rendering, extras, &mut depths)?;
        if args.side_by_side {
            let image = views.image(view).map_err(Failure::input)?;
            let path = args.output.join(format!("{name}.pair.png"));
            write_png(&path, &pair(&image, background, &rendering))?;
        }
    }
    depths.write(&args.output)?;
    console.result(format_args!("{} views in {}", files.len(), args.output.display()));
    Ok(())
}

/// What is written beside the colours.
#[derive(Debug, Clone, Copy)]
pub(super) struct Extras {
    alpha: bool,
    depth: bool,
}

/// What the pictures of depth stand for.
pub(super) struct Depths {
    /// Of the dataset, per scene unit.
    units: f64,
    /// Largest depth by picture.
    largest: BTreeMap<String, f64>,
}

impl Extras {
    pub(super) fn depths(self, normalisation: &Normalisation) -> Depths {
        Depths { units: 1.0 / normalisation.scale, largest: BTreeMap::new() }
    }
}

impl Depths {
    /// Writes depth.json, if there are pictures of depth.
    pub(super) fn write(&self, folder: &Path) -> Result<(), Failure> {
        if self.largest.is_empty() {
            return Ok(());
        }
        let said = serde_json::json!({
            "what": "depth = value / 65535 * largest, in the dataset's own units",
            "largest": self.largest,
        });
        Ok(write_json(&folder.join("depth.json"), &said)?)
    }
}

/// Writes the pictures of one rendering.
pub(super) fn write_pictures(
    folder: &Path,
    name: &str,
    rendering: &Rendering,
    extras: Extras,
    depths: &mut Depths,
) -> Result<(), Failure> {
    let to = |ending: &str| folder.join(format!("{name}{ending}"));
    write_png(&to(".png"), &picture(rendering).into())?;
    if extras.alpha {
        write_png(&to(".alpha.png"), &alpha(rendering))?;
    }
    if extras.depth {
        let (png, largest) = depth(rendering);
        write_png(&to(".depth.png"), &png)?;
        depths.largest.insert(format!("{name}.depth.png"), f64::from(largest) * depths.units);
    }
    Ok(())
}

/// Fails where an option was given that a run brings itself.
pub(super) fn refuse_options_of_a_file(matches: &ArgMatches) -> Result<(), Failure> {
    let scene = DataSpec::augment_args(clap::Command::new("scene"));
    let names = scene.get_arguments().map(|argument| argument.get_id().as_str()).chain(["near"]);
    let given = names
        .into_iter()
        .find(|name| matches.value_source(name) == Some(clap::parser::ValueSource::CommandLine));
    match given {
        None => Ok(()),
        Some(name) => Err(Failure::input(format!(
            "--{} is for a file with --scene DIR (a run brings its own); name the dataset of a file, or leave it out",
            name.replace('_', "-")
        ))),
    }
}

/// What a command line names: a run, or a model with the dataset that it shows.
pub(super) struct Named<'a> {
    pub(super) model: &'a Path,
    pub(super) scene: Option<&'a Path>,
    pub(super) iteration: Option<u32>,
}

impl Named<'_> {
    /// Opens it, as the options of a file say where it is one.
    pub(super) fn open(
        &self,
        rendering: &RenderingArgs,
        needs: Needs,
        matches: &ArgMatches,
        console: &Console,
    ) -> Result<Opened, Failure> {
        let is_run = !is_model(self.model);
        if is_run {
            refuse_options_of_a_file(matches)?;
        }
        let machine = open_machine(&rendering.device, console)?;
        if is_run {
            RunConfig::read(self.model)?;
            let iteration = iteration(self.model, self.iteration)?;
            let moved_to = self.scene.map(Path::to_owned);
            return open_run(self.model, iteration, moved_to, machine, needs, console);
        }
        let Some(scene) = self.scene else {
            return Err(Failure::input(format!(
                "{} is a file, which has no cameras; name a dataset with --scene DIR",
                self.model.display()
            )));
        };
        let model = model_file(self.model, self.iteration)?;
        let RenderingArgs { near, data, .. } = rendering;
        open(&model, scene, data.clone(), (near.0, machine), needs, console)
    }

    /// Opens a model without a dataset.
    fn alone(&self, rendering: &RenderingArgs, console: &Console) -> Result<Filmed, Failure> {
        let machine = open_machine(&rendering.device, console)?;
        let model = model_file(self.model, self.iteration)?;
        let (backend, normalisation, sh_degree) =
            open_alone(&model, (rendering.near.0, machine), console)?;
        let background = rendering.data.background.fixed();
        Ok(Filmed { backend, sh_degree, background, normalisation, cameras: Vec::new() })
    }
}

/// A file name without ending for each view. Names come from data files: no part of one may lead
/// out of the output folder.
fn file_names(views: &[&str]) -> Vec<String> {
    let plain = |name: &str| {
        let parts = name.split(['/', '\\']).filter(|part| !matches!(*part, "" | "." | ".."));
        let parts: Vec<String> = parts.map(|part| part.replace([':', '\0'], "_")).collect();
        if parts.is_empty() { "view".to_owned() } else { parts.join("/") }
    };
    let stem = |name: &str| match name.rsplit_once('.') {
        Some((stem, ending))
            if !ending.contains('/') && !stem.is_empty() && !stem.ends_with('/') =>
        {
            stem.to_owned()
        }
        _ => name.to_owned(),
    };
    let full: Vec<String> = views.iter().map(|name| plain(name)).collect();
    let stems: Vec<String> = full.iter().map(|name| stem(name)).collect();
    let distinct: HashSet<&String> = stems.iter().collect();
    if distinct.len() == stems.len() {
        return stems;
    }
    // a.jpg and a.png: keep the endings; and names that differ only in what was left out get
    // their number as well.
    let distinct: HashSet<&String> = full.iter().collect();
    if distinct.len() == full.len() {
        return full;
    }
    full.iter().enumerate().map(|(i, name)| format!("{name}-{i}")).collect()
}

fn alpha(rendering: &Rendering) -> DynamicImage {
    let Rendering { width, height, alpha, .. } = rendering;
    let pixel = |x: u32, y: u32| Luma([to_u8(alpha[y as usize * *width as usize + x as usize])]);
    ImageBuffer::from_fn(*width, *height, pixel).into()
}

/// Depth relative to its largest value, and that value `[scene units]`.
fn depth(rendering: &Rendering) -> (DynamicImage, f32) {
    let Rendering { width, height, depth, .. } = rendering;
    let largest = depth.iter().copied().fold(0.0, f32::max);
    let scale = if largest > 0.0 { 65_535.0 / largest } else { 0.0 };
    let pixel = |x: u32, y: u32| {
        let value = depth[y as usize * *width as usize + x as usize];
        Luma([(value * scale).round() as u16])
    };
    let image: ImageBuffer<Luma<u16>, Vec<u16>> = ImageBuffer::from_fn(*width, *height, pixel);
    (image.into(), largest)
}

/// Photograph on the left, rendering on the right.
fn pair(image: &Image8, background: [f32; 3], rendering: &Rendering) -> DynamicImage {
    side_by_side(&[photograph(image, background), picture(rendering)], 0).into()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn file_names_stay_in_the_folder_and_apart() {
        assert_eq!(file_names(&["a.jpg", "sub/b.JPG", "c"]), ["a", "sub/b", "c"]);
        assert_eq!(file_names(&["a.jpg", "a.png"]), ["a.jpg", "a.png"]);
        assert_eq!(file_names(&["../../etc/x.png", "/y.png", "C:\\z.png"]), ["etc/x", "y", "C_/z"]);
        assert_eq!(file_names(&["a.png", "../a.png"]), ["a.png-0", "a.png-1"]);
        assert_eq!(file_names(&["..", ".hidden"]), ["view", ".hidden"]);
    }

    fn rendering() -> Rendering {
        Rendering {
            width: 2,
            height: 1,
            rgb: vec![0.0, 0.5, 1.0, -1.0, 2.0, f32::NAN],
            alpha: vec![1.0, 0.2],
            depth: vec![4.0, 1.0],
        }
    }

    #[test]
    fn pixels_are_rounded_and_clamped() {
        assert_eq!(picture(&rendering()).into_raw(), [0, 128, 255, 0, 255, 0]);
        assert_eq!(alpha(&rendering()).into_luma8().into_raw(), [255, 51]);
        let (png, largest) = depth(&rendering());
        assert_eq!(png.into_luma16().into_raw(), [65_535, 16_384]);
        assert!((largest - 4.0).abs() < f32::EPSILON);
        let empty = Rendering { depth: vec![0.0; 2], ..rendering() };
        assert_eq!(depth(&empty).0.into_luma16().into_raw(), [0, 0]);
    }

    #[test]
    fn a_pair_shows_the_photograph_on_the_background_first() {
        let image = Image8 {
            width: 2,
            height: 1,
            rgb: vec![10, 20, 30, 200, 200, 200],
            alpha: Some(vec![255, 0]),
            mask: None,
        };
        let pair = pair(&image, [1.0, 0.0, 0.0], &rendering()).into_rgb8();
        assert_eq!(pair.dimensions(), (4, 1));
        assert_eq!(&pair.as_raw()[..6], [10, 20, 30, 255, 0, 0]);
        assert_eq!(&pair.as_raw()[6..], [0, 128, 255, 0, 255, 0]);
    }
}
