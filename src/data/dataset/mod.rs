//! Loads datasets: photographs with known cameras, in any of the supported formats.
//!
//! `formats` lists the formats; the first format that recognises its files in a folder reads the folder. A ZIP archive
//! is read as the folder inside it. All files are untrusted: see [`LoadError`].

mod archive;
pub mod builtin;
mod colmap;
mod colours;
mod depth;
mod exif;
mod folders;
mod formats;
mod frame_lists;
mod image_cache;
mod image_file;
pub mod images;
mod jpeg;
mod json;
mod lens;
mod mask;
mod mask_files;
pub mod normalise;
mod options;
mod paths;
mod photograph_place;
mod photographs;
mod pose;
mod prepare;
mod realitycapture;
mod seen_depths;
mod source_file;
mod tracks;
mod transforms;
mod undistort;
mod unposed;
mod view_list;
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

use crate::error::{LoadError, LoadRemedy};
pub use crate::points::PointCloud;
pub use archive::is_archive;
pub use builtin::GroundTruth;
use densify_core::camera::Camera;
use densify_core::memory::Bytes;
use densify_core::numbers::grouped;
use depth::DepthFile;
pub use depth::{
    DepthAlong, DepthChoice, DepthFinding, DepthOptions, DepthOrigin, DepthSource, DepthUnit,
};
pub use exif::ReportedExposures;
use formats::read_scene;
pub use formats::{DatasetFormat, formats};
use images::ImageHeader;
use lens::Lens;
use mask_files::MaskFile;
pub use normalise::EXTENT;
use normalise::Normalisation;
pub(crate) use normalise::median;
pub use options::{FarCameras, LoadOptions, MaskMode, Resolution, Split, TrackReading};
use paths::Root;
pub use photograph_place::cameras_of;
pub use seen_depths::SeenDepths;
pub(crate) use tracks::MIN_VIEWS;
pub use tracks::Tracks;
pub use unposed::{Photograph, Photographs, is_video};
pub use view_list::view_line;
pub use window::Part;

/// A scene ready for training: cameras and points in normalised coordinates.
#[derive(Debug, Clone)]
pub struct Dataset {
    /// Folder or archive of the dataset. All images lie inside it unless the options name another folder of images.
    pub root: PathBuf,
    /// The unpacked files, if `root` is an archive.
    unpacked: Option<Arc<archive::Unpacked>>,
    /// Training views, sorted by name; never empty.
    pub train: Vec<View>,
    /// Views held out for testing, sorted by name.
    pub test: Vec<View>,
    /// Points of the reconstruction; empty if the dataset has none.
    pub points: PointCloud,
    /// Training views that show each point, if [requested](LoadOptions::tracks) and known.
    pub tracks: Tracks,
    /// Transform from the dataset's coordinates to the normalised ones used here.
    pub normalisation: Normalisation,
    /// Peak memory for building the [known surface](Self::ground_truth) `[bytes]`; `None` if the surface is not known.
    pub surface_bytes: Option<u64>,
    /// The depth that the training views have, and the evidence for it; `None` without.
    pub depth: Option<DepthFinding>,
    /// Notes for the user about dropped points, missing frames and the like.
    pub notes: Vec<Note>,
}

/// A note for the user about a dataset. Notes that name an option are variants of their own, because the option's name
/// depends on the interface that shows the note.
#[derive(Debug, Clone, PartialEq)]
pub enum Note {
    /// A note that names no option.
    Text(String),
    /// Cameras far from all others are left out, unless [kept](FarCameras::Keep).
    FarCamerasLeftOut {
        /// Number of cameras.
        count: usize,
        /// Names of the first few of their views.
        names: String,
    },
    /// The largest of several COLMAP models is read, unless another is [chosen](LoadOptions::sparse).
    OtherModels {
        /// The model that is read.
        model: String,
        /// Number of its images.
        images: u64,
        /// The models that are not read, with their numbers of images.
        others: Vec<(String, u64)>,
    },
    /// Undistortion crops photographs, unless the [field of view is kept](LoadOptions::keep_fov).
    Cropped {
        /// Largest share of a photograph that is lost `[%]`.
        percent: f64,
        /// Number of photographs that are cropped noticeably.
        photographs: usize,
    },
    /// A view is trained without its depth because of this fault, which was met in training.
    DepthDropped(Box<LoadError>),
    /// Depth was found, but is not used because of this fault.
    DepthLeftOut(Box<LoadError>),
    /// The scale of depth differs between views, which fitting each of them to its points would correct.
    DepthScalesDiffer {
        /// Half of the views differ by at least this much `[%]`.
        percent: f64,
    },
}

/// One posed image.
#[derive(Debug, Clone)]
pub struct View {
    /// Unique name, as in the dataset, with `/` as separator.
    pub name: String,
    /// Camera at training resolution, in normalised coordinates.
    pub camera: Camera,
    /// Source of the pixels.
    pub source: images::ImageSource,
}

