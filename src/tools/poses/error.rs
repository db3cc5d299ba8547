//! The errors of finding poses, each with its remedy.

use std::path::PathBuf;

use densify_core::files::FileError;
use densify_core::numbers::counted;
use densify_data::LoadError;
use densify_run::Interrupt;
use densify_run::failure::Failure;

/// Why no poses were found.
#[derive(Debug, thiserror::Error)]
pub enum PosesError {
    /// No Python with pycolmap was found.
    #[error(
        "{tried} has no pycolmap, which finds the cameras of photographs; install it with `pip install pycolmap`, and \
         name its Python with --python if it is another one"
    )]
    NoEngine {
        /// The Python that was tried.
        tried: String,
    },
    /// pycolmap is too old.
    #[error(
        "pycolmap {version} is too old; `{python} -m pip install --upgrade pycolmap` installs version 4 or newer"
    )]
    OldEngine {
        /// Its version.
        version: String,
        /// The Python that has it.
        python: String,
    },
    /// The engine, or ffmpeg, ended without a result.
    #[error("{what} {how}; its log is {}; {remedy}", log.display())]
    Failed {
        /// The program and its task.
        what: String,
        /// How it ended, with its last line.
        how: String,
        /// Its log.
        log: PathBuf,
        /// What helps.
        remedy: &'static str,
    },
    /// The engine's result contradicts itself.
    #[error("{}: {problem}; remove {} and run the same command again", file.display(), work.display())]
    Nonsense {
        /// The file.
        file: PathBuf,
        /// What is wrong with it.
        problem: String,
        /// The folder of intermediate results.
        work: PathBuf,
    },
    /// The folder has too few photographs.
    #[error(
        "{} has {}, but at least {needed} are needed{}",
        folder.display(), counted(*count, "photograph"), listed(notes)
    )]
    TooFew {
        /// The folder.
        folder: PathBuf,
        /// Number of its photographs.
        count: usize,
        /// Least number.
        needed: usize,
        /// What is there but not used.
        notes: Vec<String>,
    },
    /// The engine found no model.
    #[error(
        "no poses found: too few of the {count} photographs show the same things; take them so that each overlaps its \
         neighbours by two thirds, sharp, and from different places"
    )]
    NothingInCommon {
        /// Number of photographs.
        count: usize,
    },
    /// The engine found poses, but too many contradict the photographs.
    #[error(
        "no poses are accepted: {registered} of {count} photographs were placed, but {why}; leave out photographs in \
         which equal things appear at several places, or add photographs that show how these places connect"
    )]
    Contradicted {
        /// Number of photographs with a pose.
        registered: usize,
        /// Number of photographs.
        count: usize,
        /// What the checks say.
        why: String,
    },
    /// A video cannot be used.
    #[error("{}: {problem}", file.display())]
    Video {
        /// The video.
        file: PathBuf,
        /// The problem and its remedy.
        problem: String,
    },
    /// The output folder exists.
    #[error("-o: {} exists; choose another folder, or give --overwrite", folder.display())]
    Occupied {
        /// The folder.
        folder: PathBuf,
    },
    /// Another process works in the folder of intermediate results.
    #[error("another process finds poses in {}; wait for it, or choose another -o", work.display())]
    Busy {
        /// The folder.
        work: PathBuf,
    },
    /// A signal asked to stop.
    #[error("stopped by {}; the same command continues", .0.name)]
    Stopped(Interrupt),
    /// A photograph cannot be read.
    #[error(transparent)]
    Photograph(#[from] LoadError),
    /// A file cannot be read or written.
    #[error(transparent)]
    File(#[from] FileError),
}

fn listed(notes: &[String]) -> String {
    notes.iter().map(|note| format!("; {note}")).collect()
}

impl From<PosesError> for Failure {
    fn from(error: PosesError) -> Self {
        match error {
            PosesError::Photograph(error) => error.into(),
            PosesError::File(error) => error.into(),
            PosesError::Stopped(interrupt) => Self::new(interrupt.exit_code, error),
            error => Self::input(error),
        }
    }
}
