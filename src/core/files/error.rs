//! Why a file could not be written or read.

use std::fmt::Display;
use std::path::{Path, PathBuf};

/// Errors of writing and reading files.
#[derive(Debug, thiserror::Error)]
pub enum OutputError {
    /// The folder, or a file in it, will not do: another run is in it or trains there, there is none, or
    /// the file is invalid. What will do.
    #[error("{0}")]
    Unfit(String),
    /// The folder is no longer that of the run.
    #[error(
        "{path} was moved, removed or taken by another process while the run trained; nothing more is \
         written there"
    )]
    Lost {
        /// The folder.
        path: PathBuf,
    },
    /// A run cannot replace the existing one.
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
        /// Folder of the new run.
        staging: PathBuf,
        /// Where the files of the old run are, if they could not be moved back.
        aside: Option<PathBuf>,
        /// Which file could not be moved.
        source: Box<OutputError>,
    },
    /// Reading or writing failed.
    #[error("cannot {action} {path}: {source}{}", remedy(source))]
    Io {
        /// The attempted action.
        action: &'static str,
        /// The file or folder.
        path: PathBuf,
        /// The error of the system.
        source: std::io::Error,
    },
}

/// What to do where a disk is full.
fn remedy(source: &std::io::Error) -> &'static str {
    use std::io::ErrorKind::{FileTooLarge, QuotaExceeded, StorageFull};
    match source.kind() {
        StorageFull | QuotaExceeded | FileTooLarge => "; make room there, or write to another disk",
        _ => "",
    }
}

impl OutputError {
    pub fn occupied(folder: &Path) -> Self {
        let folder = folder.display();
        Self::Unfit(format!(
            "{folder} holds another run; choose another folder with -o, or replace it with --overwrite"
        ))
    }

    /// A run's folder lacks this.
    pub fn no_run(folder: &Path, missing: &str) -> Self {
        let name = folder.display();
        Self::Unfit(if folder.is_dir() {
            format!(
                "{name} holds no run: there is no {missing}; name the folder that `densify train` wrote"
            )
        } else if folder.exists() {
            format!(
                "{name} is no model and no run; name a file of Gaussian splats, or the folder that `densify train` wrote"
            )
        } else {
            format!(
                "{name} does not exist; name a file of Gaussian splats, or the folder that `densify train` wrote"
            )
        })
    }

    pub fn malformed(file: &Path, problem: impl Display) -> Self {
        let file = file.display();
        Self::Unfit(format!(
            "{file}: {problem}; this file was written by another version or changed by hand"
        ))
    }

    pub fn io(action: &'static str, path: &Path) -> impl FnOnce(std::io::Error) -> Self {
        let path = path.to_owned();
        move |source| Self::Io { action, path, source }
    }
}
