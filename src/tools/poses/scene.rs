//! Writes the scene: photographs and model in COLMAP's layout, complete or not at all.

use std::fs;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use crate::error::PosesError;
use crate::model::{FILES, Model};
use densify_core::files::{FileError, folder_of, write_atomically};

/// The report beside the scene.
pub(crate) const REPORT: &str = "poses.json";

/// How a scene was found, as its report keeps it.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
pub(crate) struct Report {
    /// The folder or video.
    pub(crate) input: PathBuf,
    /// Names and sizes `[bytes]` of the photographs.
    pub(crate) photographs: Vec<(String, u64)>,
    /// Name and version of the engine.
    pub(crate) engine: String,
    /// The settings that led to the model.
    pub(crate) origin: String,
    /// Photographs with a pose in the scene.
    pub(crate) accepted: Vec<String>,
    /// Photographs whose pose was rejected, with the reason.
    pub(crate) rejected: Vec<(String, String)>,
    /// Photographs that the engine could not place.
    pub(crate) unplaced: Vec<String>,
}

impl Report {
    /// Reads the report of a scene; `None` if there is none.
    pub(crate) fn read(scene: &Path) -> Option<Self> {
        serde_json::from_slice(&fs::read(scene.join(REPORT)).ok()?).ok()
    }
}

/// Makes `to` another name of a file, or a copy where links are not possible.
pub(crate) fn link(from: &Path, to: &Path) -> Result<(), PosesError> {
    let folder = folder_of(to);
    fs::create_dir_all(folder).map_err(FileError::io("create the folder", folder))?;
    // A link to a symbolic link would break with its target's name.
    let real = fs::canonicalize(from).map_err(FileError::io("read", from))?;
    if to.exists() || fs::hard_link(&real, to).is_ok() {
        return Ok(());
    }
    fs::copy(&real, to).map_err(FileError::io("write", to))?;
    Ok(())
}

/// Writes a scene into the folder `staged` and renames it to `output`, in place of an older one.
///
/// # Errors
/// When a file cannot be written; `output` is unchanged then.
pub(crate) fn write(
    (model, report): (&Model, &Report),
    pictures: &[(PathBuf, PathBuf)],
    (staged, output): (&Path, &Path),
) -> Result<(), PosesError> {
    let _ = fs::remove_dir_all(staged);
    for (from, to) in pictures {
        link(from, &staged.join(to))?;
    }
    for name in FILES {
        write_atomically(&staged.join("sparse/0").join(name), |out| model.write(name, out))?;
    }
    let text = serde_json::to_vec_pretty(report).unwrap_or_default();
    write_atomically(&staged.join(REPORT), |out| out.write_all(&text))?;
    let former = staged.with_extension("former");
    let _ = fs::remove_dir_all(&former);
    if output.exists() {
        fs::rename(output, &former).map_err(FileError::io("replace", output))?;
    }
    fs::rename(staged, output).map_err(FileError::io("write", output))?;
    let _ = fs::remove_dir_all(&former);
    Ok(())
}
