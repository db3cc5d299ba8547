//! Reads the statistics and scores in the folder of a run.

use std::collections::BTreeMap;
use std::path::Path;

use serde::de::DeserializeOwned;
use serde_json::{Map, Value};

use super::StepRecord;
use super::{Mean, Summary};
use crate::evaluate::Split;
use crate::metrics::geometry::Geometry;
use crate::trainer::EditEvent;
use densify_core::files;
use densify_core::files::FileError;

/// Size of the largest file that is read `[bytes]`.
const MAX_BYTES: u64 = 256 << 20;

/// The mean scores of the test views at an iteration, if the model was evaluated then.
///
/// # Errors
/// When the file exists but cannot be read. This also holds for the other functions of this module.
pub fn scores_of(run: &Path, iteration: u32) -> Result<Option<Mean>, FileError> {
    entry_of(&run.join("results.json"), iteration)
}

/// The geometric measurements in the test views at an iteration, if the model was measured then.
pub fn geometry_of(run: &Path, iteration: u32) -> Result<Option<Geometry>, FileError> {
    entry_of(&run.join(geometry_file(Split::Test)), iteration)
}

/// The mean scores on the test views by iteration.
pub fn all_scores(run: &Path) -> Result<BTreeMap<u32, Mean>, FileError> {
    let path = run.join("results.json");
    let score = |(name, entry): (String, Value)| {
        let iteration = name.strip_prefix("ours_").and_then(|number| number.parse().ok());
        let iteration = iteration
            .ok_or_else(|| FileError::malformed(&path, format!("{name:?} is not an iteration")))?;
        let mean = serde_json::from_value(entry).map_err(|e| FileError::malformed(&path, e))?;
        Ok((iteration, mean))
    };
    read_entries(&path)?.into_iter().map(score).collect()
}

/// The PSNR of each test view at an iteration `[dB]`, by view name; empty if the model was not evaluated then.
pub fn psnr_by_view(run: &Path, iteration: u32) -> Result<BTreeMap<String, f64>, FileError> {
    let path = run.join("per_view.json");
    let columns: Option<BTreeMap<String, BTreeMap<String, Option<f64>>>> =
        entry_of(&path, iteration)?;
    let psnr = columns.and_then(|mut columns| columns.remove("PSNR")).unwrap_or_default();
    // The infinite PSNR of equal images is null in JSON.
    Ok(psnr.into_iter().map(|(name, psnr)| (name, psnr.unwrap_or(f64::INFINITY))).collect())
}

/// The scores of each test view at an iteration, by view name; empty if the model was not evaluated then.
pub fn scores_by_view(run: &Path, iteration: u32) -> Result<BTreeMap<String, Mean>, FileError> {
    let path = run.join("per_view.json");
    let columns: Option<BTreeMap<String, Map<String, Value>>> = entry_of(&path, iteration)?;
    let mut views: BTreeMap<String, Map<String, Value>> = BTreeMap::new();
    for (score, column) in columns.unwrap_or_default() {
        for (view, value) in column {
            views.entry(view).or_default().insert(score.clone(), value);
        }
    }
    let scores = |(view, scores): (String, Map<String, Value>)| {
        let scores = serde_json::from_value(scores.into());
        let scores = scores.map_err(|e| FileError::malformed(&path, format!("{view}: {e}")))?;
        Ok((view, scores))
    };
    views.into_iter().map(scores).collect()
}

/// The records of `stats/train.jsonl`; empty without the file.
pub fn steps_of(run: &Path) -> Result<Vec<StepRecord>, FileError> {
    read_log(&run.join("stats/train.jsonl"))
}

/// The records of `stats/events.jsonl`; empty without the file.
pub fn events_of(run: &Path) -> Result<Vec<EditEvent>, FileError> {
    read_log(&run.join("stats/events.jsonl"))
}

/// Reads `stats/summary.json`; `None` without the file, as during training.
pub fn summary_of(run: &Path) -> Result<Option<Summary>, FileError> {
    read_json(&run.join("stats/summary.json"))
}

/// Reads a JSON file; `None` if it does not exist.
pub fn read_json<T: DeserializeOwned>(path: &Path) -> Result<Option<T>, FileError> {
    let parsed = text_of(path)?.map(|text| serde_json::from_str(&text));
    parsed.transpose().map_err(|e| FileError::malformed(path, e))
}

/// Reads the complete records of a log.
fn read_log<T: DeserializeOwned>(path: &Path) -> Result<Vec<T>, FileError> {
    let text = text_of(path)?.unwrap_or_default();
    // The last record may be incomplete while a process writes it.
    let complete = text.rfind('\n').map_or("", |end| &text[..end]);
    let record = |(at, line): (usize, &str)| {
        let record = serde_json::from_str(line);
        record.map_err(|e| FileError::malformed(path, format!("line {}: {e}", at + 1)))
    };
    complete.lines().enumerate().map(record).collect()
}

pub(super) fn geometry_file(split: Split) -> &'static str {
    match split {
        Split::Test => "geometry.json",
        Split::Train => "geometry_train.json",
    }
}

pub(super) fn entry_name(iteration: u32) -> String {
    format!("ours_{iteration}")
}

/// Reads the entry of an iteration, if there is one.
fn entry_of<T: DeserializeOwned>(path: &Path, iteration: u32) -> Result<Option<T>, FileError> {
    let entry = read_entries(path)?.remove(&entry_name(iteration));
    entry.map(serde_json::from_value).transpose().map_err(|e| FileError::malformed(path, e))
}

/// Reads the entries of a file; empty if it does not exist.
pub(super) fn read_entries(path: &Path) -> Result<Map<String, Value>, FileError> {
    Ok(read_json(path)?.unwrap_or_default())
}

/// Reads the text of a file; `None` if it does not exist.
fn text_of(path: &Path) -> Result<Option<String>, FileError> {
    match files::read_text(path, MAX_BYTES) {
        Ok(text) => Ok(Some(text)),
        Err(e) if e.kind() == std::io::ErrorKind::NotFound => Ok(None),
        Err(e) => Err(FileError::io("read", path)(e)),
    }
}
