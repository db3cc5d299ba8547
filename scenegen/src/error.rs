//! The errors of this crate: each names the file or option, the problem and the remedy.

use std::fmt::Display;
use std::path::{Path, PathBuf};

/// The reason why a scene could not be generated or written.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// An input file cannot be read, is malformed or needs an unsupported feature; or a preset, option or
    /// camera position is invalid. The message has the details.
    #[error("{0}")]
    Input(String),
    /// A file or folder cannot be written.
    #[error("cannot write {}: {source}", path.display())]
    Write {
        /// The file or folder.
        path: PathBuf,
        /// The system's error.
        source: std::io::Error,
    },
}

impl Error {
    /// A file violates its format or is inconsistent; `element` is the location in the file, such as a mesh,
    /// accessor or line.
    pub(crate) fn malformed(
        path: &Path,
        element: impl Display,
        problem: impl Display,
        remedy: &str,
    ) -> Self {
        Self::Input(format!("{}: {element}: {problem}; {remedy}", path.display()))
    }

    /// A file needs an unsupported feature.
    pub(crate) fn unsupported(path: &Path, feature: &str, remedy: &str) -> Self {
        Self::Input(format!("{}: {feature} is not supported; {remedy}", path.display()))
    }

    /// A mesh has nothing to render.
    pub(crate) fn empty(name: impl Display) -> Self {
        Self::Input(format!(
            "{name}: there is no triangle to render; export the mesh with its faces"
        ))
    }

    /// A file cannot be read.
    pub(crate) fn io(path: &Path) -> impl FnOnce(std::io::Error) -> Self + '_ {
        move |source| Self::Input(format!("{}: {source}", path.display()))
    }

    /// A file or folder cannot be written.
    pub(crate) fn write(path: &Path) -> impl FnOnce(std::io::Error) -> Self + '_ {
        move |source| Self::Write { path: path.to_owned(), source }
    }

    /// An option has an invalid value; `option` is its name on the command line.
    pub(crate) fn option(option: &str, problem: impl Display) -> Self {
        Self::Input(format!("{option}: {problem}"))
    }
}
