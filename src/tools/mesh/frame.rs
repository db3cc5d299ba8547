//! Depth maps: confidence per pixel, interpolation, and a cache of the first few.

use densify_core::camera::Camera;
use densify_run::failure::Failure;
use glam::DVec3;
use rayon::prelude::*;

use super::DepthSource;

/// A depth map with colours.
#[derive(Debug, Clone, PartialEq)]
pub struct DepthFrame {
    /// Width `[px]`.
    pub width: usize,
    /// Height `[px]`.
    pub height: usize,
    /// Camera-space z, or 0 where it is unknown `[scene units]`. Shape: `[height, width]`.
    pub depth: Vec<f32>,
    /// Colours, sRGB-encoded. Shape: `[height, width]`.
    pub rgb: Vec<[u8; 3]>,
}

/// A depth map with its camera and confidences.
pub(super) struct Frame {
    pub(super) camera: Camera,
    pub(super) map: DepthFrame,
    /// cosθ, θ the angle between the ray and the surface's normal; 0 where the depth is unknown. Shape:
    /// `[height, width]`.
    pub(super) cosine: Vec<f32>,
}

/// What a view shows at an image position.
#[derive(Debug, Clone, Copy)]
pub(super) struct Seen {
    /// Camera-space z of the surface `[scene units]`.
    pub(super) depth: f32,
    /// See [`Frame::cosine`].
    pub(super) cosine: f32,
}

impl Seen {
    /// Weight of the observation, cosθ/z².
    pub(super) fn weight(self) -> f32 {
        self.cosine / (self.depth * self.depth)
    }
}

/// The depth maps of a source. Those that fit into the memory are kept; the others are rendered again when needed.
pub(super) struct Frames<'a> {
    source: &'a mut dyn DepthSource,
    kept: Vec<Option<Frame>>,
    left: u64,
}

impl<'a> Frames<'a> {
    pub(super) fn new(source: &'a mut dyn DepthSource, memory: u64) -> Self {
        let kept = (0..source.count()).map(|_| None).collect();
        Self { source, kept, left: memory }
    }

    pub(super) fn count(&self) -> usize {
        self.kept.len()
    }

    /// Calls `visit` with the depth map of each view, in order.
    pub(super) fn for_each<E: From<Failure>>(
        &mut self,
        mut visit: impl FnMut(&Frame) -> Result<(), E>,
    ) -> Result<(), E> {
        for view in 0..self.count() {
            if let Some(frame) = &self.kept[view] {
                visit(frame)?;
                continue;
            }
            let frame = Frame::new(self.source.camera(view), self.source.frame(view)?);
            visit(&frame)?;
            let bytes = (frame.cosine.len() * (2 * size_of::<f32>() + 3)) as u64;
            if let Some(left) = self.left.checked_sub(bytes) {
                self.left = left;
                self.kept[view] = Some(frame);
            }
        }
        Ok(())
    }
}

impl Frame {
    fn new(camera: Camera, map: DepthFrame) -> Self {
        let (width, height) = (map.width, map.height);
        let mut frame = Self { camera, map, cosine: Vec::new() };
        let pixels = (0..width * height).into_par_iter();
        frame.cosine = pixels.map(|at| frame.cosine_at(at % width, at / width)).collect();
        frame
    }

    /// The seen point of a pixel, in camera coordinates; `None` where the depth is unknown.
    fn seen(&self, x: usize, y: usize) -> Option<DVec3> {
        let z = f64::from(self.map.depth[y * self.map.width + x]);
        (z > 0.0).then(|| self.ray(x, y) * z)
    }

    /// The ray through a pixel's centre, in camera coordinates, with z = 1.
    fn ray(&self, x: usize, y: usize) -> DVec3 {
        let Camera { fx, fy, cx, cy, .. } = self.camera;
        DVec3::new((x as f64 + 0.5 - cx) / fx, (y as f64 + 0.5 - cy) / fy, 1.0)
    }

