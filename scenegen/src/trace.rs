//! From a camera to an image with alpha, depth and normals.
//!
//! Every pixel is a function of the scene and the view alone, whichever thread computes it.

use glam::{DVec2, DVec3, Vec2, Vec3};
use rayon::prelude::*;

use crate::camera::Camera;
use crate::intersect::Meeting;
use crate::mesh::Model;
use crate::random::{Draws, stratum};
use crate::shade::{Lighting, Matter, Point, Subsample, Traits};
use crate::surface::{LocalHit, LocalRay, Surface};
use crate::texture::encode;

/// Most surfaces a ray passes through.
const MAX_LAYERS: usize = 64;
/// Transmittance below which nothing behind is visible: half a step of eight bits.
const MIN_TRANSMITTANCE: f32 = 1.0 / 512.0;
/// Rows that one task traces.
const BAND: usize = 4;

/// One rendered view.
#[derive(Debug, Clone, PartialEq)]
pub struct Frame {
    /// Image width `[px]`.
    pub width: u32,
    /// Image height `[px]`.
    pub height: u32,
    /// sRGB colour and straight alpha, which is coverage. Shape: `[height, width, 4]`.
    pub rgba: Vec<u8>,
    /// Camera z of the first surface with alpha of at least 0.5, through the pixel's centre; 0
    /// where there is none. Shape: `[height, width]`.
    pub depth: Vec<f32>,
    /// Its geometric normal in the world, unit length, towards the camera; zero where there is
    /// none. Shape: `[height, width]`.
    pub normals: Vec<[f32; 3]>,
    /// Its triangle's number in the model; `u32::MAX` where there is none. Shape:
    /// `[height, width]`.
    pub triangles: Vec<u32>,
}

/// Renders views of one scene.
pub(crate) struct Tracer<'a> {
    pub(crate) surface: &'a Surface,
    pub(crate) model: &'a Model,
    pub(crate) traits: &'a [Traits],
    pub(crate) lighting: &'a Lighting,
    /// Factor on all radiance before it is encoded.
    pub(crate) exposure: f32,
    pub(crate) seed: u64,
}

impl Frame {
    fn empty(width: u32, height: u32) -> Self {
        let pixels = width as usize * height as usize;
        Self {
            width,
            height,
            rgba: vec![0; 4 * pixels],
            depth: vec![0.0; pixels],
            normals: vec![[0.0; 3]; pixels],
            triangles: vec![u32::MAX; pixels],
        }
    }
}

