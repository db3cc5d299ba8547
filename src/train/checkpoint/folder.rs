//! Lists, finds and removes the checkpoints of a run. The two newest are kept.

use std::ffi::OsStr;
use std::fs;
use std::path::{Path, PathBuf};

use super::{Checkpoint, CheckpointError};
use crate::output::CHECKPOINTS;

/// Number of checkpoints kept; more than one, because the newest may turn out to be damaged.
const MAX_CHECKPOINTS: usize = 2;

/// Path of the checkpoint of a step.
pub fn checkpoint_path(run: &Path, step: u32) -> PathBuf {
    run.join(CHECKPOINTS).join(format!("iteration_{step}.safetensors"))
}

/// All checkpoints of a run, newest first, damaged ones included.
fn list(run: &Path) -> Vec<(u32, PathBuf)> {
    let step = |name: &OsStr| -> Option<u32> {
        name.to_str()?.strip_prefix("iteration_")?.strip_suffix(".safetensors")?.parse().ok()
    };
    let entries = fs::read_dir(run.join(CHECKPOINTS)).into_iter().flatten().flatten();
    let mut checkpoints: Vec<(u32, PathBuf)> =
        entries.filter_map(|entry| Some((step(&entry.file_name())?, entry.path()))).collect();
    checkpoints.sort_unstable();
    checkpoints.reverse();
    checkpoints
}

/// The step of the newest checkpoint of a run, which may be damaged.
pub fn newest_step(run: &Path) -> Option<u32> {
    list(run).first().map(|(step, _)| *step)
}

/// The newest undamaged checkpoint of a run, if there is one, and the errors of newer ones, newest first.
pub fn newest(run: &Path) -> (Option<Checkpoint>, Vec<CheckpointError>) {
    let mut rejected = Vec::new();
    for (_, path) in list(run) {
        match Checkpoint::open(&path) {
            Ok(checkpoint) => return (Some(checkpoint), rejected),
            Err(error) => rejected.push(error),
        }
    }
    (None, rejected)
}

/// Removes all but the two newest checkpoints up to `step`, whose checkpoint has just been written. Checkpoints of
/// later steps, which may be damaged, stay until they are overwritten. Errors are ignored.
pub fn remove_older(run: &Path, step: u32) {
    let past = list(run).into_iter().filter(|&(saved, _)| saved <= step);
    for (_, path) in past.skip(MAX_CHECKPOINTS) {
        let _ = fs::remove_file(path);
    }
}
