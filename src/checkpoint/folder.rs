//! Where a run keeps its checkpoints: the two newest, under the number of their step.

use std::ffi::OsStr;
use std::fs;
use std::path::{Path, PathBuf};

use super::{Checkpoint, CheckpointError};
use crate::output::CHECKPOINTS;

/// How many are kept: a newer one may turn out to be damaged.
const KEPT: usize = 2;

/// Where a run keeps the checkpoint of a step.
#[must_use]
pub fn checkpoint_path(run: &Path, step: u32) -> PathBuf {
    run.join(CHECKPOINTS).join(format!("iteration_{step}.safetensors"))
}

/// The checkpoints in a run's folder, newest first, whether they are sound or not.
fn listed(run: &Path) -> Vec<(u32, PathBuf)> {
    let step = |name: &OsStr| -> Option<u32> {
        name.to_str()?.strip_prefix("iteration_")?.strip_suffix(".safetensors")?.parse().ok()
    };
    let entries = fs::read_dir(run.join(CHECKPOINTS)).into_iter().flatten().flatten();
    let mut found: Vec<(u32, PathBuf)> =
        entries.filter_map(|entry| Some((step(&entry.file_name())?, entry.path()))).collect();
    found.sort_unstable();
    found.reverse();
    found
}

/// The newest checkpoint in a run's folder that is sound in every byte, if any is; and why newer
/// ones, newest first, are not.
#[must_use]
pub fn newest(run: &Path) -> (Option<Checkpoint>, Vec<CheckpointError>) {
    let mut rejected = Vec::new();
    for (_, path) in listed(run) {
        match Checkpoint::open(&path) {
            Ok(checkpoint) => return (Some(checkpoint), rejected),
            Err(error) => rejected.push(error),
        }
    }
    (None, rejected)
}

/// Removes all but the two newest checkpoints up to `step`, which has just been written. One beyond
/// `step` is not of this run's past (it may be a damaged one): it stays until it is written anew.
/// Whatever cannot be removed stays.
pub fn tidy(run: &Path, step: u32) {
    let past = listed(run).into_iter().filter(|&(of, _)| of <= step);
    for (_, path) in past.skip(KEPT) {
        let _ = fs::remove_file(path);
    }
}
