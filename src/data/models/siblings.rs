//! Opens files that a model file names: only those in its own folder, even after following links.

use std::fs::File;
use std::path::Path;

use crate::error::LoadError;
use densify_core::files::{self, folder_of};

/// Opens the file called `name` in the folder of `path`; `field` is the place in `path` that names it.
///
/// # Errors
/// When the name is a path or leads out of the folder, or as [`files::open`].
pub(super) fn open(path: &Path, field: &str, name: &str) -> Result<File, LoadError> {
    let is_plain = !name.is_empty()
        && name.len() <= 255
        && !matches!(name, "." | "..")
        && !name.contains(|c: char| c.is_control() || matches!(c, '/' | '\\' | ':'));
    let shown: String = name.chars().take(200).collect();
    if !is_plain {
        let problem = format!("{shown:?} is not a plain name of a file in the same folder");
        return Err(LoadError::damaged(path, field, problem));
    }
    let sibling = path.with_file_name(name);
    let folder = folder_of(path);
    let real = sibling.canonicalize().map_err(LoadError::io(&sibling))?;
    let home = folder.canonicalize().map_err(LoadError::io(folder))?;
    if !real.starts_with(home) {
        let problem = format!("{shown:?} leads out of the folder by a link");
        return Err(LoadError::damaged(path, field, problem));
    }
    files::open(&real).map_err(LoadError::io(&sibling))
}
