//! Checkpoints: everything that the future of a run depends on, in one file.
//!
//! A run that goes on from a checkpoint is the same to the bit as one that was never interrupted.
//!
//! ```text
//! RUN/checkpoints/iteration_N.safetensors     the two newest are kept
//! ```
//!
//! The file is [safetensors](https://github.com/huggingface/safetensors), which any language reads:
//! eight bytes of length, a JSON header, and arrays. Those of the model are `model.means`,
//! `model.log_scales`, `model.quats`, `model.opacity_logits`, `model.sh`
//! ([`Gaussians`](crate::gaussians::Gaussians), in the coordinates of training); the others are the
//! [backend's](crate::backend::Backend::state). The rest is JSON in the header's metadata: version
//! of the format, [`Header`], list of the arrays with a checksum each (CRC-32C), and a checksum of
//! that JSON. So every byte that counts is checked before it is used.
//!
//! A file appears under its name when it is complete and synced to disk. Files are not trusted:
//! nothing is allocated before the bytes for it are known to be there.

mod fingerprint;
mod folder;
mod format;
mod model;
mod read;
mod write;

pub use fingerprint::{Fingerprint, ViewsPrint};
pub use folder::{checkpoint_path, newest, tidy};
pub use format::VERSION;
pub use read::Checkpoint;
pub use write::write;

use std::path::{Path, PathBuf};

use densify_policies::policy::PolicyError;
use serde::{Deserialize, Serialize};

use crate::backend::{BackendError, StateError};
use crate::output::{OutputError, RunConfig};
use crate::trainer::TrainerState;

/// A checkpoint but for its arrays.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Header {
    /// Version of densify that wrote it.
    pub densify: String,
    /// The run as it was asked for.
    pub config: RunConfig,
    /// What the dataset was.
    pub dataset: Fingerprint,
    /// Where the run is.
    pub trainer: TrainerState,
    /// What the program around the trainer wants to find again; `null` if it wants nothing.
    pub session: serde_json::Value,
}

/// Why a checkpoint cannot be written or used.
#[derive(Debug, thiserror::Error)]
pub enum CheckpointError {
    /// The file cannot be read.
    #[error("cannot read {path}: {source}")]
    Read {
        /// The file.
        path: PathBuf,
        /// What the system says.
        source: std::io::Error,
    },
    /// The file is damaged, or none of ours.
    #[error("{path}: {problem}")]
    Invalid {
        /// The file.
        path: PathBuf,
        /// Which part of it, and what is wrong.
        problem: String,
    },
    /// The file cannot be written.
    #[error(transparent)]
    Write(#[from] OutputError),
    /// The policy does not give its state.
    #[error("the policy's state: {source}")]
    Policy {
        /// What it says.
        source: PolicyError,
    },
    /// The backend does not give its state.
    #[error(transparent)]
    Backend(#[from] BackendError),
}

impl CheckpointError {
    fn invalid(path: &Path, problem: impl ToString) -> Self {
        Self::Invalid { path: path.to_owned(), problem: problem.to_string() }
    }

    fn state(path: &Path) -> impl Fn(StateError) -> Self + use<> {
        let path = path.to_owned();
        move |error| Self::Invalid { path: path.clone(), problem: error.to_string() }
    }
}

#[cfg(test)]
mod tests;
