//! Parts of a model on the ground.

use glam::DVec3;

use super::{Blocks, Cell};
use densify_core::camera::Camera;
use densify_core::gaussians::Gaussians;

/// How far beyond an image a Gaussian may lie and still reach into it, as a share of its sides.
const BESIDE: f64 = 0.25;

/// The rows of a model, from `first` on, whose centres lie in a cell.
pub(super) fn inside(blocks: &Blocks, cell: &Cell, model: &Gaussians, first: usize) -> Vec<usize> {
    let rows = first..model.len();
    rows.filter(|&row| cell.has(blocks.on_ground(model.means[row]))).collect()
}

/// The rows whose centres lie elsewhere, and that a camera may see. Everything in world coordinates.
pub(super) fn beyond(
    blocks: &Blocks,
    cell: &Cell,
    model: &Gaussians,
    cameras: &[Camera],
) -> Vec<usize> {
    let is_beyond = |row: &usize| !cell.has(blocks.on_ground(model.means[*row]));
    let is_seen = |row: &usize| {
        let point = DVec3::from(model.means[*row].map(f64::from));
        cameras.iter().any(|camera| camera.depth_in_image(point, BESIDE).is_some())
    };
    (0..model.len()).filter(is_beyond).filter(is_seen).collect()
}
