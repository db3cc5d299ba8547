//! Writes the logs, the summary and the scores of a run.

use std::collections::BTreeMap;
use std::fs::{File, OpenOptions};
use std::io::{Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};

use super::reading::{entry_name, geometry_file, read_entries};
use crate::evaluate::{Mean, Split, ViewScore};
use crate::metrics::geometry::Geometry;
use densify_core::files::disk::{Operation, WatchedFile, attempt};
use densify_core::files::{FileError, write_atomically};
use densify_core::memory::Ledger;

/// A log of JSON records, one per line.
#[derive(Debug)]
pub struct RecordLog {
    file: File,
    path: PathBuf,
}

impl RecordLog {
    /// Starts an empty log, creating its folder.
    ///
    /// # Errors
    /// [`FileError::Io`].
    pub fn create(path: &Path) -> Result<Self, FileError> {
        if let Some(folder) = path.parent() {
            std::fs::create_dir_all(folder).map_err(FileError::io("create the folder", folder))?;
        }
        let mut options = OpenOptions::new();
        let file = attempt(Operation::Create, path)
            .and_then(|()| options.create(true).write(true).truncate(true).open(path));
        let file = file.map_err(FileError::io("create", path))?;
        Ok(Self { file, path: path.to_owned() })
    }

    /// Continues a log, truncated to the length that it had at the checkpoint. Also returns whether the file was at
    /// least that long; if it was shorter, the missing records stay lost.
    ///
    /// # Errors
    /// [`FileError::Io`].
    pub fn resume(path: &Path, bytes: u64) -> Result<(Self, bool), FileError> {
        let Ok(mut file) = OpenOptions::new().read(true).write(true).open(path) else {
            return Ok((Self::create(path)?, bytes == 0));
        };
        let mut cut = || {
            let length = file.metadata()?.len();
            if length < bytes {
                // Keep complete lines only.
                let mut text = Vec::new();
                file.read_to_end(&mut text)?;
                let end = text.iter().rposition(|&byte| byte == b'\n').map_or(0, |at| at + 1);
                file.set_len(end as u64)?;
            } else {
                file.set_len(bytes)?;
            }
            file.seek(SeekFrom::End(0))?;
            Ok(length >= bytes)
        };
        let whole = cut().map_err(FileError::io("truncate", path))?;
        Ok((Self { file, path: path.to_owned() }, whole))
    }

    /// Syncs the file to disk; returns its length `[bytes]`.
    ///
    /// # Errors
    /// [`FileError::Io`].
    pub fn synced(&self) -> Result<u64, FileError> {
        let length = attempt(Operation::Sync, &self.path)
            .and_then(|()| self.file.sync_all())
            .and_then(|()| self.file.metadata());
        Ok(length.map_err(FileError::io("write", &self.path))?.len())
    }

    /// Appends a record.
    ///
    /// # Errors
    /// [`FileError::Io`].
    pub fn append(&mut self, record: &impl Serialize) -> Result<(), FileError> {
        let line = serde_json::to_string(record).map_err(std::io::Error::other);
        // One write per line, so that lines are complete even for concurrent readers and if the process is killed.
        let Self { file, path } = self;
        line.and_then(|line| WatchedFile { file, path }.write_all((line + "\n").as_bytes()))
            .map_err(FileError::io("write", path))
    }
}

/// A record of `stats/train.jsonl`.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct StepRecord {
    /// Iteration, 1-based.
    pub step: u32,
    /// Mean loss 0.8·L1 + 0.2·(1 − SSIM) over the steps since the last record.
    pub loss: f32,
    /// Mean absolute difference between rendering and photograph over the same steps.
    pub l1: f32,
    /// Mean structural similarity over the same steps.
    pub ssim: f32,
    /// Mean [depth term](densify_render::DepthTerm), without its weight, over those of the same steps whose views have
    /// depth.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub depth: Option<f32>,
    /// Number of rows.
    pub rows: usize,
    /// Wall time since the first step `[s]`.
    pub seconds: f64,
    /// Resident memory of the process `[bytes]`, if known.
    pub resident_bytes: Option<u64>,
}