    /// The seen point of a pixel, in scene coordinates.
    pub(super) fn seen_in_scene(&self, x: usize, y: usize) -> Option<DVec3> {
        let Camera { rotation, translation, .. } = &self.camera;
        self.seen(x, y).map(|p| rotation.transpose() * (p - translation))
    }

    /// cosθ; the normal comes from differences to the pixels beside, above and below.
    fn cosine_at(&self, x: usize, y: usize) -> f32 {
        let Some(here) = self.seen(x, y) else { return 0.0 };
        let DepthFrame { width, height, .. } = self.map;
        let right = (x + 1 < width).then(|| self.seen(x + 1, y)).flatten();
        let left = (x > 0).then(|| self.seen(x - 1, y)).flatten();
        let below = (y + 1 < height).then(|| self.seen(x, y + 1)).flatten();
        let above = (y > 0).then(|| self.seen(x, y - 1)).flatten();
        let along_x = right.unwrap_or(here) - left.unwrap_or(here);
        let along_y = below.unwrap_or(here) - above.unwrap_or(here);
        let normal = along_x.cross(along_y);
        let cosine = normal.dot(here).abs() / (normal.length() * here.length());
        // A pixel without neighbours has no normal.
        if cosine.is_finite() { cosine as f32 } else { 0.0 }
    }

    /// The surface at an image position `[px]`; `None` outside of the image or where it is unknown. The inverse depth is
    /// interpolated, exactly on planes, unless the four depths differ by more than `reach`.
    pub(super) fn surface_at(&self, u: f32, v: f32, reach: f32) -> Option<Seen> {
        let DepthFrame { width, height, ref depth, .. } = self.map;
        if !(u >= 0.0 && v >= 0.0 && u < width as f32 && v < height as f32) {
            return None;
        }
        let nearest = v as usize * width + u as usize;
        let cosine = self.cosine[nearest];
        if cosine <= 0.0 {
            return None;
        }
        let (corners, (s, t)) = neighbours(u, v, width, height);
        let corner = |i: usize| depth[corners[i]];
        let (mut low, mut high) = (f32::INFINITY, 0.0_f32);
        for i in 0..4 {
            (low, high) = (low.min(corner(i)), high.max(corner(i)));
        }
        if low <= 0.0 || high - low > reach {
            return Some(Seen { depth: depth[nearest], cosine });
        }
        let mix = |a: f32, b: f32, share: f32| a + (b - a) * share;
        let above = mix(1.0 / corner(0), 1.0 / corner(1), s);
        let below = mix(1.0 / corner(2), 1.0 / corner(3), s);
        Some(Seen { depth: 1.0 / mix(above, below, t), cosine })
    }

    /// The colour at a position inside the image `[px]`, in 0..=255, interpolated unless there is background beside it.
    pub(super) fn colour_at(&self, u: f32, v: f32) -> [f32; 3] {
        let DepthFrame { width, height, ref depth, ref rgb } = self.map;
        let (mut corners, (s, t)) = neighbours(u, v, width, height);
        if corners.iter().any(|&corner| depth[corner] <= 0.0) {
            corners = [v as usize * width + u as usize; 4];
        }
        let mix = |a: f32, b: f32, share: f32| a + (b - a) * share;
        std::array::from_fn(|c| {
            let corner = |i: usize| f32::from(rgb[corners[i]][c]);
            mix(mix(corner(0), corner(1), s), mix(corner(2), corner(3), s), t)
        })
    }
}

/// The four pixels around an image position (upper left, upper right, lower left, lower right), and the position
/// between their centres, in `0..=1` each way. At the image's edges, pixels are repeated.
fn neighbours(u: f32, v: f32, width: usize, height: usize) -> ([usize; 4], (f32, f32)) {
    let split = |at: f32, size: usize| {
        let at = (at - 0.5).max(0.0);
        let low = (at as usize).min(size - 1);
        (low, (low + 1).min(size - 1), (at - low as f32).min(1.0))
    };
    let ((x0, x1, s), (y0, y1, t)) = (split(u, width), split(v, height));
    ([y0 * width + x0, y0 * width + x1, y1 * width + x0, y1 * width + x1], (s, t))
}
