//! Random initial points for datasets without points.

use glam::{DMat3, DVec2, DVec3};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng, SeedableRng};

use densify_core::camera::Camera;
use densify_data::dataset::PointCloud;

/// Half the side of the cube around the focus, as a fraction of the cameras' distance. In NeRF-synthetic scenes, whose
/// cameras are 4.03 away, half the side is then 1.3, as in the original code.
const HALF_CUBE: f64 = 1.0 / 3.0;
/// Depths of background points, as fractions of the cameras' distance from the focus.
const BACKGROUND_DEPTHS: (f64, f64) = (2.0 / 3.0, 4.0);
/// Depths in scenes without a focus `[scene units]`; the cameras are within a radius of 1.
const FREE_DEPTHS: (f64, f64) = (0.25, 5.0);
/// Smallest channel value of a random colour, and width of the range: the middle half of the values, away from
/// clamping.
const COLOURS: (u8, u8) = (64, 128);

/// Random points in view of the cameras, in normalised coordinates, with random colours.
///
/// If the cameras look at one object, the points fill a cube around it. With a `background` (images without alpha) only
/// half of the points lie in the cube; the others are spread over the views, uniformly in image position and inverse
/// depth. If the cameras have no common focus (a room from inside, a street), all points are spread over the views.
/// Equal arguments give equal points.
pub fn random_points(count: usize, cameras: &[Camera], background: bool, seed: u64) -> PointCloud {
    let focus = focus(cameras);
    let mut draw = UniformRng(ChaCha8Rng::seed_from_u64(seed));
    let mut points = PointCloud::default();
    for index in 0..count {
        let position = match focus {
            Some((centre, distance)) if !background || index % 2 == 0 || cameras.is_empty() => {
                centre + (2.0 * draw.unit3() - 1.0) * (HALF_CUBE * distance)
            }
            Some((_, distance)) => point_in_view(
                &mut draw,
                cameras,
                (BACKGROUND_DEPTHS.0 * distance, BACKGROUND_DEPTHS.1 * distance),
            ),
            None if cameras.is_empty() => 2.0 * draw.unit3() - 1.0,
            None => point_in_view(&mut draw, cameras, FREE_DEPTHS),
        };
        points.positions.push(position);
        points
            .colours
            .push((draw.unit3() * f64::from(COLOURS.1)).to_array().map(|v| COLOURS.0 + v as u8));
    }
    points
}

/// The point closest to all optical axes by least squares, and the median distance of the cameras from it; `None` if
/// the axes are parallel or do not meet in front of the cameras.
fn focus(cameras: &[Camera]) -> Option<(DVec3, f64)> {
    let (mut matrix, mut rhs) = (DMat3::ZERO, DVec3::ZERO);
    for camera in cameras {
        let axis = camera.forward();
        let across =
            DMat3::IDENTITY - DMat3::from_cols(axis * axis.x, axis * axis.y, axis * axis.z);
        matrix += across;
        rhs += across * camera.centre();
    }
    let count = cameras.len() as f64;
    // The smallest eigenvalue of the matrix divided by `count` is the mean square spread of the axes [rad²]; a spread
    // of a milliradian is noise.
    if (matrix * (1.0 / count)).determinant() < 1e-6 || cameras.is_empty() {
        return None;
    }
    let focus = matrix.inverse() * rhs;
    let (mut distances, mut misses): (Vec<f64>, Vec<f64>) = cameras
        .iter()
        .map(|camera| {
            let offset = focus - camera.centre();
            let depth = offset.dot(camera.forward());
            // A camera that looks away from the focus misses it.
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
    // The axes of nine in ten cameras must pass the focus within half the median distance, that is, about 30°.
    let miss = misses[misses.len() * 9 / 10];
    (miss < 0.5 * distance).then_some((focus, distance))
}

/// A random point in view of a random camera.
fn point_in_view(draw: &mut UniformRng, cameras: &[Camera], (near, far): (f64, f64)) -> DVec3 {
    let camera = &cameras[((draw.unit() * cameras.len() as f64) as usize).min(cameras.len() - 1)];
    let pixel =
        DVec2::new(draw.unit() * f64::from(camera.width), draw.unit() * f64::from(camera.height));
    let depth = 1.0 / (1.0 / far + draw.unit() * (1.0 / near - 1.0 / far));
    camera.unproject(pixel, depth)
}

/// A generator of uniform random numbers.
struct UniformRng(ChaCha8Rng);

impl UniformRng {
    /// A uniform number in [0, 1) with 53 bits.
    fn unit(&mut self) -> f64 {
        (self.0.next_u64() >> 11) as f64 * (1.0 / 9_007_199_254_740_992.0)
    }

    fn unit3(&mut self) -> DVec3 {
        DVec3::new(self.unit(), self.unit(), self.unit())
    }
}
