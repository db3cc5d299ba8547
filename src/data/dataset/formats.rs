//! The registry of dataset formats. A new format is one file that defines a [`DatasetFormat`], its line in
//! [`formats`], and a folder of example files in `tests/fuzz/corpus` with the format's name.

use super::paths::Root;
use super::{DatasetError, LoadOptions, Scene, colmap, realitycapture, transforms};

/// A format of datasets.
#[derive(Debug, Clone, Copy)]
pub struct DatasetFormat {
    /// Name, also of the folder with its fuzz corpus.
    pub name: &'static str,
    /// A file of the format, relative to the dataset. Fuzz inputs that are one file get this name.
    pub file: &'static str,
    /// The files by which a folder is recognised, for messages.
    pub(super) marker: &'static str,
    /// Reads the dataset in a folder; `None` if the folder lacks the marker.
    pub(super) read: fn(&Root, &LoadOptions) -> Result<Option<Scene>, DatasetError>,
}

/// All formats, in the order in which a folder is searched for them.
#[must_use]
pub fn formats() -> [&'static DatasetFormat; 4] {
    [&transforms::NERF_SYNTHETIC, &colmap::FORMAT, &transforms::NERFSTUDIO, &realitycapture::FORMAT]
}

/// Reads a dataset in the first format whose marker its folder has.
///
/// # Errors
/// When there is no marker, or a file is unreadable or contradicts itself.
pub(super) fn read_scene(root: &Root, options: &LoadOptions) -> Result<Scene, DatasetError> {
    for format in formats() {
        if let Some(scene) = (format.read)(root, options)? {
            return Ok(scene);
        }
    }
    let markers: Vec<&str> = formats().iter().map(|format| format.marker).collect();
    Err(DatasetError(format!(
        "{} is not a dataset: found neither {}; name a folder or ZIP archive that holds one of these",
        root.path().display(),
        markers.join(", nor ")
    )))
}
