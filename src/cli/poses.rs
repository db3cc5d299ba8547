//! `densify poses`: finds the cameras of photographs.

use std::path::{Path, PathBuf};

use clap::{Args, ValueEnum};

use super::console::Console;
use super::threads;
use super::train::Follower;
use densify_poses::{Options, are_photographs, find, is_current};
use densify_run::failure::Failure;
use densify_run::{Threads, Whole};

/// Finds the cameras of photographs, and writes a scene that `densify train` reads.
///
/// The work is done by pycolmap, a Python package (`pip install pycolmap`, version 4 or newer), and checked here: a pose
/// is kept only if it has 30 points and at least two other photographs confirm it, and is rejected if most of its
/// matches or its best one contradict it. Photographs whose poses are rejected are named and left out. The scene is a
/// COLMAP reconstruction with links to the photographs (copies on another disk); poses.json says what became of each.
///
/// Photographs are JPEG, PNG or WebP. Those with the same make, model and focal length in EXIF share a camera; without
/// EXIF, those of the same size and folder do. Masks are read from masks/. Of a video, ffmpeg takes the frames. All
/// pairs of up to 200 photographs are compared, otherwise neighbours by name.
///
/// A call that was stopped is continued by the same command; results so far are in SCENE.unfinished.
#[derive(Debug, Args)]
#[command(after_help = EXAMPLES)]
pub(super) struct PosesArgs {
    /// Folder of photographs, or a video
    #[arg(value_name = "PHOTOS")]
    input: PathBuf,
    /// Folder of the scene to write
    #[arg(short, long, value_name = "SCENE")]
    output: PathBuf,
    /// Replace a scene that exists
    #[arg(long)]
    overwrite: bool,
    /// Python that has pycolmap `[default: python3, else python]`
    #[arg(long, value_name = "PROGRAM")]
    python: Option<PathBuf>,
    /// Camera model
    #[arg(long, value_name = "NAME", value_enum, default_value_t)]
    camera: CameraModel,
    /// Frames to take from a video: the sharpest of as many parts of equal length
    #[arg(long, value_name = "N", default_value = "150")]
    frames: Whole<10, 2000>,
    /// Leave the scene turned as it was found, instead of upright
    #[arg(long)]
    keep_frame: bool,
    /// Processor threads to use `[default: all]`
    #[arg(long, value_name = "N")]
    threads: Option<Threads>,
}

const EXAMPLES: &str = "\
Examples:
  densify poses photos -o scenes/garden
  densify poses walk.mp4 -o scenes/walk --frames 200
  densify poses renders -o scenes/chair --camera pinhole
  densify poses photos -o scenes/garden --python venv/bin/python
  densify train photos                    does the same first, into output/photos-poses";

/// Models of cameras, by how much their lenses distort.
#[derive(Debug, Clone, Copy, Default, ValueEnum)]
enum CameraModel {
    /// No distortion: renderings, and photographs that were undistorted
    Pinhole,
    /// One coefficient of radial distortion: most cameras
    #[default]
    Radial,
    /// Two radial and two tangential coefficients: strong distortion
    Opencv,
    /// Fisheyes
    Fisheye,
}

impl CameraModel {
    /// COLMAP's name.
    fn name(self) -> &'static str {
        match self {
            Self::Pinhole => "SIMPLE_PINHOLE",
            Self::Radial => "SIMPLE_RADIAL",
            Self::Opencv => "OPENCV",
            Self::Fisheye => "OPENCV_FISHEYE",
        }
    }
}

pub(super) fn run(args: &PosesArgs, console: &Console) -> Result<(), Failure> {
    let options = Options {
        input: args.input.clone(),
        output: args.output.clone(),
        python: args.python.clone(),
        threads: count(args.threads),
        camera_model: args.camera.name().to_owned(),
        frames: args.frames.0,
        keep_frame: args.keep_frame,
        overwrite: args.overwrite,
    };
    threads::limit(args.threads);
    let follower = Follower::new(console);
    follower.listen();
    let found = find(&options, &follower)?;
    let output = args.output.display();
    console.result(format_args!(
        "{} of {} photographs in {output}",
        found.accepted, found.photographs
    ));
    Ok(())
}

fn count(threads: Option<Threads>) -> u32 {
    threads.map_or_else(
        || u32::try_from(rayon::current_num_threads()).unwrap_or(1),
        |threads| threads.0,
    )
}

/// The dataset to train on if `input` holds photographs without cameras: these are found first, unless an earlier call
/// has found them.
pub(super) fn dataset_of(
    input: &Path,
    threads: Option<Threads>,
    follower: &Follower<'_>,
    console: &Console,
) -> Result<Option<PathBuf>, Failure> {
    if !are_photographs(input) {
        return Ok(None);
    }
    let full = input.canonicalize().unwrap_or_else(|_| input.to_owned());
    let name = full.file_stem().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default();
    let output = Path::new("output").join(format!("{name}-poses"));
    let shown = output.display();
    if is_current(input, &output) {
        console.say(format_args!("poses    those in {shown}, found before"));
        return Ok(Some(output));
    }
    follower.listen();
    console.say(format_args!(
        "poses    {} has no cameras: finding them first, into {shown}",
        input.display()
    ));
    let options = Options {
        input: input.to_owned(),
        output: output.clone(),
        python: None,
        threads: count(threads),
        camera_model: CameraModel::default().name().to_owned(),
        frames: 150,
        keep_frame: false,
        overwrite: false,
    };
    let origin = format!("{} is not a dataset, but has photographs", input.display());
    let found = find(&options, follower).map_err(|error| Failure::from(error).within(&origin))?;
    console.say(format_args!(
        "poses    {} of {} photographs in {shown}",
        found.accepted, found.photographs
    ));
    Ok(Some(output))
}
