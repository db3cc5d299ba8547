//! The ground plane of a scene, estimated from its cameras: whether carried or flown, they stay at about the same
//! height.

use glam::{DMat3, DVec3};
use serde::{Deserialize, Serialize};

use densify_core::camera::Camera;

/// If the cameras' second principal spread is below this fraction of the first, they are on a line, which determines no
/// plane.
const MAX_LINE_WIDTH: f64 = 0.02;
/// Number of sweeps of Jacobi's method. About three suffice for a 3 × 3 matrix; more cost nothing noticeable.
const SWEEPS: usize = 12;

/// A plane with two orthonormal axes.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Ground {
    /// Origin `[world units]`.
    pub origin: DVec3,
    /// First axis: the direction in which the cameras are spread most. Unit length.
    pub u: DVec3,
    /// Second axis, orthogonal to the first. Unit length.
    pub v: DVec3,
}

impl Ground {
    /// Fits the plane to the camera centres by least squares. If they are on a line, the plane contains this line and
    /// is as level as it can be, assuming upright images.
    pub fn fit(cameras: &[Camera]) -> Self {
        let count = cameras.len().max(1) as f64;
        let origin = cameras.iter().map(Camera::centre).sum::<DVec3>() / count;
        let outer = |d: DVec3| DMat3::from_cols(d * d.x, d * d.y, d * d.z);
        let spread = cameras
            .iter()
            .fold(DMat3::ZERO, |sum, camera| sum + outer(camera.centre() - origin) * (1.0 / count));
        let [(first, u), (second, v), _] = principal_axes(spread);
        if second > (MAX_LINE_WIDTH * MAX_LINE_WIDTH) * first {
            return Self { origin, u, v };
        }
        // The mean downward direction of the images, without its component along the line.
        let down = cameras.iter().map(|camera| camera.rotation.row(1)).sum::<DVec3>();
        let down = down - u * down.dot(u);
        let v = u.cross(down).try_normalize().unwrap_or_else(|| u.any_orthonormal_vector());
        Self { origin, u, v }
    }

    /// Projects a point onto the plane.
    pub fn project(&self, point: DVec3) -> [f64; 2] {
        let d = point - self.origin;
        [d.dot(self.u), d.dot(self.v)]
    }
}

/// Eigenvalues and unit eigenvectors of a symmetric matrix by Jacobi's method, the largest first.
fn principal_axes(mut matrix: DMat3) -> [(f64, DVec3); 3] {
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
    fn principal_axes_are_eigenvectors() {
        let turn = DMat3::from_rotation_z(0.4) * DMat3::from_rotation_x(1.1);
        let matrix = turn * DMat3::from_diagonal(DVec3::new(2.0, 7.0, 0.5)) * turn.transpose();
        let axes = principal_axes(matrix);
        for ((value, axis), expected) in axes.into_iter().zip([7.0, 2.0, 0.5]) {
            assert!((value - expected).abs() < 1e-12, "{value}");
            assert!((matrix * axis - axis * value).length() < 1e-12, "{axis}");
        }
    }

    #[test]
    fn flying_cameras_determine_the_ground_whichever_way_they_look() {
        let turn = DMat3::from_rotation_x(0.7);
        let cameras: Vec<Camera> = (0..30)
            .map(|i| {
                let (x, y) = (f64::from(i % 6), f64::from(i / 6));
                let height = 0.05 * f64::from(i % 2);
                let look = DMat3::from_rotation_z(f64::from(i));
                camera(turn * DVec3::new(x, y, height), look)
            })
            .collect();
        let ground = Ground::fit(&cameras);
        let up = ground.u.cross(ground.v);
        assert!(up.dot(turn * DVec3::Z).abs() > 0.999, "{up}");
        assert!(ground.u.dot(turn * DVec3::X).abs() > 0.999, "the longer side comes first");
        let [a, b] = [DVec3::ZERO, turn * DVec3::new(3.0, 4.0, 9.0)].map(|p| ground.project(p));
        // The alternating heights tilt the plane by less than half a degree.
        assert!(((a[0] - b[0]).hypot(a[1] - b[1]) - 5.0).abs() < 0.1, "{a:?} {b:?}");
    }

    #[test]
    fn cameras_on_a_line_give_a_level_ground() {
        // The cameras look along z, and y points down.
        let cameras: Vec<Camera> =
            (0..9).map(|i| camera(DVec3::new(0.0, 0.0, f64::from(i)), DMat3::IDENTITY)).collect();
        let ground = Ground::fit(&cameras);
        assert!(ground.u.cross(ground.v).dot(DVec3::Y).abs() > 0.999, "{ground:?}");
    }
}
