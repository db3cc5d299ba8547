//! The dataset's options, shared by the commands that read one.

use std::num::NonZeroU32;
use std::path::{Path, PathBuf};

use clap::Args;

use super::console::Console;
use super::failure::Failure;
use super::number;
use crate::dataset::{Dataset, LoadOptions, Resolution, Split};
use crate::memory::Bytes;
use crate::output::SceneConfig;
use crate::schedule::Background;

/// Near plane as a fraction of the scene's extent, where none is given. That is the original's 0.2
/// for an extent of 5. Nearer rows are fog before one camera: with 0.01, views held out lost up to
/// 10 dB to it.
pub(super) const NEAR: f64 = 0.04;

/// Memory for decoded photographs, where nothing else is said `[bytes]`.
pub(super) const DEFAULT_IMAGE_CACHE: u64 = 1 << 30;

/// How to read a dataset.
#[derive(Debug, Args)]
pub(super) struct SceneArgs {
    /// Hold out the dataset's own test views, or every 8th photograph by sorted name, for
    /// measuring
    #[arg(long, help_heading = "Scene", conflicts_with = "test_every")]
    pub(super) eval: bool,
    /// Hold out every K-th photograph by sorted name, the first included
    #[arg(long, value_name = "K", help_heading = "Scene")]
    pub(super) test_every: Option<NonZeroU32>,
    /// Folder of the photographs, where not the dataset's own (relative to the dataset)
    #[arg(long, value_name = "DIR", help_heading = "Scene")]
    pub(super) images: Option<PathBuf>,
    /// 1, 2, 4 or 8: photographs that many times smaller (uses images_2, images_4, images_8 where
    /// they exist); any larger number: their width in pixels
    #[arg(short, long, value_name = "N", help_heading = "Scene", value_parser = resolution)]
    pub(super) resolution: Option<u32>,
    /// Memory for decoded photographs, and on a GPU as much of its own; those beyond it are decoded,
    /// and uploaded, again when their turn comes
    /// `[default: 1GiB, or chosen for --memory]`
    #[arg(long, value_name = "BYTES", help_heading = "Memory", value_parser = number::bytes)]
    pub(super) image_cache: Option<u64>,
    /// What lies behind the scene, and behind transparent images: black, white, random (another
    /// colour at every step) or #rrggbb
    #[arg(long, value_name = "COLOUR", help_heading = "Scene", default_value = "black")]
    pub(super) background: Background,
}

fn resolution(text: &str) -> Result<u32, String> {
    text.parse::<Resolution>().map_err(|e| e.to_string())?;
    text.parse().map_err(|_| format!("`{text}` is no whole number"))
}

impl SceneArgs {
    /// The options with all defaults filled in, for the dataset at `path`.
    pub(super) fn config(&self, path: &Path) -> SceneConfig {
        SceneConfig {
            path: path.to_owned(),
            working_directory: std::env::current_dir().ok().filter(|_| path.is_relative()),
            images: self.images.clone(),
            resolution: self.resolution,
            eval: self.eval || self.test_every.is_some(),
            test_every: self.test_every.map(NonZeroU32::get),
            image_cache: self.image_cache.unwrap_or(DEFAULT_IMAGE_CACHE),
            background: self.background,
        }
    }
}

/// Reads the dataset at `path`, and its tracks if they are wanted; says what there is to say.
pub(super) fn load(
    path: &Path,
    config: &SceneConfig,
    tracks: bool,
    console: &Console,
) -> Result<Dataset, Failure> {
    let dataset = read(path, config, tracks)?;
    for note in &dataset.notes {
        console.say(format_args!("note: {note}"));
    }
    Ok(dataset)
}

/// Reads the dataset at `path`, and its tracks if they are wanted.
pub(super) fn read(path: &Path, config: &SceneConfig, tracks: bool) -> Result<Dataset, Failure> {
    let resolution = config.resolution.map(|number| number.to_string().parse::<Resolution>());
    let split = match config.test_every.map(NonZeroU32::new) {
        Some(Some(every)) => Split::Every(every),
        Some(None) => return Err(Failure::input("test_every is 0; it must be at least 1")),
        None if config.eval => Split::Eval,
        None => Split::None,
    };
    let options = LoadOptions {
        images: config.images.clone(),
        resolution: resolution.transpose().map_err(Failure::input)?,
        split,
        tracks,
    };
    Ok(Dataset::load(path, &options)?)
}

/// Width and height that hold every view of the dataset `[px]`.
pub(super) fn largest_image(dataset: &Dataset) -> (u32, u32) {
    let cameras = dataset.train.iter().chain(&dataset.test).map(|view| &view.camera);
    cameras.fold((1, 1), |(w, h), camera| (w.max(camera.width), h.max(camera.height)))
}

/// A line about the dataset.
pub(super) fn describe(path: &Path, dataset: &Dataset) -> String {
    let (width, height) = largest_image(dataset);
    let decoded: u64 = dataset.train.iter().map(|view| view.source.loaded_bytes()).sum();
    format!(
        "scene    {}: {} views to train on ({} decoded), {} held out, up to {width}x{height} px, {} points",
        path.display(),
        dataset.train.len(),
        Bytes(decoded),
        dataset.test.len(),
        number::grouped(dataset.points.len()),
    )
}
