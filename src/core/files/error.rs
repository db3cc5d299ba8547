//! Errors of reading and writing files.

use std::fmt::Display;
use std::path::{Path, PathBuf};

/// Errors of writing and reading files.
#[derive(Debug, thiserror::Error)]
pub enum FileError {
    /// A file that densify wrote is invalid.
    #[error(
        "{}: {problem}; this file was written by another version or changed by hand",
        file.display()
    )]
    Malformed {
        /// The file.
        file: PathBuf,
        /// The problem.
        problem: String,
    },
    /// Reading or writing failed.
    #[error("cannot {action} {path}: {source}{}", remedy(source))]
    Io {
        /// The attempted action, a verb with its object.
        action: &'static str,
        /// The file or folder.
        path: PathBuf,
        /// The operating system's error.
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
    /// An error about the contents of a file that densify wrote.
    pub fn malformed(file: &Path, problem: impl Display) -> Self {
        Self::Malformed { file: file.to_owned(), problem: problem.to_string() }
    }

    /// A function for `map_err` that turns an I/O error into an error about `path`.
    pub fn io(action: &'static str, path: &Path) -> impl FnOnce(std::io::Error) -> Self {
        let path = path.to_owned();
        move |source| Self::Io { action, path, source }
    }
}
