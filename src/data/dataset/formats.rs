//! The registry of dataset formats. A new format is one file that defines a [`DatasetFormat`], its line
//! in [`formats`], and a folder of example files in `tests/fuzz/corpus` with the format's name.

use super::paths::Root;
use super::{LoadError, LoadOptions, Scene, colmap, realitycapture, transforms};

/// A format of datasets in folders.
#[derive(Debug, Clone, Copy)]
pub struct DatasetFormat {
    /// Name of the format and of the folder with its fuzz corpus.
    pub name: &'static str,
    /// The program or data set that the format comes from, for messages.
    pub title: &'static str,
    /// A file of the format, relative to the dataset. Fuzz inputs that consist of one file get this name.
    pub file: &'static str,
    /// The files that identify the format, for messages.
    pub files: &'static str,
    /// Reads the dataset in a folder; `None` if the folder has none of the files.
    pub(super) read: fn(&Root, &LoadOptions) -> Result<Option<Scene>, LoadError>,
}

/// All formats, in the order in which they are tried.
pub fn formats() -> &'static [&'static DatasetFormat] {
    &[&transforms::SPLIT_FORMAT, &colmap::FORMAT, &transforms::FORMAT, &realitycapture::FORMAT]
}

/// Reads a folder with the reader of the first format that recognises it.
///
/// # Errors
/// When no format recognises the folder, or a file is unreadable or contradicts itself.
pub(super) fn read_scene(root: &Root, options: &LoadOptions) -> Result<Scene, LoadError> {
    // `sparse` names one of several COLMAP models, so no other format is tried.
    let chosen = options.sparse.is_some();
    for format in formats().iter().filter(|format| !chosen || format.name == colmap::FORMAT.name) {
        if let Some(scene) = (format.read)(root, options)? {
            return Ok(scene);
        }
    }
    Err(LoadError::Data(format!(
        "{} is not a dataset: it has neither the files of {}; give a folder or ZIP archive with one of these",
        root.path().display(),
        formats()
            .iter()
            .map(|f| format!("{} ({})", f.title, f.files))
            .collect::<Vec<_>>()
            .join(" nor of ")
    )))
}
