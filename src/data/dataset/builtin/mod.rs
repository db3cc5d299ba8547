//! Built-in scenes as datasets: `scene:NAME` is rendered in memory or read from the cache. Its images are those that
//! `densify scenegen --preset NAME` writes by default.

mod rendered;

use std::path::Path;

use densify_scenegen::PresetSpec;

pub use rendered::GroundTruth;
pub use rendered::{cache_folder, set_program_file};
pub(super) use rendered::{load, surface_bytes};

/// Prefix of the paths of built-in scenes.
pub(crate) const PREFIX: &str = "scene:";

/// The name of the built-in scene that a path stands for; `None` for other paths.
pub fn name(path: &Path) -> Option<&str> {
    path.to_str()?.strip_prefix(PREFIX)
}

/// The built-in scene that the user may have meant by a path that does not exist.
pub fn meant(path: &Path) -> Option<&str> {
    let name = name(path).or_else(|| path.to_str())?;
    (!path.exists() && name.parse::<PresetSpec>().is_ok()).then_some(name)
}

/// The name of a built-in scene for use in a file name: `scene:town:4` becomes `town-4`.
pub fn label(path: &Path) -> Option<String> {
    name(path).map(|name| name.replace(':', "-"))
}
