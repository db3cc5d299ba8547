//! Renders a camera's view: colour with alpha, depth and normals.
//!
//! Pixels do not depend on the threads that compute them.

use glam::{DVec2, DVec3, Vec2, Vec3};
use rayon::prelude::*;

use crate::camera::Camera;
use crate::camera_light::CameraLight;
use crate::intersect::Intersection;
use crate::mesh::Model;
use crate::packet::LANES;
use crate::random::{Draws, stratum};
use crate::shade::{Lighting, Point, Sampling, ShadedSurface, TriangleFlags, VisiblePoint};
use crate::surface::{LocalHit, LocalRay, Surface};
use crate::texture::encode;

/// Maximum number of surfaces that a ray passes through.
const MAX_LAYERS: usize = 64;
/// Transmittance at which a ray ends: half a step of eight bits.
const MIN_TRANSMITTANCE: f32 = 1.0 / 512.0;
/// Number of rows of pixels traced by one task.
const BAND: usize = 4;
/// Width of the tiles of a band `[px]`; empty tiles are skipped.
const TILE: usize = 8;

/// One rendered view.
#[derive(Debug, Clone, PartialEq)]
pub struct Frame {
    /// Image width `[px]`.
    pub width: u32,
    /// Image height `[px]`.
    pub height: u32,
    /// sRGB colour and straight alpha (coverage). Shape: `[height, width, 4]`.
    pub rgba: Vec<u8>,
    /// The photograph, if it differs from `rgba` by its exposure, a vignette or passers-by. Shape: `[height, width, 4]`.
    pub exposed: Option<Vec<u8>>,
    /// 0 where [passers-by](crate::Options::passers_by) cover the scene, 255 elsewhere; `None` for views without
    /// passers-by. Shape: `[height, width]`.
    pub mask: Option<Vec<u8>>,
    /// Camera z of the first surface with alpha of at least 0.5 on the ray through the pixel's centre; 0 if
    /// there is none. Shape: `[height, width]`.
    pub depth: Vec<f32>,
    /// Geometric normal of that surface in world space, unit length, towards the camera; zero if there is
    /// none. Shape: `[height, width]`.
    pub normals: Vec<[f32; 3]>,
    /// Index of that surface's triangle in the model; `u32::MAX` if there is none. Shape: `[height, width]`.
    pub triangles: Vec<u32>,
}

/// Renders views of one scene.
pub(crate) struct Tracer<'a> {
    pub(crate) surface: &'a Surface,
    pub(crate) model: &'a Model,
    pub(crate) flags: &'a [TriangleFlags],
    pub(crate) lighting: &'a Lighting,
    /// Factor on all radiance before it is encoded.
    pub(crate) exposure: f32,
    pub(crate) seed: u64,
}

/// Camera rays of a pixel, at most [`LANES`].
struct Rays {
    rays: [LocalRay; LANES],
    /// Index of each ray's subsample.
    index: [u32; LANES],
    /// Distance from the camera to each ray's origin, in local units.
    entry: [f32; LANES],
    count: usize,
    /// Width of a ray's cone at distance 1.
    spread: f32,
}

impl Rays {
    fn new(spread: f32) -> Self {
        let (rays, index, entry) = ([LocalRay::NONE; LANES], [0; LANES], [0.0; LANES]);
        Self { rays, index, entry, count: 0, spread }
    }

    /// Adds a ray, if it hits the bounding box.
    fn add(&mut self, surface: &Surface, index: u32, origin: DVec3, direction: DVec3) {
        if let Some((ray, entry)) = surface.enter_with_distance(origin, direction, f64::INFINITY) {
            self.rays[self.count] = ray;
            self.index[self.count] = index;
            self.entry[self.count] = entry;
            self.count += 1;
        }
    }

    fn all(&self) -> &[LocalRay] {
        &self.rays[..self.count]
    }

