//! Built-in scenes as datasets: `scene:spheres` is rendered in memory, or taken from the cache. The images
//! are those that `densify scenegen --preset NAME` writes by default.

mod rendered;

use std::path::Path;

pub use rendered::GroundTruth;
pub use rendered::folder;
pub(super) use rendered::{load, surface_bytes};

/// Prefix of the path of a built-in scene.
pub const PREFIX: &str = "scene:";

/// The name of a built-in scene, if the path is one.
#[must_use]
pub fn name(path: &Path) -> Option<&str> {
    path.to_str()?.strip_prefix(PREFIX)
}

/// The same as a part of a file's name: `scene:town:4` is `town-4`.
#[must_use]
pub fn label(path: &Path) -> Option<String> {
    name(path).map(|name| name.replace(':', "-"))
}
