//! The depths at which cameras see the points of a scene, weighted by area in the picture.
//!
//! Each picture is cut into cells, and each cell shows its nearest point: points behind it are hidden, and a wall
//! counts by its area in the picture, not by its number of points. No tracks are needed, so this works the same for
//! every format.

use glam::{DVec2, DVec3};
use rayon::prelude::*;

use densify_core::camera::Camera;

/// Cells along each side of a picture.
const CELLS: usize = 16;
/// Maximum number of cameras that are used, at equal intervals in their list: the depths then take 1 MiB.
const MAX_CAMERAS: usize = 1 << 10;
/// Maximum number of pairs of a camera and a point that are used; they take one thread a fifth of a second.
const MAX_PAIRS: usize = 1 << 24;

/// The depth of the nearest point in each cell of each picture, ascending.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct SeenDepths(Vec<f32>);

impl SeenDepths {
    /// Measures the depths at which cameras see points, in the same coordinates.
    pub fn measure(points: &[DVec3], cameras: &[Camera]) -> Self {
        let cameras: Vec<&Camera> =
            cameras.iter().step_by(stride(cameras.len(), MAX_CAMERAS)).collect();
        let stride = stride(points.len(), MAX_PAIRS / cameras.len().max(1));
        let mut depths: Vec<f32> = cameras
            .into_par_iter()
            .flat_map_iter(|camera| {
                let mut nearest = [f32::INFINITY; CELLS * CELLS];
                for &point in points.iter().step_by(stride) {
                    if let Some((pixel, depth)) = camera.place_in_image(point, 0.0) {
                        let cell = &mut nearest[cell(camera, pixel)];
                        *cell = cell.min(depth as f32);
                    }
                }
                nearest.into_iter().filter(|depth| depth.is_finite())
            })
            .collect();
        depths.par_sort_unstable_by(f32::total_cmp);
        Self(depths)
    }

    /// The depth below which this share of the measured depths lies; `None` if no camera sees a point.
    pub fn quantile(&self, share: f64) -> Option<f64> {
        let index = (share * self.0.len() as f64) as usize;
        self.0.get(index).map(|&depth| f64::from(depth))
    }

    /// The share of the measured depths that are below `depth`.
    pub fn share_below(&self, depth: f64) -> f64 {
        let count = self.0.partition_point(|&seen| f64::from(seen) < depth);
        count as f64 / self.0.len().max(1) as f64
    }
}

/// The stride at which at most `limit` of `count` values are used.
fn stride(count: usize, limit: usize) -> usize {
    count.div_ceil(limit.max(1)).max(1)
}

/// The cell of the picture that contains a pixel.
fn cell(camera: &Camera, pixel: DVec2) -> usize {
    let along =
        |pixel: f64, size: u32| ((pixel / f64::from(size) * CELLS as f64) as usize).min(CELLS - 1);
    along(pixel.y, camera.height) * CELLS + along(pixel.x, camera.width)
}

#[cfg(test)]
#[allow(clippy::float_cmp, reason = "results are exact")]
mod tests {
    use glam::DMat3;

    use super::*;

    /// A camera at the origin that looks along z, with a square picture 90° wide.
    fn camera() -> Camera {
        Camera::centred((64, 64), (32.0, 32.0), DMat3::IDENTITY, DVec3::ZERO)
    }

    /// A wall of `side`² points at depth `z`, as wide as the picture.
    fn wall(z: f64, side: usize) -> impl Iterator<Item = DVec3> {
        let at = move |i: usize| z * (2.0 * (i as f64 + 0.5) / side as f64 - 1.0);
        (0..side * side).map(move |i| DVec3::new(at(i % side), at(i / side), z))
    }

    #[test]
    fn depths_count_by_covered_area_not_by_number_of_points() {
        // A wall of few points hides a denser one.
        let points: Vec<DVec3> = wall(5.0, 200).chain(wall(2.0, CELLS)).collect();
        let seen = SeenDepths::measure(&points, &[camera()]);
        assert_eq!(seen.quantile(0.0), Some(2.0));
        assert_eq!(seen.quantile(0.99), Some(2.0));
        assert_eq!(seen.share_below(2.0) + seen.share_below(2.1), 1.0);
        // Points behind the camera and outside its picture are not seen.
        let outside = [DVec3::new(0.0, 0.0, -1.0), DVec3::new(1.1, 0.0, 1.0)];
        let points: Vec<DVec3> = wall(5.0, 200).chain(outside).collect();
        assert_eq!(SeenDepths::measure(&points, &[camera()]).quantile(0.0), Some(5.0));
        assert_eq!(SeenDepths::measure(&outside, &[camera()]).quantile(0.0), None);
        assert_eq!(SeenDepths::default().share_below(1.0), 0.0);
    }

    #[test]
    fn many_points_and_cameras_are_thinned_evenly() {
        let cameras = vec![camera(); 3 * MAX_CAMERAS];
        let points: Vec<DVec3> = wall(3.0, 256).collect();
        let seen = SeenDepths::measure(&points, &cameras);
        assert!(seen.0.len() <= MAX_CAMERAS * CELLS * CELLS);
        assert_eq!((seen.quantile(0.0), seen.quantile(0.999)), (Some(3.0), Some(3.0)));
    }
}
