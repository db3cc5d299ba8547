//! Colours of vertices: the mean over the views that see them, weighted like distances.

use glam::Vec3;
use rayon::prelude::*;

use super::blocks::Grid;
use super::frame::Frames;
use super::fusion::View;
use super::mesh::Mesh;
use super::{MeshError, TRUNCATION};

/// Weight of a view that does not show a vertex, relative to one that does: such views decide only if there is no
/// other.
const HIDDEN: f32 = 1e-6;
/// The colour of a vertex that is in no image.
const GREY: u8 = 128;

/// Gives each vertex of a mesh `[voxels]` its colour.
pub(super) fn paint(
    frames: &mut Frames<'_>,
    grid: &Grid,
    mesh: &mut Mesh,
) -> Result<(), MeshError> {
    let truncation = TRUNCATION * grid.voxel as f32;
    // Sums of red, green, blue and weight.
    let mut sums = vec![[0.0_f32; 4]; mesh.positions.len()];
    frames.for_each(|frame| {
        let view = View::new(frame, grid);
        sums.par_iter_mut().zip(&mesh.positions).for_each(|(sum, &position)| {
            let Some(([u, v], distance, seen)) = view.look_at(Vec3::from(position)) else {
                return;
            };
            let is_shown = distance.abs() < truncation;
            let weight = if is_shown { seen.weight() } else { HIDDEN * seen.weight() };
            for (sum, value) in sum.iter_mut().zip(frame.colour_at(u, v)) {
                *sum += weight * value;
            }
            sum[3] += weight;
        });
        Ok::<_, MeshError>(())
    })?;
    let colour = |[r, g, b, weight]: [f32; 4]| match weight > 0.0 {
        true => [r, g, b].map(|sum| (sum / weight).round() as u8),
        false => [GREY; 3],
    };
    mesh.colours = sums.into_iter().map(colour).collect();
    Ok(())
}
