//! A scene's ground truth, for evaluating a trained scene: the surface, and depth and normals of each view.
//!
//! It comes from a scene in memory, or from a folder written by [`write`](crate::write). Files are untrusted:
//! sizes are checked against the file's length before anything is allocated.

mod exr;
mod ply;

use std::fs;
use std::path::{Path, PathBuf};

use glam::{DVec2, DVec3};
use rayon::prelude::*;
use serde_json::Value;

use crate::camera::Camera;
use crate::error::Error;
use crate::mesh::{Material, Model};
use crate::scene::Scene;
use crate::surface::Surface;
use crate::write::SCENE_FILE;

/// Longest `scene.json` that is read `[bytes]`.
const LONGEST_RECORD: u64 = 1 << 24;
/// Largest relative difference of depths that count as equal, as depth files hold f32.
const SAME_DEPTH: f64 = 1e-5;
/// The remedy for damaged files.
const REMEDY: &str = "write the scene again with densify scenegen --overwrite";
/// Offset below the surface at which measuring a thickness starts, as a share of the diagonal.
const STEP: f64 = 1e-7;

/// The geometry that a scene was rendered from.
pub struct GroundTruth {
    kind: Kind,
}

enum Kind {
    Scene(Box<Scene>),
    Folder { root: PathBuf, surface: Box<Surface>, thin: Vec<bool>, has_lens: bool },
}

/// Depth and normals of a view.
#[derive(Debug, Clone, PartialEq)]
pub struct GBuffer {
    /// Image width `[px]`.
    pub width: u32,
    /// Image height `[px]`.
    pub height: u32,
    /// As [`Frame::depth`](crate::Frame::depth) `[world units]`. Shape: `[height, width]`.
    pub depth: Vec<f32>,
    /// As [`Frame::normals`](crate::Frame::normals). Shape: `[height, width]`.
    pub normals: Vec<[f32; 3]>,
}

impl GroundTruth {
    /// The ground truth of a scene in memory.
    pub fn of_scene(scene: Scene) -> Self {
        Self { kind: Kind::Scene(Box::new(scene)) }
    }

    /// True if a folder holds a scene written by this program, according to its `scene.json`.
    pub fn is_in(root: &Path) -> bool {
        record_in(root)["generator"].as_str().is_some_and(|by| by.starts_with("densify-scenegen"))
    }

    /// The ground truth in a folder; `None` if the folder does not hold a scene of this program.
    ///
    /// # Errors
    /// When the folder holds such a scene, but its mesh cannot be read.
    pub fn open(root: &Path) -> Result<Option<Self>, Error> {
        let mesh = root.join("mesh.ply");
        if !Self::is_in(root) {
            return Ok(None);
        }
        let (corners, thin) = ply::read(&mesh)?;
        let mut model = Model { name: mesh.display().to_string(), ..Model::default() };
        let material = model.material(Material::lambert("", [1.0; 3]));
        model.triangles = (0..thin.len() as u32).map(|t| [0, 1, 2].map(|c| 3 * t + c)).collect();
        model.triangle_materials = vec![material; thin.len()];
        model.positions = corners;
        let surface = Box::new(Surface::new(&model)?);
        let has_lens = !record_in(root)["options"]["lens"].is_null();
        Ok(Some(Self { kind: Kind::Folder { root: root.to_owned(), surface, thin, has_lens } }))
    }

    /// The surface, in world coordinates.
    pub fn surface(&self) -> &Surface {
        match &self.kind {
            Kind::Scene(scene) => &scene.surface,
            Kind::Folder { surface, .. } => surface,
        }
    }

    /// Depth and normals seen by `camera`. In a folder, `view` (the view's name in a dataset) selects the files
    /// to read. If they are missing or have a different size, the mesh is traced instead, which also includes
    /// surfaces with an alpha below one half.
    ///
    /// # Errors
    /// When a file is damaged.
    pub fn g_buffer(&self, view: &str, camera: &Camera) -> Result<GBuffer, Error> {
        match &self.kind {
            Kind::Scene(scene) => Ok(trace(camera, |ray| {
                let (depth, normal, _) = scene.tracer().first_solid(camera.centre, ray, None)?;
                Some((depth, normal))
            })),
            Kind::Folder { root, surface, has_lens, .. } => {
                // Images stored for a camera with a lens do not fit this camera, which has none.
                let is_distorted = *has_lens && view.contains("train/");
                let size = (camera.width, camera.height);
                if let Some(stored) =
                    (!is_distorted).then(|| stored(root, view, size)).transpose()?.flatten()
                {
                    return Ok(stored);
                }
                Ok(trace(camera, |ray| {
                    let hit = surface.cast(camera.centre, ray, f64::INFINITY)?;
                    Some((hit.t, if hit.front { hit.normal } else { -hit.normal }))
                }))
            }
        }
    }

