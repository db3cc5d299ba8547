//! The camera that rays start from.
//!
//! Rays are computed from the camera's axes in the world and not by inverting a projection, so that comparing
//! them with the trainer's `Camera::project` tests both.

use glam::{DMat3, DVec2, DVec3};
use serde::{Deserialize, Serialize};

use crate::error::Error;
use crate::lens::Lens;

/// A camera: a pinhole camera unless it has a lens. OpenCV axes: x right, y down, z forward; pixel centres at +0.5.
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
    /// Position in the world.
    pub centre: DVec3,
    /// The lens; `None` for a pinhole camera.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub lens: Option<Lens>,
}

impl Camera {
    /// A camera at `centre` that looks at `target` with `up` towards the top of the image, horizontal field of
    /// view `fov_x` `[rad]` and square pixels.
    pub fn looking(
        centre: DVec3,
        target: DVec3,
        up: DVec3,
        fov_x: f64,
        (width, height): (u32, u32),
    ) -> Self {
        let forward = (target - centre).normalize_or(DVec3::NEG_Z);
        // If the camera looks along `up`, any perpendicular direction will do.
        let right = forward.cross(up).normalize_or(forward.any_orthonormal_vector());
        let down = forward.cross(right);
        let focal = 0.5 * f64::from(width) / (0.5 * fov_x).tan();
        Self::centred((width, height), focal, DMat3::from_cols(right, down, forward), centre)
    }

    /// A pinhole camera whose principal point is the centre of the image.
    pub(crate) fn centred(
        (width, height): (u32, u32),
        focal: f64,
        world_from_camera: DMat3,
        centre: DVec3,
    ) -> Self {
        let (cx, cy) = (0.5 * f64::from(width), 0.5 * f64::from(height));
        Self { width, height, fx: focal, fy: focal, cx, cy, world_from_camera, centre, lens: None }
    }

    /// Adds a lens to a pinhole camera. The field of view between the middles of the left and right edges is
    /// unchanged.
    ///
    /// # Errors
    /// When the lens images two directions at the same point of the image, or its field of view is narrower than the
    /// image.
    pub(crate) fn with_lens(self, lens: Lens) -> Result<Self, Error> {
        let half = 0.5 * f64::from(self.width);
        let slope = half / self.fx;
        let factor = slope / lens.image(DVec2::new(slope, 0.0)).x;
        let (fx, fy) = (self.fx * factor, self.fy * factor);
        let corner = DVec2::new(half / fx, 0.5 * f64::from(self.height) / fy).length();
        let limit = lens.invertible_angle();
        if !(factor > 0.0
            && factor.is_finite()
            && corner < lens.radius(limit)
            && slope.atan() < limit)
        {
            let field = 2.0 * limit.to_degrees();
            return Err(Error::option(
                "--lens",
                format!(
                    "{lens} can be inverted only within {field:.0} degrees, but the image is wider from corner \
                     to corner; lower --fov or the coefficients"
                ),
            ));
        }
        Ok(Self { fx, fy, lens: Some(lens), ..self })
    }

    /// The world-space direction through an image point `[px]`. Its component along the camera's axis is 1, so
    /// that ray parameters are depths.
    pub fn direction(&self, pixel: DVec2) -> DVec3 {
        let m = &self.world_from_camera;
        let image = DVec2::new((pixel.x - self.cx) / self.fx, (pixel.y - self.cy) / self.fy);
        let ray = self.lens.map_or(image, |lens| lens.ray(image));
        ray.x * m.x_axis + ray.y * m.y_axis + m.z_axis
    }

    /// The viewing direction, unit length.
    pub fn forward(&self) -> DVec3 {
        self.world_from_camera.z_axis
    }

    /// The image point `[px]` and the depth of a point in the world.
    pub fn project(&self, world: DVec3) -> (DVec2, f64) {
        let offset = world - self.centre;
        let m = &self.world_from_camera;
        let (x, y, depth) = (offset.dot(m.x_axis), offset.dot(m.y_axis), offset.dot(m.z_axis));
        if let Some(lens) = &self.lens {
            let image = lens.image(DVec2::new(x / depth, y / depth));
            return (DVec2::new(self.cx + self.fx * image.x, self.cy + self.fy * image.y), depth);
        }
        (DVec2::new(self.cx + self.fx * x / depth, self.cy + self.fy * y / depth), depth)
    }

    /// True if an image point lies within the image.
    pub fn contains(&self, pixel: DVec2) -> bool {
        let (w, h) = (f64::from(self.width), f64::from(self.height));
        pixel.x >= 0.0 && pixel.y >= 0.0 && pixel.x < w && pixel.y < h
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn pinhole(fov: f64) -> Camera {
        let fov = fov.to_radians();
        Camera::looking(DVec3::new(1.0, 2.0, 3.0), DVec3::ZERO, DVec3::Y, fov, (80, 60))
    }

    fn with_lens(fov: f64, lens: &str) -> Result<Camera, Error> {
        pinhole(fov).with_lens(lens.parse().unwrap())
    }

    #[test]
    fn points_on_a_ray_project_to_its_pixel() {
        for text in
            ["fisheye", "fisheye:0.03,-0.008,0.002,-0.0003", "radial:-0.1,0.02", "radial:0.2"]
        {
            let camera = with_lens(70.0, text).unwrap();
            for (x, y) in (0..=16).flat_map(|x| (0..=12).map(move |y| (x, y))) {
                let pixel = 5.0 * DVec2::new(f64::from(x), f64::from(y));
                let (back, depth) = camera.project(camera.centre + 3.0 * camera.direction(pixel));
                assert!((depth - 3.0).abs() < 1e-12, "{text}");
                assert!((back - pixel).length() < 1e-9, "{text}: {pixel} {back}");
            }
        }
    }

    #[test]
    fn a_lens_keeps_the_horizontal_field_of_view() {
        for text in ["fisheye:0.1", "radial:-0.1"] {
            let [plain, bent] = [pinhole(60.0), with_lens(60.0, text).unwrap()];
            let edge = DVec2::new(0.0, 30.0);
            assert!((plain.direction(edge) - bent.direction(edge)).length() < 1e-12, "{text}");
            let inside = DVec2::new(20.0, 15.0);
            assert!((plain.direction(inside) - bent.direction(inside)).length() > 1e-3, "{text}");
        }
    }

    #[test]
    fn lenses_that_cannot_be_inverted_within_the_image_are_refused() {
        for (text, fov) in
            [("radial:-0.9", 70.0), ("fisheye:0,-2", 90.0), ("fisheye:0,-0.3", 150.0)]
        {
            let message = with_lens(fov, text).unwrap_err().to_string();
            assert!(message.contains("--lens") && message.contains("degrees"), "{message}");
        }
    }
}