    fn read<'a>(
        &self,
        shaded: &ShadedSurface<'a>,
        lane: usize,
        hit: &LocalHit,
    ) -> (Point<'a>, f32) {
        let width = (hit.at.t + self.entry[lane]) * self.spread;
        Point::read(shaded, &self.rays[lane], hit, width)
    }

    fn seen<'a>(&self, lane: usize, point: Point<'a>) -> VisiblePoint<'a> {
        VisiblePoint { index: self.index[lane], point, view: -self.rays[lane].direction }
    }
}

impl Frame {
    /// The photograph, in the same shape as `rgba`.
    pub(crate) fn photograph(&self) -> &[u8] {
        self.exposed.as_ref().unwrap_or(&self.rgba)
    }

    fn empty(width: u32, height: u32) -> Self {
        let pixels = width as usize * height as usize;
        Self {
            width,
            height,
            rgba: vec![0; 4 * pixels],
            exposed: None,
            mask: None,
            depth: vec![0.0; pixels],
            normals: vec![[0.0; 3]; pixels],
            triangles: vec![u32::MAX; pixels],
        }
    }
}

impl Tracer<'_> {
    /// Renders a view; its index `view` seeds the random numbers. With `light`, also renders the photograph that such a
    /// camera takes.
    pub(crate) fn render(&self, camera: &Camera, view: u64, light: Option<CameraLight>) -> Frame {
        let mut frame = Frame::empty(camera.width, camera.height);
        let width = camera.width as usize;
        let mut exposed = vec![0; if light.is_some() { frame.rgba.len() } else { 0 }];
        let per_band = if light.is_some() { 4 * BAND * width } else { 0 };
        let mut rest = &mut exposed[..];
        let exposed_bands: Vec<&mut [u8]> = (0..(camera.height as usize).div_ceil(BAND))
            .map(|_| rest.split_off_mut(..per_band.min(rest.len())).unwrap_or_default())
            .collect();
        let bands = frame
            .rgba
            .par_chunks_mut(4 * BAND * width)
            .zip(exposed_bands)
            .zip(frame.depth.par_chunks_mut(BAND * width))
            .zip(frame.normals.par_chunks_mut(BAND * width))
            .zip(frame.triangles.par_chunks_mut(BAND * width));
        bands.enumerate().for_each(|(band, ((((rgba, exposed), depth), normals), triangles))| {
            let top = band * BAND;
            let rows = depth.len() / width;
            for left in (0..width).step_by(TILE) {
                let tile = (left, top, TILE.min(width - left), rows);
                // With a lens, the rays through a tile's edges do not lie in planes.
                if camera.lens.is_none() && self.is_empty(camera, tile) {
                    continue;
                }
                let places = (0..rows).flat_map(|y| (left..left + tile.2).map(move |x| (x, y)));
                for (x, y) in places {
                    let i = y * width + x;
                    let pixel = DVec2::new(x as f64, (top + y) as f64);
                    let draws = Draws::new(self.seed, &[view, ((top + y) * width + x) as u64]);
                    let (colour, coverage, hint) = self.pixel(camera, pixel, draws);
                    rgba[4 * i..4 * i + 4].copy_from_slice(&encoded(colour, coverage));
                    if let Some(light) = light {
                        let factors = light.at(pixel + 0.5, [camera.width, camera.height]);
                        exposed[4 * i..4 * i + 4]
                            .copy_from_slice(&encoded(colour * factors, coverage));
                    }
                    let direction = camera.direction(pixel + 0.5);
                    if let Some(first) = self.first_solid(camera.centre, direction, hint) {
                        depth[i] = first.0 as f32;
                        normals[i] = first.1.as_vec3().to_array();
                        triangles[i] = first.2;
                    }
                }
            }
        });
        frame.exposed = light.map(|_| exposed);
        frame
    }

    /// True if no ray through a tile of pixels (left, top, width, height) hits anything.
    fn is_empty(
        &self,
        camera: &Camera,
        (x, y, width, height): (usize, usize, usize, usize),
    ) -> bool {
        // The rounding error of the pyramid in single precision is less than 3e-7 of the distance.
        let margin = 1e-6 * camera.fx.max(camera.fy);
        let (left, top) = (x as f64 - margin, y as f64 - margin);
        let (right, bottom) = ((x + width) as f64 + margin, (y + height) as f64 + margin);
        let corners = [(left, top), (right, top), (left, bottom), (right, bottom)];
        let directions = corners.map(|(x, y)| camera.direction(DVec2::new(x, y)));
        self.surface.is_missed_by(camera.centre, directions)
    }

    /// True if a ray through the centre of a pixel meets a surface with alpha of at least one half.
    pub(crate) fn meets_surface(&self, camera: &Camera) -> bool {
        let centre = |x: u32, y: u32| DVec2::new(f64::from(x), f64::from(y)) + 0.5;
        let meets = |direction| self.first_solid(camera.centre, direction, None).is_some();
        (0..camera.height)
            .into_par_iter()
            .any(|y| (0..camera.width).any(|x| meets(camera.direction(centre(x, y)))))
    }

    fn shaded(&self) -> ShadedSurface<'_> {
        ShadedSurface { surface: self.surface, model: self.model, flags: self.flags }
    }

    /// Radiance and coverage of the pixel whose top left corner is `corner`, and the slot of a triangle that one
    /// of its rays hit.
    fn pixel(&self, camera: &Camera, corner: DVec2, draws: Draws) -> (Vec3, f32, Option<u32>) {
        let grid = self.lighting.grid;
        let (mut colour, mut alpha) = (Vec3::ZERO, 0.0);
        let mut sampling = Sampling { draws, hit_hint: None, occluder_hint: None };
        // Width of a subsample at depth 1.
        let spread = 1.0 / (camera.fx * f64::from(grid)) as f32;
        let mut indices = 0..grid * grid;
        while !indices.is_empty() {
            let mut rays = Rays::new(spread);
            for index in indices.by_ref().take(LANES) {
                let offset = stratum(index, grid, sampling.draws.square());
                let direction = camera.direction(corner + offset.as_dvec2());
                rays.add(self.surface, index, camera.centre, direction);
            }
            let (c, a) = self.sum_rays(&rays, &mut sampling);
            colour += c;
            alpha += a;
        }
        if alpha <= 0.0 {
            return (Vec3::ZERO, 0.0, sampling.hit_hint);
        }
        let straight = colour * (self.exposure / alpha);
        (straight, alpha / (grid * grid) as f32, sampling.hit_hint)
    }

    /// Sums of premultiplied colour and alpha over the rays.
    fn sum_rays(&self, rays: &Rays, sampling: &mut Sampling) -> (Vec3, f32) {
        let shaded = self.shaded();
        let visible = |slot, at: &Intersection| shaded.is_visible(slot, at);
        let (mut colours, mut alphas) = (Vec3::ZERO, 0.0);
        // The first surfaces are found with one packet, as most are opaque; those behind them with single rays.
        let hits = self.surface.closest_each(rays.all(), visible);
        sampling.hit_hint = hits[rays.count / 2].map(|hit| hit.slot).or(sampling.hit_hint);
        let mut alphas_of = [0.0; LANES];
        let mut seen = Vec::with_capacity(LANES);
        for (lane, hit) in hits.iter().enumerate() {
            let Some(hit) = hit else { continue };
            let (point, alpha) = rays.read(&shaded, lane, hit);
            alphas_of[lane] = alpha;
            if alpha > 0.0 {
                seen.push(rays.seen(lane, point));
            }
        }
        let mut radiance = self.lighting.radiance(&shaded, &seen, sampling).into_iter();
        for (lane, hit) in hits.iter().enumerate() {
            let Some(hit) = hit else { continue };
            let alpha = alphas_of[lane];
            let (mut colour, mut transmittance) = (Vec3::ZERO, 1.0 - alpha);
            if alpha > 0.0 {
                colour = alpha * radiance.next().unwrap_or_default();
            }
            if transmittance > MIN_TRANSMITTANCE {
                self.layers(&rays.rays[lane], *hit, |hit| {
                    let (point, alpha) = rays.read(&shaded, lane, &hit);
                    if alpha > 0.0 {
                        let seen = [rays.seen(lane, point)];
                        let radiance = self.lighting.radiance(&shaded, &seen, sampling)[0];
                        colour += transmittance * alpha * radiance;
                        transmittance *= 1.0 - alpha;
                    }
                    transmittance > MIN_TRANSMITTANCE
                });
            }
            if transmittance <= MIN_TRANSMITTANCE {
                transmittance = 0.0;
            }
            colours += colour;
            alphas += 1.0 - transmittance;
        }
        (colours, alphas)
    }

    /// Depth, normal and triangle of the first surface with alpha of at least one half. The triangle in slot
    /// `hint` is tested first.
    pub(crate) fn first_solid(
        &self,
        origin: DVec3,
        direction: DVec3,
        hint: Option<u32>,
    ) -> Option<(f64, DVec3, u32)> {
        let shaded = self.shaded();
        let ray = self.surface.enter(origin, direction, f64::INFINITY)?;
        let solid =
            |slot, at: &Intersection| shaded.is_visible(slot, at) && shaded.is_solid(slot, at);
        let hit = self.surface.closest(&ray, None, hint, solid)?;
        let hit = self.surface.describe(origin, direction, hit);
        let normal = if hit.normal.dot(direction) > 0.0 { -hit.normal } else { hit.normal };
        Some((hit.t, normal, hit.triangle))
    }

    /// Visits the visible surfaces along a ray behind its first one, front to back, until `visit` returns false.
    fn layers(&self, ray: &LocalRay, first: LocalHit, mut visit: impl FnMut(LocalHit) -> bool) {
        let shaded = self.shaded();
        let visible = |slot, at: &Intersection| shaded.is_visible(slot, at);
        let mut last = first;
        for _ in 1..MAX_LAYERS {
            let after = (last.at.t, self.surface.triangle_of(last.slot));
            let Some(hit) = self.surface.closest(ray, Some(after), None, visible) else {
                return;
            };
            if !visit(hit) {
                return;
            }
            last = hit;
        }
    }
}

