//! Defines the camera that rays start from.
//!
//! Its rays come from its axes in the world, not from an inverted projection: so comparing them with
//! the trainer's `Camera::project` tests both.

use glam::{DMat3, DVec2, DVec3};
use serde::{Deserialize, Serialize};

use crate::lens::Lens;

/// A camera, a pinhole unless it has a lens. OpenCV axes: x right, y down, z forward; pixel centres at +0.5.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Camera {
    /// Image width `[px]`, >= 1.
    pub width: u32,
    /// Image height `[px]`, >= 1.
    pub height: u32,
    /// Focal length along x `[px]`, > 0.
    pub fx: f64,
    /// Focal length along y `[px]`, > 0.
    pub fy: f64,
    /// Principal point's x `[px]`; the image's left edge is 0.
    pub cx: f64,
    /// Principal point's y `[px]`; the image's upper edge is 0.
    pub cy: f64,
    /// Columns: the directions right, down and forward in the world; orthonormal.
    pub world_from_camera: DMat3,
    /// The camera's place in the world.
    pub centre: DVec3,
    /// What bends straight lines, if anything does.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub lens: Option<Lens>,
}

impl Camera {
    /// A camera at `centre` that looks at `target`, its upper side towards `up`, with horizontal
    /// field of view `fov_x` `[rad]` and square pixels.
    #[must_use]
    pub fn looking(
        centre: DVec3,
        target: DVec3,
        up: DVec3,
        fov_x: f64,
        (width, height): (u32, u32),
    ) -> Self {
        let forward = (target - centre).normalize_or(DVec3::NEG_Z);
        // Looking along `up`, any horizontal direction is as good as another.
        let right = forward.cross(up).normalize_or(forward.any_orthonormal_vector());
        let down = forward.cross(right);
        let focal = 0.5 * f64::from(width) / (0.5 * fov_x).tan();
        Self::centred((width, height), focal, DMat3::from_cols(right, down, forward), centre)
    }

    /// A camera whose principal point is the image's middle.
    pub(crate) fn centred(
        (width, height): (u32, u32),
        focal: f64,
        world_from_camera: DMat3,
        centre: DVec3,
    ) -> Self {
        let (cx, cy) = (0.5 * f64::from(width), 0.5 * f64::from(height));
        Self { width, height, fx: focal, fy: focal, cx, cy, world_from_camera, centre, lens: None }
    }

    /// The direction through a place in the image `[px]`, in the world. Its component along the
    /// camera's axis is 1: a ray parameter along it is a depth.
    #[must_use]
    pub fn direction(&self, pixel: DVec2) -> DVec3 {
        let m = &self.world_from_camera;
        let place = DVec2::new((pixel.x - self.cx) / self.fx, (pixel.y - self.cy) / self.fy);
        let ray = self.lens.map_or(place, |lens| lens.ray(place));
        ray.x * m.x_axis + ray.y * m.y_axis + m.z_axis
    }

    /// The direction the camera looks into, unit length.
    #[must_use]
    pub fn forward(&self) -> DVec3 {
        self.world_from_camera.z_axis
    }

    /// Place in the image and depth of a point in the world.
    #[must_use]
    pub fn project(&self, world: DVec3) -> (DVec2, f64) {
        let way = world - self.centre;
        let m = &self.world_from_camera;
        let (x, y, depth) = (way.dot(m.x_axis), way.dot(m.y_axis), way.dot(m.z_axis));
        if let Some(lens) = &self.lens {
            let place = lens.image(DVec2::new(x / depth, y / depth));
            return (DVec2::new(self.cx + self.fx * place.x, self.cy + self.fy * place.y), depth);
        }
        (DVec2::new(self.cx + self.fx * x / depth, self.cy + self.fy * y / depth), depth)
    }

    /// Whether a place in the image lies on it.
    #[must_use]
    pub fn contains(&self, pixel: DVec2) -> bool {
        let (w, h) = (f64::from(self.width), f64::from(self.height));
        pixel.x >= 0.0 && pixel.y >= 0.0 && pixel.x < w && pixel.y < h
    }
}
