//! Writes `scene.json`, which contains everything needed to render the scene again.

use std::path::Path;

use serde_json::{Value, json};

use super::write_file;
use crate::error::Error;
use crate::points::InitPoints;
use crate::scene::Scene;

/// Name of the file, which identifies a folder as a scene.
pub(crate) const NAME: &str = "scene.json";

pub(super) fn write(scene: &Scene, root: &Path, points: &InitPoints) -> Result<(), Error> {
    let model = &scene.model;
    let record = json!({
        "generator": concat!("densify-scenegen ", env!("CARGO_PKG_VERSION")),
        "source": scene.name,
        "options": scene.options,
        "rig": scene.rig,
        "ambient": scene.ambient,
        "sky": scene.sky,
        "exposure": scene.exposure,
        "view_exposures": exposures(scene),
        "samples_per_pixel": scene.options.grid * scene.options.grid,
        "mesh": {
            "triangles": model.triangles.len(),
            "vertices": model.positions.len(),
            "materials": model.materials.len(),
            "textures": model.textures.len(),
            "lights": model.lights.len(),
            "bytes": scene.surface.bytes(),
        },
        "points": { "count": points.positions.len(), "outliers": points.outliers },
        "thin_materials": model
            .materials
            .iter()
            .enumerate()
            .filter_map(|(number, material)| material.thin.then_some(number))
            .collect::<Vec<_>>(),
        "notes": model.notes,
        "files": {
            "images": "sRGB with straight alpha",
            "depth": "camera z of the first surface with alpha >= 0.5 through the pixel's centre; 0 where there is none; in .npy times 1000",
            "normals": "its geometric normal in world space, towards the camera; 0 where there is none",
            "mesh.ply": "the triangles as traced; thin is 1 for those of thin structures",
            "points3d.ply": "initial points",
        },
    });
    write_file(&root.join(NAME), format!("{record:#}").as_bytes())
}

/// The exposures of views by name, if they vary; otherwise null.
fn exposures(scene: &Scene) -> Value {
    let named = scene.views.iter().enumerate();
    let named = named.filter_map(|(at, view)| Some((view.name.clone(), json!(scene.gains(at)?))));
    let named: serde_json::Map<String, Value> = named.collect();
    if named.is_empty() { Value::Null } else { named.into() }
}
