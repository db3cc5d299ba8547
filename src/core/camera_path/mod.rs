//! Flights through a scene: a path of cameras, from the cameras of a dataset or from a file.

mod around;
mod file;

use glam::{DMat3, DQuat, DVec3};

use crate::camera::Camera;
use crate::spline::catmull_rom;
pub use around::{Bearings, bearings, orbit, spiral};
pub use file::{FlightError, MOST_SIDE, SavedFlight, key, read};

/// A camera on a path.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Key {
    /// Where it is.
    pub centre: DVec3,
    /// Which way it looks: from the camera's axes (x right, y down, z forward) to the world's.
    pub turn: DQuat,
    /// Vertical field of view `[rad]`, in (0, π).
    pub fov_y: f64,
}

/// A path through some cameras.
#[derive(Debug, Clone, PartialEq)]
pub struct Flight {
    /// Those that it passes, at equal intervals; at least one.
    pub keys: Vec<Key>,
    /// Whether it returns from the last to the first.
    pub is_loop: bool,
}

impl Key {
    /// A camera that looks at a point; `up` must not be the direction of view.
    #[must_use]
    pub fn looking_at(centre: DVec3, target: DVec3, up: DVec3, fov_y: f64) -> Self {
        let forward = (target - centre).normalize_or(DVec3::Z);
        let right = forward.cross(up).normalize_or(forward.any_orthonormal_vector());
        let axes = DMat3::from_cols(right, forward.cross(right), forward);
        Self { centre, turn: DQuat::from_mat3(&axes), fov_y }
    }

    /// The camera, with an image of this size.
    #[must_use]
    pub fn camera(&self, (width, height): (u32, u32)) -> Camera {
        let focal = 0.5 * f64::from(height) / (0.5 * self.fov_y).tan();
        let rotation = DMat3::from_quat(self.turn.inverse());
        Camera::centred((width, height), (focal, focal), rotation, self.centre)
    }
}

impl Flight {
    /// The camera of frame `frame` of `frames`. A loop's last frame is followed by its first; another
    /// flight ends at its last key. Positions, directions and fields of view follow a Catmull-Rom spline,
    /// whose speed does not jump.
    #[must_use]
    pub fn frame(&self, frame: u32, frames: u32) -> Key {
        let keys = self.keys.len();
        let (steps, intervals) = match self.is_loop {
            true => (frames, keys),
            false => (frames.saturating_sub(1), keys - 1),
        };
        let place = f64::from(frame) / f64::from(steps.max(1)) * intervals as f64;
        let first = (place.floor() as usize).min(intervals.saturating_sub(1));
        let t = place - first as f64;
        let key = |offset: isize| {
            let at = first as isize + offset;
            match self.is_loop {
                true => self.keys[at.rem_euclid(keys as isize) as usize],
                false => self.keys[at.clamp(0, keys as isize - 1) as usize],
            }
        };
        let near = [key(-1), key(0), key(1), key(2)];
        let weights = catmull_rom(t);
        let mut turn = DQuat::from_xyzw(0.0, 0.0, 0.0, 0.0);
        let (mut centre, mut log_fov) = (DVec3::ZERO, 0.0);
        for (key, weight) in near.iter().zip(weights) {
            centre += key.centre * weight;
            log_fov += (0.5 * key.fov_y).tan().ln() * weight;
            // q and −q are the same turn.
            let sign = if key.turn.dot(near[1].turn) < 0.0 { -weight } else { weight };
            turn += key.turn * sign;
        }
        let turn = if turn.length_squared() > 1e-12 { turn.normalize() } else { near[1].turn };
        Key { centre, turn, fov_y: 2.0 * log_fov.exp().atan() }
    }
}

#[cfg(test)]
mod tests;
