//! In place of the built-in scenes where a program is built without the feature `scenegen`: there is none,
//! and no scene's geometry is known.

use std::path::{Path, PathBuf};

use crate::dataset::{Dataset, DatasetError, LoadOptions};
use crate::foreign;
use crate::without::without;

/// A longer `scene.json` is not read `[bytes]`.
const LONGEST_RECORD: u64 = 1 << 24;

/// The geometry that a scene was rendered from, of which there is none.
#[derive(Debug)]
pub enum GroundTruth {}

impl GroundTruth {
    /// Whether a folder holds a scene whose geometry is known.
    #[must_use]
    pub fn is_in(_: &Path) -> bool {
        false
    }
}

impl Dataset {
    /// The geometry that the images were rendered from: `None`.
    ///
    /// # Errors
    /// None.
    pub fn ground_truth(&self) -> Result<Option<GroundTruth>, DatasetError> {
        Ok(None)
    }
}

/// What the surface in a folder takes: there is none.
pub(in crate::dataset) fn surface_bytes(_: &Path) -> Option<u64> {
    None
}

/// What is left out of a dataset that `densify scenegen` wrote, by its `scene.json`.
pub(in crate::dataset) fn left_out(root: &Path) -> Option<String> {
    let record = foreign::read_text(&root.join("scene.json"), LONGEST_RECORD).ok()?;
    let record: serde_json::Value = serde_json::from_str(&record).ok()?;
    let is_ours = record["generator"].as_str()?.starts_with("densify-scenegen");
    is_ours.then(|| without("scenegen", "the geometry of the scene is known, but not measured"))
}

pub(in crate::dataset) fn load(
    path: &Path,
    _: &str,
    _: &LoadOptions,
) -> Result<Dataset, DatasetError> {
    Err(DatasetError(without("scenegen", &path.display().to_string())))
}

/// The folder of rendered scenes.
pub(crate) fn folder() -> Option<PathBuf> {
    None
}
