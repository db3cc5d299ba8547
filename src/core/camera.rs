//! Pinhole cameras with OpenCV axes: x right, y down, z forward; pixel centres are at +0.5.

use glam::{DMat3, DVec2, DVec3};
use serde::{Deserialize, Serialize};

/// A pinhole camera with its pose.
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
    /// Rotation part of camera_from_world, orthonormal, determinant +1.
    pub rotation: DMat3,
    /// Translation part of camera_from_world `[scene units]`.
    pub translation: DVec3,
}

impl Camera {
    /// A camera at `centre` with the principal point in the middle of its image.
    pub fn centred(
        (width, height): (u32, u32),
        (fx, fy): (f64, f64),
        rotation: DMat3,
        centre: DVec3,
    ) -> Self {
        let (cx, cy) = (0.5 * f64::from(width), 0.5 * f64::from(height));
        Self { width, height, fx, fy, cx, cy, rotation, translation: -(rotation * centre) }
    }

    /// The camera's centre in world coordinates, −Rᵀt.
    pub fn centre(&self) -> DVec3 {
        -(self.rotation.transpose() * self.translation)
    }

    /// The viewing direction in world coordinates, unit length.
    pub fn forward(&self) -> DVec3 {
        self.rotation.row(2)
    }

    /// Projects a world point to its pixel coordinates and depth (camera z). The pixel is meaningless if depth <= 0.
    pub fn project(&self, world: DVec3) -> (DVec2, f64) {
        let p = self.rotation * world + self.translation;
        (DVec2::new(self.fx * p.x / p.z + self.cx, self.fy * p.y / p.z + self.cy), p.z)
    }

    /// The world point at pixel coordinates and depth (camera z): the inverse of [`project`](Self::project).
    pub fn unproject(&self, pixel: DVec2, depth: f64) -> DVec3 {
        let ray = DVec3::new((pixel.x - self.cx) / self.fx, (pixel.y - self.cy) / self.fy, 1.0);
        self.rotation.transpose() * (depth * ray - self.translation)
    }

    /// The depth of a world point if it is in front of the camera and its projection is in the image; `None` otherwise.
    /// The image is extended at every edge by `margin`, a fraction of its width or height.
    pub fn depth_in_image(&self, world: DVec3, margin: f64) -> Option<f64> {
        self.place_in_image(world, margin).map(|(_, depth)| depth)
    }

    /// Like [`depth_in_image`](Self::depth_in_image), but returns the pixel coordinates, too.
    pub fn place_in_image(&self, world: DVec3, margin: f64) -> Option<(DVec2, f64)> {
        let (pixel, depth) = self.project(world);
        let within = |x: f64, size: u32| {
            let (size, margin) = (f64::from(size), margin * f64::from(size));
            (-margin..size + margin).contains(&x)
        };
        (depth > 0.0 && within(pixel.x, self.width) && within(pixel.y, self.height))
            .then_some((pixel, depth))
    }

    /// The same view with an image of a different size. The intrinsics of each axis are scaled separately.
    pub fn resized(&self, width: u32, height: u32) -> Self {
        let sx = f64::from(width) / f64::from(self.width);
        let sy = f64::from(height) / f64::from(self.height);
        Self {
            width,
            height,
            fx: self.fx * sx,
            fy: self.fy * sy,
            cx: self.cx * sx,
            cy: self.cy * sy,
            ..*self
        }
    }
}
