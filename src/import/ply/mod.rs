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

use crate::dataset::DatasetError;

pub use points::read_points;
pub(crate) use splats::splat_properties;
pub use splats::{SplatFile, read_splats};

/// The file contradicts the format at a line, an element or a property.
fn malformed(path: &Path, field: impl Display, problem: impl Display) -> DatasetError {
    DatasetError::malformed(path, field, problem, "export the file again")
}

/// The vertices lack a property that the purpose needs.
fn missing(path: &Path, property: &str, remedy: &str) -> DatasetError {
    let path = path.display();
    DatasetError(format!("{path}: the vertices have no property {property}; {remedy}"))
}

#[cfg(test)]
#[allow(clippy::float_cmp, reason = "results are exact")]
mod tests;
