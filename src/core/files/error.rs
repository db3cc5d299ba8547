//! Errors of reading and writing files.

use std::fmt::Display;
use std::path::{Path, PathBuf};

/// Errors of writing and reading files.
#[derive(Debug, thiserror::Error)]
pub enum FileError {
    /// The folder holds another run.
    #[error("{} holds another run", folder.display())]
    Occupied {
        /// The folder.
        folder: PathBuf,
    },
    /// The folder, or a file in it, cannot be used: a process trains there, it holds no run, or the file is
    /// invalid. With the remedy.
    #[error("{0}")]
    Unfit(String),
    /// The folder was moved, removed or taken over while the run trained.
    #[error(
        "{path} was moved, removed or taken by another process while the run trained; nothing more is \
         written there"
    )]
    Lost {
        /// The folder.
        path: PathBuf,
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
                "moving back failed too: files of the run that was to be replaced are in {}, and of the \
                 new one in {}; leave them there, the next run in the folder ends or undoes the replacement",
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
        /// The error of the file that could not be moved.
        source: Box<FileError>,
    },
    /// Reading or writing failed.
    #[error("cannot {action} {path}: {source}{}", remedy(source))]
    Io {
        /// The attempted action, a verb with its object.
        action: &'static str,
        /// The file or folder.
        path: PathBuf,
        /// The error of the system.
        source: std::io::Error,
    },
}

/// The remedy for a full disk.
fn remedy(source: &std::io::Error) -> &'static str {
    use std::io::ErrorKind::{FileTooLarge, QuotaExceeded, StorageFull};
    match source.kind() {
        StorageFull | QuotaExceeded | FileTooLarge => "; make room there, or write to another disk",
        _ => "",
    }
}

impl FileError {
    /// An error about a folder that holds another run.
    #[must_use]
    pub fn occupied(folder: &Path) -> Self {
        Self::Occupied { folder: folder.to_owned() }
    }

    /// An error about a folder in which `missing` was expected.
    #[must_use]
    pub fn no_run(folder: &Path, missing: &str) -> Self {
        let name = folder.display();
        Self::Unfit(if folder.is_dir() {
            format!(
                "{name} holds no run: it has no {missing}; name the folder that `densify train` wrote"
            )
        } else if folder.exists() {
            format!(
                "{name} is neither a model nor a run; name a file of Gaussian splats, or the folder that `densify train` wrote"
            )
        } else {
            format!(
                "{name} does not exist; name a file of Gaussian splats, or the folder that `densify train` wrote"
            )
        })
    }

    /// An error about the contents of a file that densify had written.
    #[must_use]
    pub fn malformed(file: &Path, problem: impl Display) -> Self {
        let file = file.display();
        Self::Unfit(format!(
            "{file}: {problem}; this file was written by another version or changed by hand"
        ))
    }

    /// Turns an error of the system into an error about `path`, for `map_err`.
    pub fn io(action: &'static str, path: &Path) -> impl FnOnce(std::io::Error) -> Self {
        let path = path.to_owned();
        move |source| Self::Io { action, path, source }
    }
}
