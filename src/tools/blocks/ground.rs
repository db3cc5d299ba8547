//! The ground that a scene stands on, found from its cameras: they stay at about the same height, on foot or in flight.

use glam::{DMat3, DVec2, DVec3};
use serde::{Deserialize, Serialize};

use densify_core::camera::Camera;

/// Cameras whose second spread is below this share of the first stand on a line, which has no plane.
const LINE: f64 = 0.02;
/// Sweeps of Jacobi's method; three suffice for a matrix this small.
const SWEEPS: usize = 12;

/// A plane, with two axes.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Ground {
    /// Its origin `[world units]`.
    pub origin: DVec3,
    /// Its first axis, along which the cameras are spread most; unit length.
    pub u: DVec3,
    /// Its second axis, orthogonal to the first; unit length.
    pub v: DVec3,
}

impl Ground {
    /// The plane through the cameras' mean that is nearest to all; where they stand on a line, it is as level as their
    /// images.
    #[must_use]
    pub fn of(cameras: &[Camera]) -> Self {
        let count = cameras.len().max(1) as f64;
        let origin = cameras.iter().map(Camera::centre).sum::<DVec3>() / count;
        let outer = |d: DVec3| DMat3::from_cols(d * d.x, d * d.y, d * d.z);
        let spread = cameras
            .iter()
            .fold(DMat3::ZERO, |sum, camera| sum + outer(camera.centre() - origin) * (1.0 / count));
        let [(first, u), (second, v), _] = axes(spread);
        if second > (LINE * LINE) * first {
            return Self { origin, u, v };
        }
        // Down in their images, but for what is along the line.
        let down = cameras.iter().map(|camera| camera.rotation.row(1)).sum::<DVec3>();
        let down = down - u * down.dot(u);
        let v = u.cross(down).try_normalize().unwrap_or_else(|| u.any_orthonormal_vector());
        Self { origin, u, v }
    }

    /// Where a point lies, seen from above.
    #[must_use]
    pub fn at(&self, point: DVec3) -> [f64; 2] {
        let d = point - self.origin;
        DVec2::new(d.dot(self.u), d.dot(self.v)).to_array()
    }
}

/// Eigenvalues and unit eigenvectors of a symmetric matrix, the largest first: Jacobi's method.
fn axes(mut matrix: DMat3) -> [(f64, DVec3); 3] {
    let mut vectors = DMat3::IDENTITY;
    for _ in 0..SWEEPS {
        for (p, q) in [(0, 1), (0, 2), (1, 2)] {
            let off = matrix.col(q)[p];
            if off == 0.0 {
                continue;
            }
            let theta = (matrix.col(q)[q] - matrix.col(p)[p]) / (2.0 * off);
            let t = theta.signum() / (theta.abs() + theta.hypot(1.0));
            let t = if theta == 0.0 { 1.0 } else { t };
            let cos = 1.0 / t.hypot(1.0);
            let sin = t * cos;
            let mut turn = DMat3::IDENTITY;
            turn.col_mut(p)[p] = cos;
            turn.col_mut(q)[q] = cos;
            turn.col_mut(q)[p] = sin;
            turn.col_mut(p)[q] = -sin;
            matrix = turn.transpose() * matrix * turn;
            vectors *= turn;
        }
    }
    let mut all = [0, 1, 2].map(|i| (matrix.col(i)[i], vectors.col(i).normalize()));
    all.sort_by(|a, b| b.0.total_cmp(&a.0));
    all
}

#[cfg(test)]
mod tests {
    use super::*;

    fn camera(centre: DVec3, rotation: DMat3) -> Camera {
        Camera::centred((64, 48), (50.0, 50.0), rotation, centre)
    }

    #[test]
    fn axes_are_those_of_the_matrix() {
        let turn = DMat3::from_rotation_z(0.4) * DMat3::from_rotation_x(1.1);
        let matrix = turn * DMat3::from_diagonal(DVec3::new(2.0, 7.0, 0.5)) * turn.transpose();
        let found = axes(matrix);
        for ((value, axis), expected) in found.into_iter().zip([7.0, 2.0, 0.5]) {
            assert!((value - expected).abs() < 1e-12, "{value}");
            assert!((matrix * axis - axis * value).length() < 1e-12, "{axis}");
        }
    }

    #[test]
    fn cameras_of_a_flight_find_the_ground_whichever_way_they_look() {
        let turn = DMat3::from_rotation_x(0.7);
        let cameras: Vec<Camera> = (0..30)
            .map(|i| {
                let (x, y) = (f64::from(i % 6), f64::from(i / 6));
                let height = 0.05 * f64::from(i % 2);
                let look = DMat3::from_rotation_z(f64::from(i));
                camera(turn * DVec3::new(x, y, height), look)
            })
            .collect();
        let ground = Ground::of(&cameras);
        let up = ground.u.cross(ground.v);
        assert!(up.dot(turn * DVec3::Z).abs() > 0.999, "{up}");
        assert!(ground.u.dot(turn * DVec3::X).abs() > 0.999, "the longer side comes first");
        let [a, b] = [DVec3::ZERO, turn * DVec3::new(3.0, 4.0, 9.0)].map(|p| ground.at(p));
        // Heights lean with x by less than half a degree.
        assert!(((a[0] - b[0]).hypot(a[1] - b[1]) - 5.0).abs() < 0.1, "{a:?} {b:?}");
    }

    #[test]
    fn on_a_line_the_ground_is_level() {
        // Looking forward along z, y down.
        let cameras: Vec<Camera> =
            (0..9).map(|i| camera(DVec3::new(0.0, 0.0, f64::from(i)), DMat3::IDENTITY)).collect();
        let ground = Ground::of(&cameras);
        assert!(ground.u.cross(ground.v).dot(DVec3::Y).abs() > 0.999, "{ground:?}");
    }
}
