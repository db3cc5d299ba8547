//! Camera paths through a scene, for videos: computed from the cameras of a dataset, or read from a file.

mod around;
mod file;

use glam::{DMat3, DQuat, DVec3};

use crate::camera::Camera;
use crate::spline::catmull_rom;
pub use around::{Orientation, orbit, orientation, spiral};
pub use file::{CameraPathError, MAX_SIDE, SavedCameraPath, parse_keyframe, read};

/// A camera that a path passes through.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Keyframe {
    /// Position in the world.
    pub centre: DVec3,
    /// Rotation from the camera's axes (x right, y down, z forward) to the world's.
    pub world_from_camera: DQuat,
    /// Vertical field of view `[rad]`, in (0, π).
    pub fov_y: f64,
}

/// A smooth path through keyframes.
#[derive(Debug, Clone, PartialEq)]
pub struct CameraPath {
    /// The keyframes, at equal intervals of time; at least one.
    pub keyframes: Vec<Keyframe>,
    /// True if the path returns from the last keyframe to the first.
    pub is_loop: bool,
}

impl Keyframe {
    /// A camera that looks at `target`; `up` must not be parallel to the viewing direction.
    pub fn looking_at(centre: DVec3, target: DVec3, up: DVec3, fov_y: f64) -> Self {
        let forward = (target - centre).normalize_or(DVec3::Z);
        let right = forward.cross(up).normalize_or(forward.any_orthonormal_vector());
        let axes = DMat3::from_cols(right, forward.cross(right), forward);
        Self { centre, world_from_camera: DQuat::from_mat3(&axes), fov_y }
    }

    /// The camera with an image of the given size, (width, height) `[px]`.
    pub fn camera(&self, (width, height): (u32, u32)) -> Camera {
        let focal = 0.5 * f64::from(height) / (0.5 * self.fov_y).tan();
        let rotation = DMat3::from_quat(self.world_from_camera.inverse());
        Camera::centred((width, height), (focal, focal), rotation, self.centre)
    }
}

impl CameraPath {
    /// Interpolates the camera of frame `frame`, counted from 0, of `frames`. A loop's last frame is one step before
    /// its first; any other path ends at its last keyframe. Positions, rotations and fields of view follow a
    /// Catmull-Rom spline, so that speed is continuous.
    pub fn frame(&self, frame: u32, frames: u32) -> Keyframe {
        let count = self.keyframes.len();
        let (steps, intervals) =
            if self.is_loop { (frames, count) } else { (frames.saturating_sub(1), count - 1) };
        let position = f64::from(frame) / f64::from(steps.max(1)) * intervals as f64;
        let first = (position.floor() as usize).min(intervals.saturating_sub(1));
        let t = position - first as f64;
        let keyframe = |offset: isize| {
            let (at, count) = (first as isize + offset, count as isize);
            let index = if self.is_loop { at.rem_euclid(count) } else { at.clamp(0, count - 1) };
            self.keyframes[index as usize]
        };
        let nearest = [keyframe(-1), keyframe(0), keyframe(1), keyframe(2)];
        let weights = catmull_rom(t);
        let mut rotation = DQuat::from_xyzw(0.0, 0.0, 0.0, 0.0);
        let (mut centre, mut log_fov) = (DVec3::ZERO, 0.0);
        let reference = nearest[1].world_from_camera;
        for (keyframe, weight) in nearest.iter().zip(weights) {
            centre += keyframe.centre * weight;
            log_fov += (0.5 * keyframe.fov_y).tan().ln() * weight;
            // q and −q are the same rotation.
            let q = keyframe.world_from_camera;
            rotation += q * if q.dot(reference) < 0.0 { -weight } else { weight };
        }
        let is_defined = rotation.length_squared() > 1e-12;
        let world_from_camera = if is_defined { rotation.normalize() } else { reference };
        Keyframe { centre, world_from_camera, fov_y: 2.0 * log_fov.exp().atan() }
    }
}

#[cfg(test)]
mod tests;
