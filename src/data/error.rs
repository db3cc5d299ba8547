//! The error of every reader: each message names the file, the field and the remedy.

use std::fmt::Display;
use std::path::Path;

use densify_core::files::one_line;

/// A dataset, one of its images, or a model that cannot be loaded.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{0}")]
pub struct LoadError(pub(crate) String);

impl LoadError {
    /// A file cannot be opened or read.
    pub(crate) fn io(path: &Path) -> impl FnOnce(std::io::Error) -> Self + '_ {
        move |source| {
            // Errors raised by densify itself already contain the remedy.
            let is_ours = source.raw_os_error().is_none();
            let path = path.display();
            if is_ours && source.kind() == std::io::ErrorKind::Other {
                return Self(format!("{path}: the file: {source}"));
            }
            Self(format!("cannot read {path}: {source}; check that it exists and is readable"))
        }
    }

    /// A file that contradicts its format or itself; `field` names the record, line or field.
    pub(crate) fn malformed(
        path: &Path,
        field: impl Display,
        problem: impl Display,
        remedy: &str,
    ) -> Self {
        let [field, problem] = [field.to_string(), problem.to_string()].map(|text| one_line(&text));
        Self(format!("{}: {field}: {problem}; {remedy}", path.display()))
    }

    /// As [`malformed`](Self::malformed), for a model or a point cloud, which is best exported again.
    pub(crate) fn damaged(path: &Path, field: impl Display, problem: impl Display) -> Self {
        Self::malformed(path, field, problem, "export the file again")
    }

    /// A lens that cannot be converted to a pinhole.
    pub(crate) fn lens(path: &Path, field: &str, problem: impl Display) -> Self {
        let remedy = "undistort the images first, e.g. with `colmap image_undistorter`";
        Self::malformed(path, field, problem, remedy)
    }

    /// An image or mask whose size `[px]` disagrees with its camera.
    pub(crate) fn size(path: &Path, (width, height): (u32, u32), camera: (u32, u32)) -> Self {
        Self(format!(
            "{} is {width}x{height} px, but its camera says {}x{} px; use the images that the cameras were \
             estimated from, or a proportional rescale of them",
            path.display(),
            camera.0,
            camera.1
        ))
    }

    /// An image that cannot be decoded.
    pub(crate) fn image(path: &Path, problem: impl Display) -> Self {
        Self(format!(
            "cannot decode {}: {}; convert it to an 8- or 16-bit PNG, JPEG or WebP of at most 16384 px a \
             side",
            path.display(),
            one_line(problem.to_string().trim())
        ))
    }

    /// An image that a field of a file names does not exist.
    pub(crate) fn missing_image(path: &Path, field: &str, image: &Path) -> Self {
        let problem = format!("the file {} does not exist", image.display());
        let remedy = "restore it, or name the folder that holds the images with --images";
        Self::malformed(path, field, problem, remedy)
    }
}
