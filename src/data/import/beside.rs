//! Files that a model's file names: only those in its own folder, and none that a link leads out of it.

use std::fs::File;
use std::path::Path;

use super::model::malformed;
use crate::dataset::DatasetError;
use densify_core::files;

/// Opens the file of this name in the folder of `path`, whose `field` names it.
///
/// # Errors
/// When the name is a path or leads out of the folder, or as [`files::open`].
pub(super) fn open(path: &Path, field: &str, name: &str) -> Result<File, DatasetError> {
    let is_plain = !name.is_empty()
        && name.len() <= 255
        && !matches!(name, "." | "..")
        && !name.contains(|c: char| c.is_control() || matches!(c, '/' | '\\' | ':'));
    let shown: String = name.chars().take(200).collect();
    if !is_plain {
        let problem = format!("{shown:?} is no plain name of a file in the same folder");
        return Err(malformed(path, field, problem));
    }
    let beside = path.with_file_name(name);
    let folder = match path.parent() {
        Some(folder) if !folder.as_os_str().is_empty() => folder,
        _ => Path::new("."),
    };
    let real = beside.canonicalize().map_err(DatasetError::io(&beside))?;
    let home = folder.canonicalize().map_err(DatasetError::io(folder))?;
    if !real.starts_with(home) {
        return Err(malformed(path, field, format!("{shown:?} leads out of the folder by a link")));
    }
    files::open(&real).map_err(DatasetError::io(&beside))
}
