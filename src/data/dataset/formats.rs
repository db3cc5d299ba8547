//! The registry of dataset formats. A new format is one file that defines a [`DatasetFormat`], its line
//! in [`formats`], and a folder of example files in `tests/fuzz/corpus` with the format's name.

use std::path::Path;

use serde_json::Value;

use super::paths::Root;
use super::{LoadError, LoadOptions, Note, Photographs, Scene, colmap, realitycapture, transforms};
use super::{frame_lists, json};

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
        if let Some(mut scene) = (format.read)(root, options)? {
            if format.name == colmap::FORMAT.name && !chosen {
                let unread = unread_note(root.path(), &scene.listing);
                scene.notes.extend(unread.map(Note::Text));
            }
            return Ok(scene);
        }
    }
    let has_photographs = Photographs::list(root.path()).is_ok_and(|found| !found.all.is_empty());
    let remedy = if has_photographs {
        "find the cameras of its photographs with `densify poses`, or "
    } else {
        ""
    };
    Err(LoadError::Data(format!(
        "{} is not a dataset: it has neither the files of {}; {remedy}give a folder or ZIP archive with one of these",
        root.path().display(),
        formats()
            .iter()
            .map(|f| format!("{} ({})", f.title, f.files))
            .collect::<Vec<_>>()
            .join(" nor of ")
    )))
}

/// Note about a `transforms.json` beside a COLMAP model, which lists its images in `listing`. (Other combinations are the
/// rule: nerfstudio keeps the model that its file was made from.)
fn unread_note(root: &Path, listing: &Path) -> Option<String> {
    let file = root.join(transforms::SINGLE);
    if !file.is_file() {
        return None;
    }
    let model = listing.parent().and_then(|folder| folder.strip_prefix(root).ok())?.display();
    let fields = json::read(&file).ok();
    let is_list =
        |field: &&str| fields.as_ref().and_then(|all| all.get(*field)).is_some_and(Value::is_array);
    let lists =
        if frame_lists::FIELDS.iter().any(is_list) { ", nor are its lists of views" } else { "" };
    let name = transforms::SINGLE;
    Some(format!(
        "{name} is not read{lists}: {model} takes precedence unless you move it elsewhere"
    ))
}
