//! The rows of a model in world coordinates, with their distances from the surface.

use glam::{DMat3, DQuat, DVec3};
use rayon::prelude::*;
use rstar::RTree;
use rstar::primitives::GeomWithData;

use super::KnownScene;
use densify_core::gaussians::{Gaussians, sigmoid};

/// Opacity above which a row counts as part of the surface.
const SOLID: f32 = 0.1;
/// Number of rows with the nearest centres, from which the row at a surface point is chosen.
const NEIGHBOURS: usize = 8;

/// Rows as a structure of arrays, each of shape `[rows]`.
pub(super) struct Rows {
    /// Means `[world units]`.
    pub(super) centres: Vec<DVec3>,
    /// Standard deviations `[world units]`.
    pub(super) scales: Vec<DVec3>,
    /// Rotation matrices; column i is the axis of scale i.
    pub(super) axes: Vec<DMat3>,
    /// Opacities.
    pub(super) opacities: Vec<f32>,
    /// Distance from centre to surface `[world units]`.
    pub(super) distances: Vec<f64>,
}

impl Rows {
    pub(super) fn new(model: &Gaussians, scene: &KnownScene<'_>) -> Self {
        let to_world = scene.normalisation;
        let surface = scene.truth.surface();
        let vector = |v: &[f32; 3]| DVec3::from(v.map(f64::from));
        let centres: Vec<DVec3> =
            model.means.iter().map(|mean| to_world.world_from_scene(vector(mean))).collect();
        let scales = model.log_scales.iter().map(|log| vector(log).exp() / to_world.scale);
        let axes = model.quats.iter().map(|&[w, x, y, z]| {
            let quat = DQuat::from_xyzw(x.into(), y.into(), z.into(), w.into());
            let unit = if quat.length_squared() > 0.0 { quat.normalize() } else { DQuat::IDENTITY };
            DMat3::from_quat(unit)
        });
        Self {
            scales: scales.collect(),
            axes: axes.collect(),
            opacities: model.opacity_logits.iter().map(|&logit| sigmoid(logit)).collect(),
            distances: centres.par_iter().map(|&centre| surface.nearest(centre).distance).collect(),
            centres,
        }
    }

    pub(super) fn len(&self) -> usize {
        self.centres.len()
    }
}

/// The solid rows, for finding those near a point.
pub(super) struct SolidRows {
    /// Centres, each with its row index.
    tree: RTree<GeomWithData<[f64; 3], usize>>,
}

impl SolidRows {
    pub(super) fn new(rows: &Rows) -> Self {
        let solid = (0..rows.len())
            .filter(|&row| rows.opacities[row] > SOLID && rows.centres[row].is_finite());
        let places = solid.map(|row| GeomWithData::new(rows.centres[row].to_array(), row));
        Self { tree: RTree::bulk_load(places.collect()) }
    }

    /// Distance to the nearest centre `[world units]`; infinite if there is none.
    pub(super) fn distance(&self, place: DVec3) -> f64 {
        let nearest = self.tree.nearest_neighbor(place.to_array());
        nearest.map_or(f64::INFINITY, |hit| DVec3::from(*hit.geom()).distance(place))
    }

    /// The shortest axis of the row that is densest at a point, among the [`NEIGHBOURS`] rows with the nearest centres.
    pub(super) fn normal(&self, rows: &Rows, place: DVec3) -> Option<DVec3> {
        let exponent = |row: usize| {
            let local = rows.axes[row].transpose() * (place - rows.centres[row]) / rows.scales[row];
            f64::from(rows.opacities[row]).ln() - 0.5 * local.length_squared()
        };
        let near = self.tree.nearest_neighbor_iter(place.to_array()).take(NEIGHBOURS);
        let row = near
            .map(|hit| hit.data)
            .max_by(|&a, &b| exponent(a).total_cmp(&exponent(b)).then(b.cmp(&a)))?;
        let scale = rows.scales[row];
        let shortest = (0..3).min_by(|&a, &b| scale[a].total_cmp(&scale[b]))?;
        Some(rows.axes[row].col(shortest))
    }
}
