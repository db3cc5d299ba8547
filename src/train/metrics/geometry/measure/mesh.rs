//! Measures a triangle mesh against the surface, by distances of samples in both directions.

use densify_scenegen::Surface;
use densify_scenegen::mesh::Model;
use glam::DVec3;
use rayon::prelude::*;
use serde::Serialize;

use super::visibility::{MIN_VIEWS, sample};
use super::{KnownScene, ratio};
use densify_core::camera::Camera;

/// Distances between a mesh and the surface. Lengths are fractions of the diagonal of the surface's bounding box.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct MeshErrors {
    /// Mean distance from the mesh to the surface, over 20,000 uniform samples of the mesh.
    pub accuracy: f64,
    /// Mean distance from the surface to the mesh, over 20,000 uniform samples of the surface, except those that fewer
    /// than two training views see.
    pub completeness: f64,
    /// Accuracy + completeness.
    pub chamfer: f64,
    /// Fraction of the mesh's samples within 0.5 % of the diagonal from the surface.
    pub precision_half_percent: f64,
    /// Fraction of the surface's samples within 0.5 % of the diagonal from the mesh.
    pub recall_half_percent: f64,
    /// Harmonic mean of precision and recall.
    pub f_score_half_percent: f64,
    /// As the precision above, with 1 % of the diagonal.
    pub precision_one_percent: f64,
    /// As the recall above, with 1 % of the diagonal.
    pub recall_one_percent: f64,
    /// Harmonic mean of these two.
    pub f_score_one_percent: f64,
}

/// Measures a mesh in the coordinates of the dataset. `cameras` are those of the training views, in scene coordinates.
///
/// # Errors
/// When the mesh has no triangles.
pub fn measure_mesh<'a>(
    mesh: &Model,
    scene: &KnownScene<'_>,
    cameras: impl IntoIterator<Item = &'a Camera>,
) -> Result<MeshErrors, densify_scenegen::Error> {
    let diagonal = scene.diagonal();
    let measured = Surface::new(mesh)?;
    let truth = scene.truth.surface();
    let distances = |from: &[DVec3], to: &Surface| -> Vec<f64> {
        from.par_iter().map(|&point| to.nearest(point).distance / diagonal).collect()
    };
    let to_truth = distances(&sample(&measured.triangles()), truth);
    let to_mesh = distances(&seen_samples(scene, cameras), &measured);
    let mean = |distances: &[f64]| ratio(distances.iter().sum(), distances.len() as f64);
    let within = |distances: &[f64], limit: f64| {
        let near = distances.iter().filter(|&&distance| distance <= limit).count();
        ratio(near as f64, distances.len() as f64)
    };
    let scores = |limit: f64| {
        let (precision, recall) = (within(&to_truth, limit), within(&to_mesh, limit));
        let sum = precision + recall;
        [precision, recall, if sum > 0.0 { 2.0 * precision * recall / sum } else { sum }]
    };
    let (accuracy, completeness) = (mean(&to_truth), mean(&to_mesh));
    let [precision_half_percent, recall_half_percent, f_score_half_percent] = scores(0.005);
    let [precision_one_percent, recall_one_percent, f_score_one_percent] = scores(0.01);
    Ok(MeshErrors {
        accuracy,
        completeness,
        chamfer: accuracy + completeness,
        precision_half_percent,
        recall_half_percent,
        f_score_half_percent,
        precision_one_percent,
        recall_one_percent,
        f_score_one_percent,
    })
}

/// The samples of the surface that enough views see.
fn seen_samples<'a>(
    scene: &KnownScene<'_>,
    cameras: impl IntoIterator<Item = &'a Camera>,
) -> Vec<DVec3> {
    let surface = scene.truth.surface();
    let cameras: Vec<_> = cameras.into_iter().map(|camera| scene.cameras(camera).1).collect();
    let is_seen = |at: &DVec3| {
        let seeing = cameras.iter().filter(|camera| {
            let (pixel, depth) = camera.project(*at);
            depth > 0.0 && camera.contains(pixel) && !surface.blocked(camera.centre, *at)
        });
        seeing.take(MIN_VIEWS as usize).count() == MIN_VIEWS as usize
    };
    sample(&surface.triangles()).into_par_iter().filter(is_seen).collect()
}
