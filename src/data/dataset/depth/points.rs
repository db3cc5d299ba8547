//! Depth from a point cloud: the points are projected into each view with a z-buffer.

use std::io::Read;
use std::path::Path;

use glam::DVec3;

use super::super::LoadError;
use super::super::normalise::Normalisation;
use crate::las;
use crate::points::{PointCloud, read_points};
use densify_core::camera::Camera;
use densify_core::files;

/// A point is hidden if a neighbouring pixel shows one that is nearer by more than this share of its depth.
const HIDDEN: f32 = 0.02;
/// Distance up to which neighbouring pixels hide a point `[px]`.
const REACH: usize = 2;

/// A point cloud in the units of the scene.
#[derive(Debug, Clone, PartialEq)]
pub(in super::super) struct PointSet {
    positions: Vec<[f32; 3]>,
}

impl PointSet {
    /// The points of a cloud in world units.
    pub(in super::super) fn new(cloud: &PointCloud, normalisation: &Normalisation) -> Self {
        let scene = |&world: &DVec3| normalisation.scene_from_world(world).as_vec3();
        let positions = cloud.positions.iter().map(scene).filter(|point| point.is_finite());
        Self { positions: positions.map(|point| point.to_array()).collect() }
    }

    /// Number of points.
    pub(super) fn len(&self) -> usize {
        self.positions.len()
    }

    /// Size in memory `[bytes]`.
    pub(super) fn bytes(&self) -> u64 {
        std::mem::size_of_val(&*self.positions) as u64
    }

    /// The inverse depth of the nearest point in each pixel of a view; 0 where there is none, or only hidden ones
    /// `[1/scene units]`. Shape: `[height, width]`.
    pub(super) fn projected(&self, camera: &Camera) -> Vec<f32> {
        let (width, height) = (camera.width as usize, camera.height as usize);
        let mut nearest = vec![0.0_f32; width * height];
        for &[x, y, z] in &self.positions {
            let point = DVec3::new(f64::from(x), f64::from(y), f64::from(z));
            if let Some((pixel, depth)) = camera.place_in_image(point, 0.0) {
                let column = (pixel.x as usize).min(width - 1);
                let row = (pixel.y as usize).min(height - 1);
                let place = &mut nearest[row * width + column];
                *place = place.max((1.0 / depth) as f32);
            }
        }
        let is_hidden = |index: usize| {
            let (x, y) = (index % width, index / width);
            let rows = y.saturating_sub(REACH)..(y + REACH + 1).min(height);
            rows.flat_map(|row| {
                let columns = x.saturating_sub(REACH)..(x + REACH + 1).min(width);
                columns.map(move |column| row * width + column)
            })
            .any(|other| nearest[other] * (1.0 - HIDDEN) > nearest[index])
        };
        let shown = |index: usize| match nearest[index] {
            inverse if inverse > 0.0 && !is_hidden(index) => inverse,
            _ => 0.0,
        };
        (0..nearest.len()).map(shown).collect()
    }
}

/// Reads the points of a PLY, LAS or LAZ file, which is recognised by its first bytes.
pub(in super::super) fn read(path: &Path) -> Result<PointCloud, LoadError> {
    let mut start = Vec::new();
    let file = files::open(path).map_err(LoadError::io(path))?;
    file.take(las::MAGIC.len() as u64).read_to_end(&mut start).map_err(LoadError::io(path))?;
    let mut cloud = if start == las::MAGIC { las::read(path)? } else { read_points(path)?.0 };
    cloud.retain(DVec3::is_finite);
    if cloud.is_empty() {
        return Err(LoadError::malformed(
            path,
            "the points",
            "there are none",
            "export the cloud again",
        ));
    }
    Ok(cloud)
}

#[cfg(test)]
mod tests {
    use glam::DMat3;

    use super::*;

    fn camera() -> Camera {
        Camera::centred((9, 9), (9.0, 9.0), DMat3::IDENTITY, DVec3::ZERO)
    }

    #[test]
    fn the_nearest_point_of_a_pixel_counts_and_hides_those_behind_it() {
        let positions = vec![
            [0.0, 0.0, 4.0],
            [0.0, 0.0, 2.0],  // in front of the first
            [0.5, 0.0, 4.0],  // 1 px beside it, behind
            [1.4, 0.0, 4.0],  // 3 px beside it
            [0.0, 0.2, 2.01], // 1 px below it, on the same surface
            [0.0, 0.0, -1.0], // behind the camera
        ];
        let depth = PointSet { positions }.projected(&camera());
        let shown: Vec<(usize, f32)> =
            (0..81).map(|i| (i, depth[i])).filter(|(_, x)| *x > 0.0).collect();
        assert_eq!(shown, [(4 * 9 + 4, 0.5), (4 * 9 + 7, 0.25), (5 * 9 + 4, 1.0 / 2.01)]);
    }

    #[test]
    fn clouds_are_moved_to_the_scene() {
        let normalisation = Normalisation { centre: DVec3::new(1e6, 0.0, 0.0), scale: 0.5 };
        let cloud =
            PointCloud { positions: vec![DVec3::new(1e6 + 2.0, 4.0, 0.0)], colours: vec![[0; 3]] };
        let points = PointSet::new(&cloud, &normalisation);
        assert_eq!((points.positions.as_slice(), points.bytes()), (&[[1.0, 2.0, 0.0]][..], 12));
    }
}