impl Tracer<'_> {
    /// Renders view number `view`, which only seeds its random numbers.
    pub(crate) fn render(&self, camera: &Camera, view: u64) -> Frame {
        let mut frame = Frame::empty(camera.width, camera.height);
        let row = camera.width as usize;
        let bands = frame
            .rgba
            .par_chunks_mut(4 * BAND * row)
            .zip(frame.depth.par_chunks_mut(BAND * row))
            .zip(frame.normals.par_chunks_mut(BAND * row))
            .zip(frame.triangles.par_chunks_mut(BAND * row));
        bands.enumerate().for_each(|(band, (((rgba, depth), normals), triangles))| {
            for i in 0..depth.len() {
                let (x, y) = (i % row, band * BAND + i / row);
                let pixel = DVec2::new(x as f64, y as f64);
                let draws = Draws::new(self.seed, &[view, (y * row + x) as u64]);
                rgba[4 * i..4 * i + 4].copy_from_slice(&self.pixel(camera, pixel, draws));
                let direction = camera.direction(pixel + 0.5);
                if let Some(first) = self.first_solid(camera.centre, direction) {
                    depth[i] = first.0 as f32;
                    normals[i] = first.1.as_vec3().to_array();
                    triangles[i] = first.2;
                }
            }
        });
        frame
    }

    fn matter(&self) -> Matter<'_> {
        Matter { surface: self.surface, model: self.model, traits: self.traits }
    }

    /// Colour and alpha of a pixel, whose upper left corner is at `corner`.
    fn pixel(&self, camera: &Camera, corner: DVec2, draws: Draws) -> [u8; 4] {
        let grid = self.lighting.grid;
        let (mut colour, mut alpha) = (Vec3::ZERO, 0.0);
        let mut sample = Subsample { index: 0, draws, met: None, hid: None };
        // Width of a subsample at depth 1.
        let spread = 1.0 / (camera.fx * f64::from(grid)) as f32;
        for index in 0..grid * grid {
            sample.index = index;
            let place = stratum(index, grid, sample.draws.square());
            let direction = camera.direction(corner + place.as_dvec2());
            let (c, a) = self.through(camera.centre, direction, spread, &mut sample);
            colour += c;
            alpha += a;
        }
        if alpha <= 0.0 {
            return [0; 4];
        }
        let straight = colour * (self.exposure / alpha);
        let coverage = alpha / (grid * grid) as f32;
        let a = (coverage.clamp(0.0, 1.0) * 255.0 + 0.5) as u8;
        [encode(straight.x), encode(straight.y), encode(straight.z), a]
    }

    /// Colour, weighted with alpha, and alpha along a ray.
    fn through(
        &self,
        origin: DVec3,
        direction: DVec3,
        spread: f32,
        sample: &mut Subsample,
    ) -> (Vec3, f32) {
        let (mut colour, mut transmittance) = (Vec3::ZERO, 1.0);
        let matter = self.matter();
        self.layers(origin, direction, sample.met, |ray, hit, entry| {
            sample.met = Some(hit.slot);
            let width = (hit.at.t + entry) * spread;
            let (point, alpha) = Point::read(&matter, ray, &hit, width);
            if alpha > 0.0 {
                let view = -ray.direction;
                let radiance = self.lighting.radiance(&matter, &point, view, sample);
                colour += transmittance * alpha * radiance;
                transmittance *= 1.0 - alpha;
            }
            transmittance > MIN_TRANSMITTANCE
        });
        if transmittance <= MIN_TRANSMITTANCE {
            transmittance = 0.0;
        }
        (colour, 1.0 - transmittance)
    }

    /// Depth, normal and triangle of the first surface with alpha of at least one half.
    pub(crate) fn first_solid(&self, origin: DVec3, direction: DVec3) -> Option<(f64, DVec3, u32)> {
        let matter = self.matter();
        let mut first = None;
        self.layers(origin, direction, None, |ray, hit, _| {
            let (_, alpha) = Point::read(&matter, ray, &hit, 0.0);
            if alpha >= 0.5 {
                let hit = self.surface.describe(origin, direction, hit);
                let normal = if hit.normal.dot(direction) > 0.0 { -hit.normal } else { hit.normal };
                first = Some((hit.t, normal, hit.triangle));
            }
            first.is_none()
        });
        first
    }

    /// Visits the visible surfaces along a ray, front to back, while `go_on` says so. The third
    /// argument is the distance at which the ray's parameter starts, local units.
    fn layers(
        &self,
        origin: DVec3,
        direction: DVec3,
        hint: Option<u32>,
        mut go_on: impl FnMut(&LocalRay, LocalHit, f32) -> bool,
    ) {
        let Some(ray) = self.surface.enter(origin, direction, f64::INFINITY) else {
            return;
        };
        let entry = (ray.origin.as_dvec3() - self.surface.to_local(origin)).length() as f32;
        let matter = self.matter();
        let mut after = None;
        for _ in 0..MAX_LAYERS {
            let visible = |slot, at: &Meeting| matter.is_visible(slot, at);
            let hit = self.surface.closest(&ray, after, hint, visible);
            let Some(hit) = hit else {
                return;
            };
            if !go_on(&ray, hit, entry) || self.traits.is_empty() {
                return;
            }
            after = Some((hit.at.t, self.surface.triangle_of(hit.slot)));
        }
    }
}

/// Mean radiance of a pixel grid over a view, for choosing an exposure: one ray per `step` pixels.
pub(crate) fn luminances(tracer: &Tracer<'_>, camera: &Camera, step: u32) -> Vec<f32> {
    let mut all = Vec::new();
    for y in (0..camera.height).step_by(step as usize) {
        for x in (0..camera.width).step_by(step as usize) {
            let mut sample = Subsample {
                index: 0,
                draws: Draws::new(tracer.seed, &[u64::from(x), u64::from(y)]),
                met: None,
                hid: None,
            };
            let corner = DVec2::new(f64::from(x), f64::from(y));
            let direction = camera.direction(corner + Vec2::splat(0.5).as_dvec2());
            let (c, a) = tracer.through(camera.centre, direction, 0.0, &mut sample);
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