/// The contents of a dataset's files, as the reader of a format returns them.
#[derive(Debug, Default)]
struct Scene {
    /// The file that lists the frames.
    listing: PathBuf,
    frames: Vec<Frame>,
    /// Path of the first missing image, for messages.
    first_missing: Option<PathBuf>,
    points: PointCloud,
    points_file: Option<PathBuf>,
    /// Tracks, which name photographs by [`Frame::id`].
    tracks: Tracks,
    /// True if the dataset defines its own test split.
    own_split: bool,
    /// As [`Dataset::surface_bytes`], if the reader knows it.
    surface_bytes: Option<u64>,
    notes: Vec<Note>,
}

/// One posed image in the dataset's own coordinates.
#[derive(Debug, Clone)]
struct Frame {
    name: String,
    /// Id of the frame in tracks.
    id: Option<u32>,
    /// File and frame, for messages.
    origin: String,
    /// Path of the image as listed in the file.
    listed: String,
    image: PathBuf,
    /// Divisor K of the folder `images_K` that contains the image.
    reduced: Option<u32>,
    mask: Option<MaskFile>,
    /// The file of its depth, if there is one; a fault does not concern runs without depth.
    depth: Result<Option<DepthFile>, LoadError>,
    lens: Lens,
    /// Header of the image, if the pose file states no image size; the lens then has the size of the image.
    header: Option<ImageHeader>,
    rotation: DMat3,
    translation: DVec3,
    held_out: bool,
}

impl Dataset {
    /// Faults of depth maps met in training since the last call, which cost only the depth of their views. Each is
    /// returned once.
    pub fn take_depth_faults(&self) -> Vec<Note> {
        let depth = self.train.iter().find_map(|view| view.source.depth.as_ref());
        let faults = depth.map_or_else(Vec::new, |depth| depth.take_faults());
        let named = |fault| match &self.unpacked {
            Some(unpacked) => unpacked.error_with_archive_name(fault),
            None => fault,
        };
        faults.into_iter().map(|fault| Note::DepthDropped(Box::new(named(fault)))).collect()
    }

    /// Loads the dataset in the folder or ZIP archive `path`, or the built-in scene `scene:NAME` (see [`builtin`]).
    /// Images are checked by their headers; their pixels are read later, through [`images::ImageCache`].
    ///
    /// # Errors
    /// When the format is unknown, a file is missing, unreadable or contradictory, or no view is left to train on. The
    /// message names the file, the field and the remedy.
    pub fn load(path: &Path, options: &LoadOptions) -> Result<Self, LoadError> {
        if let Some(name) = builtin::name(path) {
            return builtin::load(path, name, options);
        }
        if let Some(name) = builtin::meant(path) {
            return Err(LoadError::Data(format!(
                "{name} does not exist; the built-in scene of this name is scene:{name}"
            )));
        }
        if archive::is_zip(path) {
            return archive::load(path, options);
        }
        if path.is_file() {
            return Err(LoadError::Data(format!(
                "{}: this file is neither a dataset nor a ZIP archive; give the dataset's folder, or a \
                 complete ZIP archive of it (a damaged or incompletely downloaded archive is not recognised)",
                path.display()
            )));
        }
        Self::load_folder(path, options)
    }

    fn load_folder(path: &Path, options: &LoadOptions) -> Result<Self, LoadError> {
        let root = Root::new(path)?;
        let scene = read_scene(&root, options)?;
        if scene.frames.is_empty() {
            let listing = scene.listing.display();
            let first = scene.first_missing.map_or_else(String::new, |path| {
                let other = paths::existing_namesake(&path);
                format!("; the first one looked for is {}{other}", path.display())
            });
            let problem = format!("{listing} lists no image that exists{first}");
            return Err(LoadError::Remedied { problem, remedy: LoadRemedy::AddOrImagesFolder });
        }
        prepare::prepare(path, scene, options)
    }

    /// The scene's extent `[scene units]`: 1.1 times the largest distance of a training camera from the mean of all
    /// training cameras. It is the same for every normalised scene.
    pub fn extent(&self) -> f64 {
        normalise::EXTENT
    }

    /// The depths at which the views see the points.
    pub fn seen_depths(&self) -> SeenDepths {
        let cameras: Vec<Camera> =
            self.train.iter().chain(&self.test).map(|view| view.camera).collect();
        SeenDepths::measure(&self.points.positions, &cameras)
    }

    /// Largest width and largest height of all views `[px]`.
    pub fn largest_image(&self) -> (u32, u32) {
        let cameras = self.train.iter().chain(&self.test).map(|view| &view.camera);
        cameras.fold((1, 1), |(w, h), camera| (w.max(camera.width), h.max(camera.height)))
    }

    /// One line for the user: numbers of views and points, and image sizes.
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