/// The contents of `stats/summary.json`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Summary {
    /// Version of densify.
    pub densify: String,
    /// The policy's name.
    pub policy: String,
    /// True if the run reached its last step.
    pub finished: bool,
    /// Steps done.
    pub iterations: u32,
    /// Rows at the end.
    pub rows: usize,
    /// Largest number of rows at any time.
    pub peak_rows: usize,
    /// Largest number of rows allowed.
    pub budget: usize,
    /// Number of training views rendered for the policy or the automatic budget, in addition to one per step.
    pub extra_forwards: u64,
    /// Largest resident memory of the process `[bytes]`, if known.
    pub peak_bytes: Option<u64>,
    /// The memory limit, if one was set `[bytes]`.
    pub memory: Option<u64>,
    /// The ledger's total `[bytes]`.
    pub ledger_bytes: u64,
    /// The bytes of every buffer.
    pub ledger: Ledger,
    /// Wall time of all steps `[s]`.
    pub seconds: f64,
    /// Total wall time `[s]` of each stage, of the policy's events, of rendering views for these events, and of waiting
    /// for images.
    pub stage_seconds: BTreeMap<String, f64>,
    /// CPU time of all steps, summed over the threads `[s]`, if known.
    pub cpu_seconds: Option<f64>,
    /// Number of views trained on.
    pub train_views: usize,
    /// Number of views held out.
    pub test_views: usize,
    /// Mean scores of the test views, by iteration.
    pub test: BTreeMap<u32, Mean>,
}

/// Writes a value as indented JSON.
///
/// # Errors
/// [`FileError::Io`].
pub fn write_json(path: &Path, value: &impl Serialize) -> Result<(), FileError> {
    write_atomically(path, |out| {
        serde_json::to_writer_pretty(&mut *out, value)?;
        out.write_all(b"\n")
    })
}

/// Adds scores to the files of a split: mean scores to `results.json` as
/// `{"ours_3000": {"PSNR": …, "SSIM": …, "FLIP": …}}`, scores by view to `per_view.json` as
/// `{"ours_3000": {"PSNR": {"00000.png": …}, "SSIM": …}}`. Entries of other iterations stay.
///
/// # Errors
/// When an existing file cannot be read, or a file cannot be written.
pub fn write_scores(
    run: &Path,
    split: Split,
    iteration: u32,
    scores: &[ViewScore],
) -> Result<(), FileError> {
    let (results, per_view) = match split {
        Split::Test => ("results.json", "per_view.json"),
        Split::Train => ("results_train.json", "per_view_train.json"),
    };
    type Score = fn(&ViewScore) -> Option<f64>;
    let columns: [(&str, Score); 8] = [
        ("PSNR", |v| Some(v.psnr)),
        ("SSIM", |v| Some(v.ssim)),
        ("FLIP", |v| Some(v.flip)),
        ("LPIPS", |v| v.lpips),
        ("PSNR_fitted", |v| Some(v.fitted?.psnr)),
        ("SSIM_fitted", |v| Some(v.fitted?.ssim)),
        ("FLIP_fitted", |v| Some(v.fitted?.flip)),
        ("LPIPS_fitted", |v| v.fitted?.lpips),
    ];
    let mut views = Map::new();
    for (name, score) in columns {
        let pair = |view: &ViewScore| Some((view.name.clone(), score(view)?.into()));
        let column: Map<String, Value> = scores.iter().filter_map(pair).collect();
        if !column.is_empty() {
            views.insert(name.to_owned(), column.into());
        }
    }
    insert_entry(&run.join(per_view), iteration, views.into())?;
    let mean = serde_json::to_value(Mean::over(scores)).unwrap_or_default();
    insert_entry(&run.join(results), iteration, mean)
}

/// Adds geometric measurements to `geometry.json` (`geometry_train.json` for training views) as
/// `{"ours_3000": {"depth": {…}, …}}`. Entries of other iterations stay.
///
/// # Errors
/// As [`write_scores`].
pub fn write_geometry(
    run: &Path,
    split: Split,
    iteration: u32,
    geometry: &Geometry,
) -> Result<(), FileError> {
    let entry = serde_json::to_value(geometry).unwrap_or_default();
    insert_entry(&run.join(geometry_file(split)), iteration, entry)
}

fn insert_entry(path: &Path, iteration: u32, entry: Value) -> Result<(), FileError> {
    let mut entries = read_entries(path)?;
    entries.insert(entry_name(iteration), entry);
    write_json(path, &entries)
}

#[cfg(test)]
mod tests {
    use super::super::scores_by_view;
    use super::*;
    use crate::evaluate::FittedScore;