/// Encodes a pixel as sRGB with straight alpha.
fn encoded(light: Vec3, coverage: f32) -> [u8; 4] {
    if coverage <= 0.0 {
        return [0; 4];
    }
    let a = (coverage.clamp(0.0, 1.0) * 255.0 + 0.5) as u8;
    [encode(light.x), encode(light.y), encode(light.z), a]
}

/// Luminances of a view, from one ray every `step` pixels in both directions, for choosing an exposure.
pub(crate) fn luminances(tracer: &Tracer<'_>, camera: &Camera, step: u32) -> Vec<f32> {
    let mut all = Vec::new();
    for y in (0..camera.height).step_by(step as usize) {
        for x in (0..camera.width).step_by(step as usize) {
            let draws = Draws::new(tracer.seed, &[u64::from(x), u64::from(y)]);
            let corner = DVec2::new(f64::from(x), f64::from(y));
            let direction = camera.direction(corner + Vec2::splat(0.5).as_dvec2());
            let mut ray = Rays::new(0.0);
            ray.add(tracer.surface, 0, camera.centre, direction);
            let mut sampling = Sampling { draws, hit_hint: None, occluder_hint: None };
            let (c, a) = tracer.sum_rays(&ray, &mut sampling);
            if a > 0.5 {
                all.push(c.dot(Vec3::new(0.2126, 0.7152, 0.0722)));
            }
        }
    }
    all
}

#[cfg(test)]
#[allow(clippy::float_cmp, reason = "exact values")]
mod tests;
