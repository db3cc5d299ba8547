//! Saves the complete state of a run in one file, and restores it.
//!
//! A run that continues from a checkpoint ends with the same model, bit for bit, as an uninterrupted run.
//!
//! ```text
//! RUN/checkpoints/iteration_N.safetensors     the two newest are kept
//! ```
//!
//! The file is [safetensors](https://github.com/huggingface/safetensors), which many languages read: the length of the
//! header in eight bytes, a JSON header, and arrays. The arrays of the model are `model.means`, `model.log_scales`,
//! `model.quats`, `model.opacity_logits`, `model.sh` ([`Gaussians`](densify_core::gaussians::Gaussians), in the
//! coordinates of training); the others are the [backend's](densify_render::Backend::state). The rest is JSON in the
//! metadata of the header: the version of the format, [`Header`], a description of each array with its checksum
//! (CRC-32C), and a checksum of that JSON. Every byte is therefore checked before it is used.
//!
//! A file appears under its name only when it is complete and synced to disk. Files are untrusted: sizes
//! are checked against the length of the file before anything is allocated.

mod fingerprint;
mod folder;
mod format;
mod read;
mod write;

pub use fingerprint::{Fingerprint, ViewsFingerprint};
pub use folder::{checkpoint_path, newest, newest_step, remove_older};
pub use format::VERSION;
pub use read::Checkpoint;
pub use write::write;

use std::path::{Path, PathBuf};

use densify_policies::policy::PolicyError;
use serde::{Deserialize, Serialize};

use crate::output::FolderError;
use crate::trainer::TrainerState;
use densify_core::files::FileError;
use densify_render::BackendError;

/// A checkpoint without its arrays.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Header {
    /// Version of densify that wrote the checkpoint.
    pub densify: String,
    /// Largest number of rows that the run allows.
    pub budget: usize,
    /// Spherical-harmonic degree of the model.
    pub sh_degree: u8,
    /// Configuration of the run, as in `config.toml`.
    pub config: toml::Table,
    /// Fingerprint of the dataset.
    pub dataset: Fingerprint,
    /// State of the trainer.
    pub trainer: TrainerState,
    /// State of the code that drives the trainer; may be `null`.
    pub session: serde_json::Value,
}

/// Reason why a checkpoint cannot be written or used.
#[derive(Debug, thiserror::Error)]
pub enum CheckpointError {
    /// The file is damaged, or not a checkpoint.
    #[error("{path}: {problem}")]
    Invalid {
        /// The file.
        path: PathBuf,
        /// What is wrong, and in which part of the file.
        problem: String,
    },
    /// The file cannot be read or written.
    #[error(transparent)]
    File(#[from] FileError),
    /// The folder of the run cannot be written.
    #[error(transparent)]
    Folder(#[from] FolderError),
    /// The policy cannot save its state.
    #[error("the policy's state: {source}")]
    Policy {
        /// The policy's error.
        source: PolicyError,
    },
    /// The backend cannot save or restore its state.
    #[error(transparent)]
    Backend(#[from] BackendError),
}

impl CheckpointError {
    fn invalid(path: &Path, problem: impl ToString) -> Self {
        Self::Invalid { path: path.to_owned(), problem: problem.to_string() }
    }
}

#[cfg(test)]
mod tests;