    /// True if there are thin structures, such as wires.
    pub fn has_thin(&self) -> bool {
        match &self.kind {
            Kind::Scene(scene) => scene.model.materials.iter().any(|material| material.thin),
            Kind::Folder { thin, .. } => thin.contains(&true),
        }
    }

    /// Thickness `[world units]` of the thin structure that the ray from `origin` along `direction` hits first,
    /// at ray parameter `depth`: the smallest of its extents along the normal and along two perpendicular
    /// directions; the diameter for a wire. `None` if the first hit is not thin or at a different depth.
    pub fn thickness(&self, origin: DVec3, direction: DVec3, depth: f64) -> Option<f64> {
        let surface = self.surface();
        let hit = surface.cast(origin, direction, depth * (1.0 + SAME_DEPTH))?;
        let is_thin = match &self.kind {
            Kind::Scene(scene) => scene.model.is_thin(hit.triangle),
            Kind::Folder { thin, .. } => thin[hit.triangle as usize],
        };
        if !is_thin || hit.t < depth * (1.0 - SAME_DEPTH) {
            return None;
        }
        let inward = if hit.front { -hit.normal } else { hit.normal };
        let step = STEP * surface.diagonal();
        let other = surface.cast(hit.point + step * inward, inward, f64::INFINITY)?;
        let through = other.t + step;
        let middle = hit.point + 0.5 * through * inward;
        let across = |axis: DVec3| {
            let reach =
                |axis| surface.cast(middle, axis, f64::INFINITY).map_or(f64::INFINITY, |h| h.t);
            reach(axis) + reach(-axis)
        };
        let (u, v) = inward.any_orthonormal_pair();
        Some(through.min(across(u)).min(across(v)))
    }
}

impl std::fmt::Debug for GroundTruth {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("GroundTruth").field("surface", self.surface()).finish_non_exhaustive()
    }
}

/// The `scene.json` in a folder; null if it is missing, too long or malformed.
fn record_in(root: &Path) -> Value {
    let record = root.join(SCENE_FILE);
    let is_short = fs::metadata(&record).is_ok_and(|data| data.len() <= LONGEST_RECORD);
    let text = if is_short { fs::read(&record).unwrap_or_default() } else { Vec::new() };
    serde_json::from_slice(&text).unwrap_or_default()
}

/// Traces the rays through the pixel centres.
fn trace(camera: &Camera, first: impl Fn(DVec3) -> Option<(f64, DVec3)> + Sync) -> GBuffer {
    let (width, height) = (camera.width as usize, camera.height as usize);
    let seen: Vec<(f32, [f32; 3])> = (0..width * height)
        .into_par_iter()
        .map(|i| {
            let pixel = DVec2::new((i % width) as f64, (i / width) as f64) + 0.5;
            let seen = first(camera.direction(pixel));
            seen.map_or((0.0, [0.0; 3]), |(t, n)| (t as f32, n.as_vec3().to_array()))
        })
        .collect();
    let (depth, normals) = seen.into_iter().unzip();
    GBuffer { width: camera.width, height: camera.height, depth, normals }
}

/// The stored depth and normals of a view, if there are files with its name and size.
fn stored(root: &Path, view: &str, size: (u32, u32)) -> Result<Option<GBuffer>, Error> {
    // Datasets name views by the path of their image, with or without the `images` folder.
    let name = view.trim_start_matches("./");
    let name = Path::new(name.strip_prefix("images/").unwrap_or(name)).with_extension("exr");
    if !name.components().all(|part| matches!(part, std::path::Component::Normal(_))) {
        return Ok(None);
    }
    let (depth_file, normal_file) =
        (root.join("depth").join(&name), root.join("normals").join(&name));
    if !(depth_file.is_file() && normal_file.is_file()) {
        return Ok(None);
    }
    let Some([depth]) = exr::read(&depth_file, ["Z"], size)? else {
        return Ok(None);
    };
    let Some([x, y, z]) = exr::read(&normal_file, ["X", "Y", "Z"], size)? else {
        return Ok(None);
    };
    let normals = x.into_iter().zip(y).zip(z).map(|((x, y), z)| [x, y, z]).collect();
    Ok(Some(GBuffer { width: size.0, height: size.1, depth, normals }))
}

#[cfg(test)]
mod tests;
