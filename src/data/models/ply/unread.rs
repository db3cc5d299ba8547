//! Properties of a splat PLY that are not read: those that change what is shown are refused, the others noted.

use std::path::Path;

use crate::error::LoadError;
use crate::ply::Element;
use densify_core::files::one_line;

/// Properties that change nothing: the normals of the original trainer, and plain colours beside the coefficients.
const HARMLESS: [&str; 6] = ["nx", "ny", "nz", "red", "green", "blue"];
/// Maximum number of names in a note, and of characters of a name.
const MAX_NAMES: usize = 5;
const MAX_NAME: usize = 40;

/// Beginnings of the names of properties of Spacetime Gaussians, which move.
const MOVING: [&str; 3] = ["trbf_", "motion_", "omega_"];
/// The same of 4D Gaussians, which also have a time `t`.
const MOVING_WITH_TIME: [&str; 2] = ["scale_t", "rot_r_"];
/// Beginning of the names of view-dependent colours of Spherical Beta models.
const BETA: &str = "sb_params_";

/// A note about the properties of an element besides `read`, the names of those that are read.
///
/// # Errors
/// When one of them makes the Gaussians move or gives them other view-dependent colours.
pub(in crate::models) fn note(
    path: &Path,
    element: &Element,
    read: &[String],
) -> Result<Option<String>, LoadError> {
    let has_time = element.find(&["t"]).is_some();
    let mut unread = Vec::new();
    for property in &element.properties {
        let name = &property.name;
        if read.contains(name) || HARMLESS.contains(&name.as_str()) {
            continue;
        }
        let refuse = |problem, remedy| {
            Err(LoadError::malformed(path, format!("property {}", shown(name)), problem, remedy))
        };
        if name.starts_with(BETA) {
            let problem = "it describes colours by Spherical Betas, which densify does not read";
            return refuse(problem, "export the model with spherical harmonics");
        }
        let moves = |starts: &[&str]| starts.iter().any(|start| name.starts_with(start));
        if moves(&MOVING) || has_time && moves(&MOVING_WITH_TIME) {
            let problem = "it makes the Gaussians move, which densify does not read";
            return refuse(problem, "export a single moment of the scene as an ordinary splat PLY");
        }
        unread.push(name);
    }
    if unread.is_empty() {
        return Ok(None);
    }
    let mut names: Vec<String> = unread.iter().take(MAX_NAMES).map(|name| shown(name)).collect();
    if unread.len() > MAX_NAMES {
        names.push(format!("and {} more", unread.len() - MAX_NAMES));
    }
    Ok(Some(format!("properties that are not read: {}", names.join(", "))))
}

/// A name as messages show it.
fn shown(name: &str) -> String {
    one_line(&name.chars().take(MAX_NAME).collect::<String>())
}
