//! Small motions of cameras, and derivatives of a loss with respect to them.

use glam::{DMat3, DVec3};

use crate::camera::Camera;

/// A small motion of a camera: camera_from_world becomes exp(ξ)·camera_from_world, ξ = (translation, rotation), so that
/// a point p in camera coordinates moves by translation + rotation × p (to first order). Focal lengths are multiplied by
/// exp(log_focal).
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Twist {
    /// v `[scene units]`.
    pub translation: DVec3,
    /// ω `[radians]`.
    pub rotation: DVec3,
    /// Change of the logarithm of both focal lengths.
    pub log_focal: f64,
}

/// Number of values of a [`Twist`].
pub const TWIST_VALUES: usize = 7;

/// Derivatives of a loss with respect to a [`Twist`], at no motion.
pub type PoseGradient = Twist;

impl Twist {
    /// The values in order: translation, rotation, log_focal.
    pub fn to_array(self) -> [f64; TWIST_VALUES] {
        let ([x, y, z], [a, b, c]) = (self.translation.to_array(), self.rotation.to_array());
        [x, y, z, a, b, c, self.log_focal]
    }

    /// The inverse of [`to_array`](Self::to_array).
    pub fn from_array([x, y, z, a, b, c, log_focal]: [f64; TWIST_VALUES]) -> Self {
        Self { translation: DVec3::new(x, y, z), rotation: DVec3::new(a, b, c), log_focal }
    }

    /// The rotation and translation of exp(ξ).
    pub fn exponential(&self) -> (DMat3, DVec3) {
        let (omega, angle) = (self.rotation, self.rotation.length());
        // (1 − cos θ)/θ² and (θ − sin θ)/θ³, by their series where these cancel.
        let angle2 = angle * angle;
        let (b, c) = if angle < 1e-3 {
            (0.5 - angle2 / 24.0, 1.0 / 6.0 - angle2 / 120.0)
        } else {
            ((1.0 - angle.cos()) / angle2, (angle - angle.sin()) / (angle2 * angle))
        };
        let turned = DMat3::from_quat(glam::DQuat::from_scaled_axis(omega));
        let v = self.translation;
        let moved = v + b * omega.cross(v) + c * omega.cross(omega.cross(v));
        (turned, moved)
    }
}

impl Camera {
    /// This camera after a small motion.
    pub fn moved(&self, by: &Twist) -> Self {
        let (turned, moved) = by.exponential();
        let zoom = by.log_focal.exp();
        Self {
            rotation: turned * self.rotation,
            translation: turned * self.translation + moved,
            fx: self.fx * zoom,
            fy: self.fy * zoom,
            ..*self
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_twist_moves_points_as_its_first_order_says_and_is_undone_by_its_negative() {
        let camera =
            Camera::centred((64, 48), (50.0, 55.0), DMat3::from_rotation_y(0.3), DVec3::ONE);
        let point = DVec3::new(0.4, -0.2, 3.0);
        let local = |camera: &Camera| camera.rotation * point + camera.translation;
        let twist = |by: f64| Twist {
            translation: by * DVec3::new(0.3, -0.1, 0.2),
            rotation: by * DVec3::new(-0.2, 0.5, 0.1),
            log_focal: by * 0.4,
        };
        let small = twist(1e-6);
        let expected = small.translation + small.rotation.cross(local(&camera));
        let moved = local(&camera.moved(&small)) - local(&camera);
        assert!((moved - expected).length() < 1e-11, "{moved} {expected}");
        for size in [1e-4, 1.0] {
            let there = camera.moved(&twist(size));
            let back = there.moved(&twist(-size));
            assert!((back.rotation - camera.rotation).determinant().abs() < 1e-12);
            assert!((back.translation - camera.translation).length() < 1e-12, "{size}");
            assert!((back.fx - camera.fx).abs() < 1e-12 && there.fx > camera.fx);
            assert!((there.rotation.determinant() - 1.0).abs() < 1e-12);
        }
        assert_eq!(Twist::from_array(small.to_array()), small);
    }
}
