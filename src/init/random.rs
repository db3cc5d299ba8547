//! Points for datasets that bring none.

use glam::{DMat3, DVec2, DVec3};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng, SeedableRng};

use crate::camera::Camera;
use crate::dataset::PointCloud;

/// Half side of the cube around the focus, in distances of the cameras from it. The original's
/// cube of ±1.3 for NeRF-synthetic scenes, whose cameras are 4.03 away.
const CUBE: f64 = 1.0 / 3.0;
/// Depths of the surroundings, in distances of the cameras from their focus.
const BEYOND: (f64, f64) = (2.0 / 3.0, 4.0);
/// Depths in scenes without a focus `[scene units]`; the rig's radius is 1.
const AROUND: (f64, f64) = (0.25, 5.0);
/// Colours are drawn from the middle half, where no channel is near its clamp.
const COLOURS: (u8, u8) = (64, 128);

/// Random points where the cameras look, in normalised coordinates, in random colours.
///
/// Where the cameras look at one thing, the points fill a cube around it; with a `background`
/// (images without alpha) only every other point does, and the rest are spread over what the
/// cameras see, uniformly in image and inverse depth. Where they look at no one thing (a room
/// from inside, a street), all points are spread so. The same arguments give the same points.
#[must_use]
pub fn random_points(count: usize, cameras: &[Camera], background: bool, seed: u64) -> PointCloud {
    let focus = focus(cameras);
    let mut draw = Draw(ChaCha8Rng::seed_from_u64(seed));
    let mut points = PointCloud::default();
    for index in 0..count {
        let position = match focus {
            Some((centre, distance)) if !background || index % 2 == 0 || cameras.is_empty() => {
                centre + (2.0 * draw.unit3() - 1.0) * (CUBE * distance)
            }
            Some((_, distance)) => {
                seen(&mut draw, cameras, (BEYOND.0 * distance, BEYOND.1 * distance))
            }
            None if cameras.is_empty() => 2.0 * draw.unit3() - 1.0,
            None => seen(&mut draw, cameras, AROUND),
        };
        points.positions.push(position);
        points
            .colours
            .push((draw.unit3() * f64::from(COLOURS.1)).to_array().map(|v| COLOURS.0 + v as u8));
    }
    points
}

/// The point that the optical axes pass closest to, in least squares, and the cameras' median
/// distance from it; none where the axes are parallel or meet nowhere in front of the cameras.
fn focus(cameras: &[Camera]) -> Option<(DVec3, f64)> {
    let (mut normal, mut right) = (DMat3::ZERO, DVec3::ZERO);
    for camera in cameras {
        let axis = camera.forward();
        let across =
            DMat3::IDENTITY - DMat3::from_cols(axis * axis.x, axis * axis.y, axis * axis.z);
        normal += across;
        right += across * camera.centre();
    }
    let count = cameras.len() as f64;
    // The smallest eigenvalue over `count` is the axes' mean square spread [rad²]: a milliradian
    // of spread is noise, not a crossing.
    if (normal * (1.0 / count)).determinant() < 1e-6 || cameras.is_empty() {
        return None;
    }
    let focus = normal.inverse() * right;
    let (mut distances, mut misses): (Vec<f64>, Vec<f64>) = cameras
        .iter()
        .map(|camera| {
            let offset = focus - camera.centre();
            let depth = offset.dot(camera.forward());
            // Behind the camera is missed by any measure.
            let miss = if depth > 0.0 {
                (offset - depth * camera.forward()).length()
            } else {
                f64::INFINITY
            };
            (offset.length(), miss)
        })
        .unzip();
    distances.sort_unstable_by(f64::total_cmp);
    misses.sort_unstable_by(f64::total_cmp);
    let distance = distances[distances.len() / 2];
    // Nine cameras of ten see the focus in the middle third of their image or so.
    let miss = misses[misses.len() * 9 / 10];
    (miss < 0.5 * distance).then_some((focus, distance))
}

/// A point in view of one of the cameras.
fn seen(draw: &mut Draw, cameras: &[Camera], (near, far): (f64, f64)) -> DVec3 {
    let camera = &cameras[((draw.unit() * cameras.len() as f64) as usize).min(cameras.len() - 1)];
    let pixel =
        DVec2::new(draw.unit() * f64::from(camera.width), draw.unit() * f64::from(camera.height));
    let depth = 1.0 / (1.0 / far + draw.unit() * (1.0 / near - 1.0 / far));
    let ray = DVec3::new((pixel.x - camera.cx) / camera.fx, (pixel.y - camera.cy) / camera.fy, 1.0);
    camera.rotation.transpose() * (depth * ray - camera.translation)
}

struct Draw(ChaCha8Rng);

impl Draw {
    /// Uniform in [0, 1), 53 bits.
    fn unit(&mut self) -> f64 {
        (self.0.next_u64() >> 11) as f64 * (1.0 / 9_007_199_254_740_992.0)
    }

    fn unit3(&mut self) -> DVec3 {
        DVec3::new(self.unit(), self.unit(), self.unit())
    }
}
