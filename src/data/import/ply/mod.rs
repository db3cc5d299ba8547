//! Reads PLY files: Gaussians in the layout of the original 3DGS trainer, and point clouds.
//!
//! Accepts ascii, little and big endian, and properties in any order and of any numeric type;
//! unknown properties are skipped. Nothing is allocated from a declared count alone.

mod header;
pub(crate) mod packed;
mod points;
mod rows;
mod splats;

use std::path::Path;

use super::model::malformed;
use crate::dataset::DatasetError;

pub(super) use packed::read_packed;
pub use points::read_points;
pub(super) use splats::is_packed;
pub use splats::read_splats;
pub(crate) use splats::splat_properties;

/// The vertices lack a property that the purpose needs.
fn missing(path: &Path, property: &str, remedy: &str) -> DatasetError {
    let path = path.display();
    DatasetError(format!("{path}: the vertices have no property {property}; {remedy}"))
}

#[cfg(test)]
#[allow(clippy::float_cmp, reason = "results are exact")]
mod tests;
