//! The error of every reader: each message names the file, the field and the remedy.

use std::fmt::Display;
use std::path::{Path, PathBuf};

use densify_core::files::one_line;

/// A dataset, one of its images, or a model that cannot be loaded. A remedy that names an option is a [`LoadRemedy`]
/// and no part of the `Display` text, because options' names depend on the interface that shows the error.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum LoadError {
    /// A fault that no option remedies: the file, the field, and the remedy.
    #[error("{0}")]
    Data(String),
    /// A fault that an option may remedy.
    #[error("{problem}")]
    Remedied {
        /// The file, the field and the fault.
        problem: String,
        /// The remedy, by an option or otherwise.
        remedy: LoadRemedy,
    },
    /// A fault in the [list of views](crate::dataset::LoadOptions::views).
    #[error("{}: {problem}", file.display())]
    ViewList {
        /// The list.
        file: PathBuf,
        /// The line and the fault.
        problem: String,
    },
    /// Masks are to be inverted, or masked pixels to become background, but the dataset has no masks.
    #[error("{}: no photograph has a mask", listing.display())]
    NoMasks {
        /// The file that lists the photographs.
        listing: PathBuf,
        /// True if masks are to be inverted, false if masked pixels are only to become background.
        inverted: bool,
    },
}

/// An option that remedies a [`LoadError`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum LoadRemedy {
    /// Restore a missing image, or name the folder of images.
    RestoreOrImagesFolder,
    /// Add the missing images, or name their folder.
    AddOrImagesFolder,
    /// Name a folder of images instead of paths that lead out of the dataset.
    OtherImagesFolder,
    /// Name a folder that holds both images in their original subfolders: in the given folder, both match one file.
    ImagesFolderOfBoth,
    /// Invert masks that hide everything (true), or stop inverting them (false).
    InvertMasks(bool),
    /// Hold out fewer views.
    LargerTestEvery,
    /// Keep the usable field of view of a lens whose distortion is not invertible.
    KeepFieldOfView,
    /// Name a folder that holds a COLMAP model.
    ColmapModel,
    /// Correct the depth, or how it is read.
    Depth(DepthRemedy),
}

/// A remedy for depth that fails a check; leaving it out is always another.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum DepthRemedy {
    /// Add the files.
    AddFiles,
    /// Export the files again.
    Repair,
    /// State the unit of the values.
    Unit,
    /// Read the values as distances along rays.
    AlongRay,
    /// Read the values as distances along the optical axis.
    AlongAxis,
    /// Read the values as inverse depth of unknown scale and offset.
    Relative,
    /// Read the values as depth.
    NotRelative,
    /// Register depth and colour.
    Register,
    /// Give each map the name of its photograph.
    OtherViews,
    /// Move the point cloud to the coordinates of the dataset.
    Align,
    /// Correct the scales and offsets in `depth_params.json`.
    Params,
    /// Reconstruct more points.
    MorePoints,
    /// Leave the depth out, as the problem already says what else helps.
    LeaveOut,
}

impl LoadError {
    /// A file cannot be opened or read.
    pub(crate) fn io(path: &Path) -> impl FnOnce(std::io::Error) -> Self + '_ {
        move |source| {
            // Errors raised by densify itself already contain the remedy.
            let is_ours = source.raw_os_error().is_none();
            let path = path.display();
            if is_ours && source.kind() == std::io::ErrorKind::Other {
                return Self::Data(format!("{path}: the file: {source}"));
            }
            Self::Data(format!(
                "cannot read {path}: {source}; check that it exists and is readable"
            ))
        }
    }

    /// A file contradicts its format or itself; `field` names the record, line or field.
    pub(crate) fn malformed(
        path: &Path,
        field: impl Display,
        problem: impl Display,
        remedy: &str,
    ) -> Self {
        let [field, problem] = [field.to_string(), problem.to_string()].map(|text| one_line(&text));
        Self::Data(format!("{}: {field}: {problem}; {remedy}", path.display()))
    }

    /// As [`malformed`](Self::malformed), for a model or a point cloud, which is best exported again.
    pub(crate) fn damaged(path: &Path, field: impl Display, problem: impl Display) -> Self {
        Self::malformed(path, field, problem, "export the file again")
    }

    /// As [`malformed`](Self::malformed), for a fault that an option may remedy.
    pub(crate) fn remedied(
        path: &Path,
        field: impl Display,
        problem: impl Display,
        remedy: LoadRemedy,
    ) -> Self {
        let [field, problem] = [field.to_string(), problem.to_string()].map(|text| one_line(&text));
        Self::Remedied { problem: format!("{}: {field}: {problem}", path.display()), remedy }
    }

    /// A lens that cannot be converted to a pinhole.
    pub(crate) fn lens(path: &Path, field: &str, problem: impl Display) -> Self {
        let remedy = "undistort the images first, e.g. with `colmap image_undistorter`";
        Self::malformed(path, field, problem, remedy)
    }

    /// A lens model that is not one of those supported.
    pub(crate) fn lens_model(path: &Path, field: &str, model: &str, supported: &str) -> Self {
        let problem = format!("the camera model {model} is not one of {supported}");
        if !matches!(model, "EQUIRECTANGULAR" | "SPHERICAL") {
            return Self::lens(path, field, problem);
        }
        let remedy = "cut the panoramas into the faces of a cube and reconstruct the scene from these, as COLMAP's \
                      `panorama_sfm.py` does";
        Self::malformed(path, field, problem, remedy)
    }

    /// An image or mask whose size `[px]` disagrees with its camera.
    pub(crate) fn size(path: &Path, (width, height): (u32, u32), camera: (u32, u32)) -> Self {
        Self::Data(format!(
            "{} is {width}x{height} px, but its camera says {}x{} px; use the images that the cameras were \
             estimated from, or proportionally rescaled copies of them",
            path.display(),
            camera.0,
            camera.1
        ))
    }

    /// An image that cannot be decoded.
    pub(crate) fn image(path: &Path, problem: impl Display) -> Self {
        Self::Data(format!(
            "cannot decode {}: {}; convert it to an 8- or 16-bit PNG, JPEG or WebP of at most 16384 px a \
             side",
            path.display(),
            one_line(problem.to_string().trim())
        ))
    }

    /// An image named in a field of a file does not exist, but perhaps one that has only another extension, `namesake`.
    pub(crate) fn missing_image(
        path: &Path,
        field: &str,
        image: &Path,
        namesake: Option<&str>,
    ) -> Self {
        let other = namesake.map_or_else(String::new, |other| format!(", but {other} does"));
        let problem = format!("the file {} does not exist{other}", image.display());
        Self::remedied(path, field, problem, LoadRemedy::RestoreOrImagesFolder)
    }
}
