//! Reads PLY files: Gaussians in the layout of the original 3DGS trainer, and point clouds.
//!
//! Accepts ascii, little and big endian, and properties in any order and of any numeric type;
//! unknown properties are skipped. Nothing is allocated from a declared count alone.

mod header;
mod points;
mod rows;
mod splats;

use std::fmt::Display;
use std::path::Path;

use crate::foreign::one_line;

pub use points::read_points;
pub(crate) use splats::splat_properties;
pub use splats::{SplatFile, read_splats};

/// Why a PLY file cannot be used: names the file, the place and the remedy.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{0}")]
pub struct PlyError(String);

impl PlyError {
    fn io(path: &Path) -> impl FnOnce(std::io::Error) -> Self + '_ {
        move |source| {
            let path = path.display();
            Self(format!("cannot read {path}: {source}; check that it exists and is readable"))
        }
    }

    /// The file contradicts the format at a line, an element or a property.
    fn malformed(path: &Path, field: impl Display, problem: impl Display) -> Self {
        let [field, problem] = [field.to_string(), problem.to_string()].map(|text| one_line(&text));
        Self(format!("{}: {field}: {problem}; export the file again", path.display()))
    }

    /// The vertices lack a property that the purpose needs.
    fn missing(path: &Path, property: &str, remedy: &str) -> Self {
        Self(format!("{}: the vertices have no property {property}; {remedy}", path.display()))
    }
}

#[cfg(test)]
#[allow(clippy::float_cmp, reason = "results are exact")]
mod tests;
