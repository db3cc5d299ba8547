//! The rows of a model in world coordinates, with their distances from the surface.

use std::num::NonZeroUsize;

use glam::{DMat3, DQuat, DVec3};
use kiddo::{ImmutableKdTree, SquaredEuclidean};
use rayon::prelude::*;

use super::KnownScene;
use crate::metrics::EvaluateError;
use densify_core::gaussians::{Gaussians, sigmoid};

/// Opacity above which a row counts as part of the surface.
const SOLID: f32 = 0.1;
/// Number of nearest centres among which the row at a surface point is chosen.
const NEIGHBOURS: usize = 8;

/// Rows as a structure of arrays, each of shape `[rows]`.
pub(super) struct Rows {
    /// Means `[world units]`.
    pub(super) centres: Vec<DVec3>,
    /// Standard deviations `[world units]`.
    pub(super) scales: Vec<DVec3>,
    /// Orientations, whose columns are the axes of the scales.
    pub(super) axes: Vec<DMat3>,
    /// Opacities.
    pub(super) opacities: Vec<f32>,
    /// Distance from centre to surface `[world units]`.
    pub(super) distances: Vec<f64>,
}

impl Rows {
    pub(super) fn new(model: &Gaussians, ground: &KnownScene<'_>) -> Self {
        let to_world = ground.normalisation;
        let surface = ground.truth.surface();
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

/// Finds solid rows near a point.
pub(super) struct Finder {
    tree: Option<ImmutableKdTree<f64, 3>>,
    /// Row of each entry of the tree.
    rows: Vec<usize>,
}

impl Finder {
    pub(super) fn new(rows: &Rows) -> Result<Self, EvaluateError> {
        let solid: Vec<usize> = (0..rows.len())
            .filter(|&row| rows.opacities[row] > SOLID && rows.centres[row].is_finite())
            .collect();
        let places: Vec<[f64; 3]> = solid.iter().map(|&row| rows.centres[row].to_array()).collect();
        let tree = if places.is_empty() {
            None
        } else {
            let tree = ImmutableKdTree::new_from_slice(&places);
            Some(tree.map_err(|_| EvaluateError::TooManyRows(places.len()))?)
        };
        Ok(Self { tree, rows: solid })
    }

    /// Distance to the nearest solid centre; infinite if there is none.
    pub(super) fn distance(&self, place: DVec3) -> f64 {
        let Some(tree) = &self.tree else { return f64::INFINITY };
        let query = place.to_array();
        let found =
            tree.query(&query).nearest_n::<SquaredEuclidean<f64>>(NonZeroUsize::MIN).execute();
        found.iter().map(|hit| hit.distance.sqrt()).fold(f64::INFINITY, f64::min)
    }

    /// The shortest axis of the densest solid row at a point, among those with the nearest centres.
    pub(super) fn normal(&self, rows: &Rows, place: DVec3) -> Option<DVec3> {
        let tree = self.tree.as_ref()?;
        let query = place.to_array();
        let count = NonZeroUsize::new(NEIGHBOURS.min(self.rows.len()))?;
        let found = tree.query(&query).nearest_n::<SquaredEuclidean<f64>>(count).execute();
        let exponent = |row: usize| {
            let local = rows.axes[row].transpose() * (place - rows.centres[row]) / rows.scales[row];
            f64::from(rows.opacities[row]).ln() - 0.5 * local.length_squared()
        };
        let near = found.iter().map(|hit| self.rows[hit.item as usize]);
        let row = near.max_by(|&a, &b| exponent(a).total_cmp(&exponent(b)).then(b.cmp(&a)))?;
        let scale = rows.scales[row];
        let shortest = (0..3).min_by(|&a, &b| scale[a].total_cmp(&scale[b]))?;
        Some(rows.axes[row].col(shortest))
    }
}
