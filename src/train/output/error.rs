//! Errors of the folder of a run.

use std::path::{Path, PathBuf};

use densify_core::files::FileError;

/// The remedy for a path that is neither a model nor a run.
const MODEL_OR_RUN: &str =
    "name a file of Gaussian splats, or the folder that `densify train` wrote";

/// Reason why the folder of a run cannot be read or written. Callers that know the options add the remedy.
#[derive(Debug, thiserror::Error)]
pub enum FolderError {
    /// The folder holds another run.
    #[error("{} holds another run", folder.display())]
    Occupied {
        /// The folder.
        folder: PathBuf,
    },
    /// A process is training in the folder.
    #[error(
        "{} is in use: {} is training there",
        folder.display(),
        process.map_or("another process".to_owned(), |number| format!("process {number}"))
    )]
    InUse {
        /// The folder.
        folder: PathBuf,
        /// The id of the process, if it is known.
        process: Option<u32>,
    },
    /// A file, or a dangling link, has the name of the folder.
    #[error("{} is not a folder", path.display())]
    NotAFolder {
        /// The path.
        path: PathBuf,
    },
    /// The folder does not contain a run.
    #[error(
        "{} holds no run: it has no {missing}; name the folder that `densify train` wrote",
        folder.display()
    )]
    NoRun {
        /// The folder.
        folder: PathBuf,
        /// The part of a run that is missing.
        missing: &'static str,
    },
    /// The path is a file that is not a model.
    #[error("{} is neither a model nor a run; {MODEL_OR_RUN}", path.display())]
    NotAModel {
        /// The file.
        path: PathBuf,
    },
    /// The path does not exist.
    #[error("{} does not exist; {MODEL_OR_RUN}", path.display())]
    NotFound {
        /// The path.
        path: PathBuf,
    },
    /// The folder was moved, removed or taken over while the run trained.
    #[error(
        "{} was moved, removed or taken by another process while the run trained; nothing more is written there",
        folder.display()
    )]
    Lost {
        /// The folder.
        folder: PathBuf,
    },
    /// A finished run cannot replace the existing one.
    #[error(
        "{source}; {}",
        match aside {
            None => format!(
                "the new run is complete in {}, and the run it was to replace is unchanged",
                staging.display()
            ),
            Some(aside) => format!(
                "moving the files back failed, too: those of the old run are in {}, and those of the new run in {}; \
                 leave them there: the next run in the folder completes or undoes the replacement",
                aside.display(),
                staging.display()
            ),
        }
    )]
    NotReplaced {
        /// The folder that holds the new run.
        staging: PathBuf,
        /// The folder with files of the old run, if they could not be moved back.
        aside: Option<PathBuf>,
        /// The error from the file that could not be moved.
        source: Box<FolderError>,
    },
    /// A file cannot be read or written.
    #[error(transparent)]
    File(#[from] FileError),
}

impl FolderError {
    /// An error about a path that was expected to be the folder of a run with `missing` in it.
    pub fn no_run(path: &Path, missing: &'static str) -> Self {
        let path = path.to_owned();
        if path.is_dir() {
            Self::NoRun { folder: path, missing }
        } else if path.exists() {
            Self::NotAModel { path }
        } else {
            Self::NotFound { path }
        }
    }

    pub(super) fn occupied(folder: &Path) -> Self {
        Self::Occupied { folder: folder.to_owned() }
    }
}
