//! Similarities: rotation, translation and scale.

use glam::{DMat3, DQuat, DVec3};

use crate::camera::Camera;
use crate::linear::NormalEquations;

/// Gauss-Newton rounds of a fit; each about squares the error.
const ROUNDS: usize = 8;

/// A similarity of the world, x ↦ scale·rotation·x + translation.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Similarity {
    /// Orthonormal, determinant 1.
    pub rotation: DMat3,
    /// After the scale.
    pub translation: DVec3,
    /// > 0.
    pub scale: f64,
}

impl Similarity {
    /// The similarity that changes nothing.
    pub const IDENTITY: Self =
        Self { rotation: DMat3::IDENTITY, translation: DVec3::ZERO, scale: 1.0 };

    /// The similarity that takes the first of each pair to the second, by least squares; rotations of up to about 60°
    /// are found. The identity if the pairs determine none.
    pub fn between(pairs: &[[DVec3; 2]]) -> Self {
        let mut found = Self::IDENTITY;
        for _ in 0..ROUNDS {
            let mut equations = NormalEquations::<7>::default();
            for &[from, to] in pairs {
                let at = found.point(from);
                let off = to - at;
                // d(at) = translation + rotation × at + scale·at.
                let turned = [
                    DVec3::new(0.0, at.z, -at.y),
                    DVec3::new(-at.z, 0.0, at.x),
                    DVec3::new(at.y, -at.x, 0.0),
                ];
                for i in 0..3 {
                    let mut row = [0.0; 7];
                    row[i] = 1.0;
                    row[3..6].copy_from_slice(&turned[i].to_array());
                    row[6] = at[i];
                    equations.add(row, off[i], 1.0);
                }
            }
            let Some([x, y, z, a, b, c, s]) = equations.solution(0.0) else {
                return Self::IDENTITY;
            };
            let turn = DMat3::from_quat(DQuat::from_scaled_axis(DVec3::new(a, b, c)));
            let scale = s.clamp(-0.5, 0.5).exp();
            found = Self {
                rotation: turn * found.rotation,
                translation: scale * (turn * found.translation) + DVec3::new(x, y, z),
                scale: scale * found.scale,
            };
        }
        let is_finite = found.translation.is_finite() && found.scale.is_finite();
        if is_finite { found } else { Self::IDENTITY }
    }

    /// The similarity that takes one set of cameras to another, in pairs: the mean of their rotations, then the least
    /// squares of their centres.
    pub fn between_cameras(pairs: &[[Camera; 2]]) -> Self {
        let count = pairs.len().max(1) as f64;
        let mut rotation = DMat3::IDENTITY;
        for _ in 0..ROUNDS {
            let rests = pairs.iter().map(|[from, to]| {
                let turn = to.rotation.transpose() * from.rotation * rotation.transpose();
                DQuat::from_mat3(&turn).to_scaled_axis()
            });
            let rest = rests.sum::<DVec3>() / count;
            rotation = DMat3::from_quat(DQuat::from_scaled_axis(rest)) * rotation;
        }
        let [from, to] = [0, 1].map(|which| {
            pairs.iter().map(|pair: &[Camera; 2]| pair[which].centre()).sum::<DVec3>() / count
        });
        let (mut along, mut square) = (0.0, 0.0);
        for [given, moved] in pairs {
            let arm = rotation * (given.centre() - from);
            along += arm.dot(moved.centre() - to);
            square += arm.length_squared();
        }
        let scale = if along > 0.0 && square > 0.0 { along / square } else { 1.0 };
        Self { rotation, translation: to - scale * (rotation * from), scale }
    }

    /// A point after the similarity.
    pub fn point(&self, at: DVec3) -> DVec3 {
        self.scale * (self.rotation * at) + self.translation
    }

    /// A camera after the similarity; it shows the moved world as it has shown the world.
    pub fn camera(&self, camera: &Camera) -> Camera {
        let rotation = camera.rotation * self.rotation.transpose();
        let translation = -(rotation * self.point(camera.centre()));
        Camera { rotation, translation, ..*camera }
    }

    /// The inverse similarity.
    pub fn inverse(&self) -> Self {
        let (rotation, scale) = (self.rotation.transpose(), 1.0 / self.scale);
        Self { rotation, scale, translation: -scale * (rotation * self.translation) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn example() -> Similarity {
        let axis = DVec3::new(1.0, 2.0, -1.0).normalize();
        Similarity {
            rotation: DMat3::from_axis_angle(axis, 0.5),
            translation: DVec3::new(0.2, -0.3, 5.0),
            scale: 1.3,
        }
    }

    fn cameras() -> [Camera; 3] {
        let camera = |at: DVec3, turn: f64| {
            let rotation = DMat3::from_rotation_y(turn) * DMat3::from_rotation_x(0.2);
            Camera::centred((40, 30), (30.0, 30.0), rotation, at)
        };
        [
            camera(DVec3::new(1.0, 0.0, 0.0), 0.1),
            camera(DVec3::new(-1.0, 2.0, 0.5), 1.4),
            camera(DVec3::new(0.0, -1.0, 3.0), -2.0),
        ]
    }

    #[test]
    fn a_similarity_is_found_between_points_and_between_cameras() {
        let expected = example();
        let points: Vec<DVec3> = cameras().iter().map(Camera::centre).chain([DVec3::ONE]).collect();
        let pairs: Vec<_> = points.iter().map(|&point| [point, expected.point(point)]).collect();
        let pairs_of_cameras = cameras().map(|camera| [camera, expected.camera(&camera)]);
        for found in [Similarity::between(&pairs), Similarity::between_cameras(&pairs_of_cameras)] {
            assert!((found.scale - expected.scale).abs() < 1e-9, "{found:?}");
            assert!((found.translation - expected.translation).length() < 1e-9, "{found:?}");
            assert!((found.rotation.mul_vec3(DVec3::X) - expected.rotation.x_axis).length() < 1e-9);
        }
        let back = expected.inverse().point(expected.point(DVec3::ONE));
        assert!((back - DVec3::ONE).length() < 1e-12);
        assert_eq!(Similarity::between(&[[DVec3::ONE; 2]]), Similarity::IDENTITY);
    }

    #[test]
    fn a_moved_camera_shows_moved_points_where_it_showed_them() {
        let (moved, camera) = (example(), cameras()[1]);
        let point = camera.centre() + 3.0 * camera.forward() + DVec3::new(0.1, 0.2, 0.0);
        let [before, after] =
            [camera.project(point).0, moved.camera(&camera).project(moved.point(point)).0];
        assert!((before - after).length() < 1e-9, "{before} {after}");
    }
}
