//! Errors of loading a dataset: each message names the file, the field and the remedy.

use std::path::{Path, PathBuf};

use crate::foreign::one_line;

/// Why a dataset, or one of its images, cannot be loaded.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum DatasetError {
    /// A file cannot be opened or read.
    #[error("cannot read {path}: {source}; check that it exists and is readable")]
    Io {
        /// The file or folder.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// A built-in scene cannot be made.
    #[error("{0}")]
    BuiltIn(#[from] densify_scenegen::Error),
    /// The folder has no supported format.
    #[error(
        "{path} is not a dataset: found neither {looked_for}; name a folder with a COLMAP model or transforms files"
    )]
    Unrecognised {
        /// The folder.
        path: PathBuf,
        /// The files that were looked for.
        looked_for: &'static str,
    },
    /// A file's contents contradict its format or themselves.
    #[error("{path}: {field}: {problem}; {remedy}")]
    Malformed {
        /// The file.
        path: PathBuf,
        /// Where in the file: a record, a line, a field.
        field: String,
        /// What is wrong there.
        problem: String,
        /// What to do about it.
        remedy: &'static str,
    },
    /// A path in a data file leads out of the dataset's folder, or is not a path.
    #[error(
        "{path}: {field}: the path {value:?} {problem}; only paths below the dataset's folder are followed \
         (a folder elsewhere can be named with --images)"
    )]
    UnsafePath {
        /// The file that holds the path.
        path: PathBuf,
        /// The field that holds it.
        field: String,
        /// The path as written, cut after 200 characters.
        value: String,
        /// What is wrong with it.
        problem: &'static str,
    },
    /// A lens that cannot be converted to a pinhole.
    #[error(
        "{path}: {field}: {problem}; undistort the images first, e.g. with `colmap image_undistorter`"
    )]
    Lens {
        /// The file that holds the camera.
        path: PathBuf,
        /// The camera.
        field: String,
        /// The unsupported model or parameters.
        problem: String,
    },
    /// An image or mask whose size disagrees with its camera.
    #[error(
        "{path} is {width}x{height} px, but its camera says {camera_width}x{camera_height} px; \
         use the images that the cameras were made from, or a proportional rescale of them"
    )]
    ImageSize {
        /// The image.
        path: PathBuf,
        /// Its width `[px]`.
        width: u32,
        /// Its height `[px]`.
        height: u32,
        /// The width expected `[px]`.
        camera_width: u32,
        /// The height expected `[px]`.
        camera_height: u32,
    },
    /// An image that cannot be decoded.
    #[error(
        "cannot decode {path}: {problem}; convert it to an 8- or 16-bit PNG, JPEG or WebP of at most 16384 px a side"
    )]
    Image {
        /// The image.
        path: PathBuf,
        /// What the decoder said.
        problem: String,
    },
    /// An image that the dataset names is not there.
    #[error(
        "{path}: {field}: the file {image} does not exist; restore it, or name the folder that holds the images with --images"
    )]
    MissingImage {
        /// The file that names it.
        path: PathBuf,
        /// The field that names it.
        field: String,
        /// Where it was looked for.
        image: PathBuf,
    },
    /// No image has a pose.
    #[error(
        "{path} lists no image that exists{}; put the images there, or name their folder with --images",
        looked_for.as_ref().map_or_else(String::new, |path| format!(
            "; the first one looked for is {}", path.display()
        ))
    )]
    NoImages {
        /// The file that should list them.
        path: PathBuf,
        /// Where the first of them was looked for, if it lists any.
        looked_for: Option<PathBuf>,
    },
    /// The test split takes every view.
    #[error(
        "no view is left to train on: the test split takes all {views}; use a larger --test-every, or leave it out"
    )]
    NoTrainingViews {
        /// Number of views.
        views: usize,
    },
    /// Too many points are unusable.
    #[error(
        "{path}: {bad} of {total} points are not finite, more than 1 %; repair the reconstruction"
    )]
    BadPoints {
        /// The file of the points.
        path: PathBuf,
        /// Number of unusable points.
        bad: usize,
        /// Number of points.
        total: usize,
    },
    /// The file of the point cloud is unusable.
    #[error(transparent)]
    Ply(#[from] crate::import::ply::PlyError),
}

impl DatasetError {
    pub(super) fn io(path: &Path) -> impl FnOnce(std::io::Error) -> Self + '_ {
        move |source| match source.raw_os_error() {
            // Said by this program, not by the system.
            None if source.kind() == std::io::ErrorKind::Other => {
                Self::malformed(path, "the file", source.to_string(), "put the right file there")
            }
            _ => Self::Io { path: path.to_owned(), source },
        }
    }

    pub(super) fn malformed(
        path: &Path,
        field: impl Into<String>,
        problem: impl Into<String>,
        remedy: &'static str,
    ) -> Self {
        Self::Malformed {
            path: path.to_owned(),
            field: one_line(&field.into()),
            problem: one_line(&problem.into()),
            remedy,
        }
    }
}
