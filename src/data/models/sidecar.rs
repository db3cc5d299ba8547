//! The sidecar of a model in local coordinates, for formats without a place for the offset: `NAME.spz.offset.json`
//! beside `NAME.spz`.
//!
//! `{"offset": [x, y, z], "bytes": n}`: a position in the dataset's coordinates is a coordinate of the file plus the
//! offset. `bytes` is the size of the file that the sidecar belongs to; it may be missing.

use std::io;
use std::path::{Path, PathBuf};

use serde::Deserialize;
use serde_json::json;

use super::SplatFile;
use crate::error::LoadError;
use densify_core::files::{self, FileError, write_atomically};

/// Suffix that is appended to the name of the model's file.
const SUFFIX: &str = ".offset.json";
/// Largest sidecar `[bytes]`.
const MAX_BYTES: u64 = 1 << 16;

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Sidecar {
    offset: [f64; 3],
    bytes: Option<u64>,
}

/// The sidecar of a model's file.
pub fn sidecar_path(model: &Path) -> PathBuf {
    let mut name = model.as_os_str().to_owned();
    name.push(SUFFIX);
    name.into()
}

/// Applies the sidecar of a model that was read, if there is one.
///
/// # Errors
/// When it is damaged, belongs to another file, or contradicts the offset in the model's file.
pub(super) fn apply(path: &Path, file: &mut SplatFile) -> Result<(), LoadError> {
    let sidecar = sidecar_path(path);
    let text = match files::read_text(&sidecar, MAX_BYTES) {
        Err(error) if is_absent(&error) => return Ok(()),
        text => text.map_err(LoadError::io(&sidecar))?,
    };
    let remedy = "correct it, or delete it if the model is in the dataset's own coordinates";
    let wrong =
        |field: &str, problem: String| LoadError::malformed(&sidecar, field, problem, remedy);
    let Sidecar { offset, bytes } =
        serde_json::from_str(&text).map_err(|error| wrong("JSON", error.to_string()))?;
    if offset.iter().any(|value| !value.is_finite()) {
        return Err(wrong("offset", "a number is not finite".to_owned()));
    }
    let length = path.metadata().map_err(LoadError::io(path))?.len();
    if let Some(bytes) = bytes.filter(|&bytes| bytes != length) {
        let problem = format!("it belongs to a file of {bytes} bytes, but the model has {length}");
        return Err(wrong("bytes", problem));
    }
    let stated = file.gaussians.origin;
    if file.gaussians.is_local() && !file.gaussians.has_origin(offset) {
        let problem = format!("{offset:?}, but the model's own file says {stated:?}");
        return Err(wrong("offset", problem));
    }
    file.gaussians.origin = offset;
    Ok(())
}

/// Writes the sidecar of the file at `written`, which will be renamed to `model`. The sidecar states the size of that
/// file, so that it is not taken for the sidecar of an older file at `model`.
///
/// # Errors
/// When it cannot be written.
pub fn write_sidecar(model: &Path, offset: [f64; 3], written: &Path) -> Result<(), FileError> {
    let bytes = written.metadata().map_err(FileError::io("read", written))?.len();
    let sidecar = json!({"offset": offset, "bytes": bytes});
    write_atomically(&sidecar_path(model), |out| writeln!(out, "{sidecar}"))
}

/// Removes the sidecar of a previous file with this name.
///
/// # Errors
/// When it cannot be removed.
pub fn remove_sidecar(model: &Path) -> Result<(), FileError> {
    let sidecar = sidecar_path(model);
    match std::fs::remove_file(&sidecar) {
        Err(error) if !is_absent(&error) => Err(FileError::io("remove", &sidecar)(error)),
        _ => Ok(()),
    }
}

/// True if a sidecar does not exist, or cannot because its name would be too long.
fn is_absent(error: &io::Error) -> bool {
    matches!(error.kind(), io::ErrorKind::NotFound | io::ErrorKind::InvalidFilename)
}
