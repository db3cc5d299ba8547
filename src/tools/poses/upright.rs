//! Turns a scene upright: its up direction, which an engine leaves open, becomes −y, as in COLMAP's own cameras.

use densify_core::camera::Camera;
use densify_core::camera_path::orientation;
use glam::{DMat3, DQuat, DVec3};

/// The rotation of the world that makes it upright. `cameras` have the rotation of `camera_from_world`, the centre, and
/// the direction in the image (x right, y down) that is up.
pub(crate) fn upright_from_world(cameras: impl Iterator<Item = (DQuat, DVec3, [f64; 2])>) -> DQuat {
    let shown: Vec<Camera> = cameras
        .map(|(rotation, centre, [x, y])| {
            // The camera as if it had been held upright: its y axis points down in the photograph as it is shown.
            let down = DVec3::new(-x, -y, 0.0);
            let held = DMat3::from_cols(down.cross(DVec3::Z), down, DVec3::Z).transpose();
            Camera::centred((1, 1), (1.0, 1.0), held * DMat3::from_quat(rotation), centre)
        })
        .collect();
    if shown.is_empty() {
        return DQuat::IDENTITY;
    }
    DQuat::from_rotation_arc(orientation(&shown).up, DVec3::NEG_Y)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Cameras on a ring that look slightly down, in a world that `turn` has turned.
    fn ring(turn: DQuat, up: [f64; 2]) -> Vec<(DQuat, DVec3, [f64; 2])> {
        let camera = |step: u32| {
            let angle = f64::from(step) * 0.3;
            let centre = DVec3::new(angle.cos(), -0.3, angle.sin());
            let forward = -centre.normalize();
            let right = DVec3::Y.cross(forward).normalize();
            let held = DMat3::from_cols(right, forward.cross(right), forward);
            // A camera on its side sees the scene turned by a quarter.
            let (x, y) = (up[0], up[1]);
            let axes = DMat3::from_cols(DVec3::new(-y, x, 0.0), DVec3::new(-x, -y, 0.0), DVec3::Z);
            let stored = held * axes.transpose();
            (DQuat::from_mat3(&(DMat3::from_quat(turn) * stored).transpose()), turn * centre, up)
        };
        (0..20).map(camera).collect()
    }

    #[test]
    fn a_turned_scene_becomes_upright_whichever_way_the_camera_was_held() {
        for up in [[0.0, -1.0], [-1.0, 0.0], [1.0, 0.0], [0.0, 1.0]] {
            let turn = DQuat::from_euler(glam::EulerRot::XYZ, 0.7, 1.9, -2.2);
            let found = upright_from_world(ring(turn, up).into_iter());
            let up_now = found * (turn * DVec3::NEG_Y);
            assert!(up_now.distance(DVec3::NEG_Y) < 0.02, "{up:?}: {up_now}");
        }
    }
}
