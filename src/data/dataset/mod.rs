//! Loads datasets: photographs with known cameras, in any of the supported formats.
//!
//! The files in the folder decide the format: `transforms_train.json` with `transforms_test.json`,
//! else a COLMAP model under `sparse/0`, else `transforms.json`, else a CSV file of RealityCapture. An
//! archive is read as the folder in it. All files are untrusted: see [`DatasetError`].

mod archive;
pub mod builtin;
mod cache;
mod colmap;
mod exif;
mod folders;
mod formats;
pub mod images;
mod jpeg;
mod json;
pub mod lens;
mod mask;
mod masks;
pub mod normalise;
mod options;
mod paths;
mod photographs;
mod pose;
mod prepare;
mod realitycapture;
mod source_file;
mod tracks;
mod transforms;
pub mod undistort;
mod wanted;
mod window;

#[cfg(test)]
#[allow(
    clippy::semicolon_if_nothing_returned,
    clippy::float_cmp,
    reason = "tables of one-line edits; exact values"
)]
pub(crate) mod tests;

use std::path::{Path, PathBuf};
use std::sync::Arc;

use glam::{DMat3, DVec3};

pub use crate::error::LoadError as DatasetError;
pub use crate::points::PointCloud;
pub use archive::is_archive;
pub use builtin::GroundTruth;
use densify_core::camera::Camera;
use densify_core::memory::Bytes;
use densify_core::numbers::grouped;
pub use exif::ReportedExposures;
use formats::read_scene;
pub use formats::{DatasetFormat, formats};
use lens::Lens;
use masks::MaskFile;
use normalise::Normalisation;
pub use options::{FarCameras, LoadOptions, MaskMode, Resolution, Split};
use paths::Root;
pub use tracks::{MIN_VIEWS, Tracks};
pub use wanted::view_line;
pub use window::Part;

/// A scene ready for training: cameras and points in normalised coordinates.
#[derive(Debug, Clone)]
pub struct Dataset {
    /// Folder of the dataset, or its archive; no image lies outside it, except with `--images`.
    pub root: PathBuf,
    /// The files of an archive.
    unpacked: Option<Arc<archive::Unpacked>>,
    /// Views to train on, sorted by name; never empty.
    pub train: Vec<View>,
    /// Views held out, sorted by name.
    pub test: Vec<View>,
    /// Points of the reconstruction, if the dataset has any.
    pub points: PointCloud,
    /// Which training views show which point, if [requested](LoadOptions::tracks) and known.
    pub tracks: Tracks,
    /// From the dataset's own coordinates to the normalised ones used here.
    pub normalisation: Normalisation,
    /// What [the surface](Self::ground_truth) that the images were rendered from takes at most while it is
    /// made `[bytes]`; `None` where it is not known.
    pub surface_bytes: Option<u64>,
    /// Notes for the user from loading (dropped points, missing frames).
    pub notes: Vec<String>,
}

/// One posed image.
#[derive(Debug, Clone)]
pub struct View {
    /// Name as in the dataset, unique, with `/` as separator.
    pub name: String,
    /// Camera at training resolution, in normalised coordinates.
    pub camera: Camera,
    /// Where the pixels come from.
    pub source: images::ImageSource,
}

/// What the reader of a format returns.
#[derive(Debug, Default)]
struct Scene {
    /// The file that lists the frames.
    listing: PathBuf,
    frames: Vec<Frame>,
    /// Where the first image that does not exist was looked for.
    first_missing: Option<PathBuf>,
    points: PointCloud,
    points_file: Option<PathBuf>,
    /// Tracks; they name views by [`Frame::id`].
    tracks: Tracks,
    /// Whether the dataset brings its own test split.
    own_split: bool,
    /// As [`Dataset::surface_bytes`], where the reader knows.
    surface_bytes: Option<u64>,
    notes: Vec<String>,
}

/// One posed image in the dataset's own coordinates.
#[derive(Debug)]
struct Frame {
    name: String,
    /// Name of the frame in tracks, if there are any.
    id: Option<u32>,
    /// File and frame, for messages.
    origin: String,
    /// The path of the image as the file lists it.
    listed: String,
    image: PathBuf,
    /// The divisor of the folder `images_K` that the image is in.
    reduced: Option<u32>,
    mask: Option<MaskFile>,
    lens: Lens,
    /// Whether the pose file says what size the lens is for, and not the image.
    is_sized: bool,
    rotation: DMat3,
    translation: DVec3,
    held_out: bool,
}

impl Dataset {
    /// Loads the dataset in the folder or ZIP archive `path`, or the built-in scene that `path` names
    /// (`scene:NAME`, see [`builtin`]). Image files are checked by their headers; pixels
    /// are read later, through [`images::ImageCache`].
    ///
    /// # Errors
    /// When the format is unknown, a file is missing, unreadable or contradicts itself, or no
    /// view is left to train on. The message names file, field and remedy.
    pub fn load(path: &Path, options: &LoadOptions) -> Result<Self, DatasetError> {
        if let Some(name) = builtin::name(path) {
            return builtin::load(path, name, options);
        }
        if archive::is_zip(path) {
            return archive::load(path, options);
        }
        if path.is_file() {
            let remedy = "name the dataset's folder, or a whole ZIP archive of it: if this was one, it is damaged, or \
                          its download has failed";
            return Err(DatasetError(format!(
                "{}: this file is no dataset and no ZIP archive; {remedy}",
                path.display()
            )));
        }
        Self::in_folder(path, options)
    }

    fn in_folder(path: &Path, options: &LoadOptions) -> Result<Self, DatasetError> {
        let root = Root::new(path)?;
        let scene = read_scene(&root, options)?;
        if scene.frames.is_empty() {
            let listing = scene.listing.display();
            let first = scene.first_missing.map_or_else(String::new, |path| {
                format!("; the first one looked for is {}", path.display())
            });
            return Err(DatasetError(format!(
                "{listing} lists no image that exists{first}; put the images there, or name their folder \
                 with --images"
            )));
        }
        prepare::prepare(path, scene, options)
    }

    /// The scene's extent `[scene units]`: 1.1 times the largest distance of a training camera from
    /// their mean. Normalisation makes it the same for every scene; where all cameras are at one
    /// place, it follows the spread of the points instead.
    #[must_use]
    pub fn extent(&self) -> f64 {
        normalise::EXTENT
    }

    /// Width and height that hold every view `[px]`.
    #[must_use]
    pub fn largest_image(&self) -> (u32, u32) {
        let cameras = self.train.iter().chain(&self.test).map(|view| &view.camera);
        cameras.fold((1, 1), |(w, h), camera| (w.max(camera.width), h.max(camera.height)))
    }

    /// A line about it: views, their size, points.
    #[must_use]
    pub fn describe(&self) -> String {
        let (width, height) = self.largest_image();
        let decoded: u64 = self.train.iter().map(|view| view.source.loaded_bytes()).sum();
        format!(
            "{} views to train on ({} decoded), {} held out, up to {width}x{height} px, {} points",
            self.train.len(),
            Bytes(decoded),
            self.test.len(),
            grouped(self.points.len()),
        )
    }
}
