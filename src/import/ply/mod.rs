//! Reads PLY files: Gaussians in the layout of the original 3DGS trainer, and point clouds.
//!
//! Accepts ascii, little and big endian, and properties in any order and of any numeric type;
//! unknown properties are skipped. Nothing is allocated from a declared count alone.

mod header;
mod points;
mod rows;
mod splats;

use std::path::{Path, PathBuf};

use crate::foreign::one_line;

pub use points::read_points;
pub(crate) use splats::splat_properties;
pub use splats::{SplatFile, read_splats};

/// Why a PLY file cannot be used.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum PlyError {
    /// The file cannot be opened or read.
    #[error("cannot read {path}: {source}; check that it exists and is readable")]
    Io {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// The file contradicts the format.
    #[error("{path}: {field}: {problem}; export the file again")]
    Malformed {
        /// The file.
        path: PathBuf,
        /// Line, element or property.
        field: String,
        /// What is wrong there.
        problem: String,
    },
    /// A property that the purpose needs is not there.
    #[error("{path}: the vertices have no property {property}; {remedy}")]
    Missing {
        /// The file.
        path: PathBuf,
        /// The property.
        property: String,
        /// What to do about it.
        remedy: &'static str,
    },
    /// A PLY in the compressed layout of PlayCanvas.
    #[error(
        "{path} is a compressed splat PLY (element chunk, packed properties), which densify does not read; \
         export it as an uncompressed .ply, e.g. with SuperSplat or splat-transform"
    )]
    Compressed {
        /// The file.
        path: PathBuf,
    },
    /// Too many rows are unusable.
    #[error(
        "{path}: {bad} of {total} rows are not finite, more than 1 %; the file is damaged: export it again"
    )]
    NotFinite {
        /// The file.
        path: PathBuf,
        /// Number of unusable rows.
        bad: usize,
        /// Number of rows.
        total: usize,
    },
}

impl PlyError {
    fn io(path: &Path) -> impl FnOnce(std::io::Error) -> Self + '_ {
        move |source| Self::Io { path: path.to_owned(), source }
    }

    fn malformed(path: &Path, field: impl Into<String>, problem: impl Into<String>) -> Self {
        let (field, problem) = (one_line(&field.into()), one_line(&problem.into()));
        Self::Malformed { path: path.to_owned(), field, problem }
    }
}

#[cfg(test)]
#[allow(clippy::float_cmp, reason = "results are exact")]
mod tests;