    fn scores(psnr: f64) -> [ViewScore; 2] {
        let view = |name: &str, psnr| ViewScore {
            name: name.into(),
            psnr,
            ssim: 0.5,
            flip: 0.25,
            lpips: None,
            fitted: None,
        };
        [view("b.png", psnr), view("a/c.png", psnr + 2.0)]
    }

    #[test]
    fn scores_of_several_iterations_share_the_files() {
        let root = tempfile::tempdir().unwrap();
        for (iteration, psnr) in [(7, 10.0), (30, 20.0), (7, 30.0)] {
            write_scores(root.path(), Split::Test, iteration, &scores(psnr)).unwrap();
        }
        let read = |name: &str| -> Value {
            serde_json::from_slice(&std::fs::read(root.path().join(name)).unwrap()).unwrap()
        };
        let expected = serde_json::json!({
            "ours_7": { "PSNR": 31.0, "SSIM": 0.5, "FLIP": 0.25 },
            "ours_30": { "PSNR": 21.0, "SSIM": 0.5, "FLIP": 0.25 },
        });
        assert_eq!(read("results.json"), expected);
        assert_eq!(read("per_view.json")["ours_7"]["PSNR"]["a/c.png"], 32.0);
        let by_view = scores_by_view(root.path(), 30).unwrap();
        let one = |psnr| Mean { psnr, ssim: 0.5, flip: 0.25, lpips: None, fitted: None };
        let expected = [("a/c.png", 22.0), ("b.png", 20.0)];
        assert_eq!(by_view, expected.map(|(name, psnr)| (name.to_owned(), one(psnr))).into());
        assert!(scores_by_view(root.path(), 31).unwrap().is_empty());
        let fitted = FittedScore { psnr: 40.0, ssim: 0.75, flip: 0.125, lpips: None };
        let views = scores(10.0).map(|view| ViewScore { fitted: Some(fitted), ..view });
        write_scores(root.path(), Split::Test, 8, &views).unwrap();
        let names = ["PSNR", "SSIM", "FLIP", "PSNR_fitted", "SSIM_fitted", "FLIP_fitted"];
        let values = [11.0, 0.5, 0.25, 40.0, 0.75, 0.125];
        let expected: Value = names.iter().zip(values).map(|(n, v)| (*n, v)).collect();
        assert_eq!(read("results.json")["ours_8"], expected);
        assert_eq!(read("per_view.json")["ours_8"]["SSIM_fitted"]["b.png"], 0.75);
        std::fs::write(root.path().join("results.json"), "[").unwrap();
        write_scores(root.path(), Split::Train, 7, &scores(1.0)).unwrap();
        let message =
            write_scores(root.path(), Split::Test, 7, &scores(1.0)).unwrap_err().to_string();
        assert!(message.contains("results.json"), "{message}");
    }

    #[test]
    fn a_log_continues_at_the_checkpoint() {
        let root = tempfile::tempdir().unwrap();
        let path = root.path().join("stats/events.jsonl");
        let mut log = RecordLog::create(&path).unwrap();
        log.append(&1).unwrap();
        let bytes = log.synced().unwrap();
        log.append(&22).unwrap();
        let resume = |bytes| {
            let (mut log, whole) = RecordLog::resume(&path, bytes).unwrap();
            log.append(&3).unwrap();
            (std::fs::read_to_string(&path).unwrap(), whole)
        };
        assert_eq!(resume(bytes), ("1\n3\n".to_owned(), true));
        // The last line of a truncated log is incomplete.
        std::fs::write(&path, "1\n2").unwrap();
        assert_eq!(resume(9), ("1\n3\n".to_owned(), false));
        std::fs::remove_file(&path).unwrap();
        assert_eq!(resume(9), ("3\n".to_owned(), false));
    }

    #[test]
    fn a_perfect_score_is_read_back() {
        let perfect = Mean { psnr: f64::INFINITY, ssim: 1.0, flip: 0.0, lpips: None, fitted: None };
        let text = serde_json::to_string(&perfect).unwrap();
        assert_eq!(serde_json::from_str::<Mean>(&text).unwrap(), perfect);
        assert!(!text.contains("fitted"), "{text}");
        let score = FittedScore { psnr: f64::INFINITY, ssim: 1.0, flip: 0.0, lpips: Some(0.5) };
        let both = Mean { fitted: Some(score), ..perfect };
        let text = serde_json::to_string(&both).unwrap();
        assert_eq!(serde_json::from_str::<Mean>(&text).unwrap(), both);
    }
}
