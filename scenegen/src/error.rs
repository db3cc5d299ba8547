//! The errors of this crate: each names the file or option, the problem and the remedy.

use std::path::{Path, PathBuf};

/// Why a scene could not be made. Each message names the file, the element in it and the remedy.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// A file cannot be read.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// The system's error.
        source: std::io::Error,
    },
    /// A file or folder cannot be written.
    #[error("cannot write {}: {source}", path.display())]
    Write {
        /// The file or folder.
        path: PathBuf,
        /// The system's error.
        source: std::io::Error,
    },
    /// A file contradicts its format or itself.
    #[error("{}: {element}: {problem}; {remedy}", path.display())]
    Malformed {
        /// The file.
        path: PathBuf,
        /// Where in the file: mesh, accessor, line.
        element: String,
        /// The problem.
        problem: String,
        /// The remedy.
        remedy: &'static str,
    },
    /// A file needs an unsupported feature.
    #[error("{}: {feature} is not supported; {remedy}", path.display())]
    Unsupported {
        /// The file.
        path: PathBuf,
        /// The feature.
        feature: String,
        /// The remedy.
        remedy: String,
    },
    /// The mesh has nothing to render.
    #[error("{name}: there is no triangle to render; export the mesh with its faces")]
    Empty {
        /// The mesh's name.
        name: String,
    },
    /// A preset's name is unknown.
    #[error("there is no preset {name:?}; the presets are {known}")]
    UnknownPreset {
        /// As asked for.
        name: String,
        /// All known names.
        known: String,
    },
    /// An option's value cannot be used.
    #[error("{option}: {problem}")]
    Option {
        /// The option's name as on the command line.
        option: &'static str,
        /// What is wrong, with the remedy.
        problem: String,
    },
    /// No place for a camera was found.
    #[error(
        "view {view}: no place for the camera outside the geometry was found; choose another --rig or a larger --radius"
    )]
    NoPlace {
        /// Number of the view.
        view: usize,
    },
}

impl Error {
    pub(crate) fn malformed(
        path: &Path,
        element: impl Into<String>,
        problem: impl Into<String>,
        remedy: &'static str,
    ) -> Self {
        let (element, problem) = (element.into(), problem.into());
        Self::Malformed { path: path.to_owned(), element, problem, remedy }
    }

    pub(crate) fn io(path: &Path) -> impl FnOnce(std::io::Error) -> Self + '_ {
        move |source| Self::Io { path: path.to_owned(), source }
    }

    pub(crate) fn write(path: &Path) -> impl FnOnce(std::io::Error) -> Self + '_ {
        move |source| Self::Write { path: path.to_owned(), source }
    }

    pub(crate) fn option(option: &'static str, problem: impl Into<String>) -> Self {
        Self::Option { option, problem: problem.into() }
    }
}
