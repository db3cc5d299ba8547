//! Initial points like those of structure-from-motion, with errors of known size.
//!
//! Candidates are pixels of training views, sampled in proportion to the local gradient of luminance, because
//! feature matching finds nothing in flat regions. A candidate is used if at least three training views see it.

use glam::{DVec2, DVec3};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::camera::Camera;
use crate::random::Draws;
use crate::trace::{Frame, Tracer};

/// Smallest number of views that must see a point.
const MIN_VIEWS: usize = 3;
/// Candidates per requested point, as some are seen by fewer than three views.
const CANDIDATES: f64 = 2.0;
/// Added to every pixel's gradient: half a step of eight bits.
const GRADIENT_FLOOR: f64 = 0.5;
/// Side of the cubes that are dropped as a whole, as a share of the scene's diagonal.
const PATCH: f64 = 0.02;
/// Largest relative difference between a point's depth and the visible depth at which a view sees the point.
const SAME_DEPTH: f64 = 1e-3;

/// Number and errors of initial points.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct PointOptions {
    /// Number of points; fewer if the views do not see enough.
    pub count: usize,
    /// Standard deviation of the noise on each coordinate, as a share of the scene's diagonal.
    pub noise: f64,
    /// Share of points that are placed at random in the bounding box enlarged by a fifth.
    pub outliers: f64,
    /// Share of space without points. Space is divided into cubes with sides of 2 % of the diagonal.
    pub dropout: f64,
    /// If true, thin structures yield no points.
    pub without_thin: bool,
}

impl Default for PointOptions {
    fn default() -> Self {
        Self { count: 5000, noise: 1e-3, outliers: 0.02, dropout: 0.0, without_thin: false }
    }
}

/// Points to start training from.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct InitPoints {
    /// World positions. Shape: `[points]`.
    pub positions: Vec<DVec3>,
    /// sRGB colours. Shape: `[points]`.
    pub colours: Vec<[u8; 3]>,
    /// World positions on the surface, from which `positions` differ by noise or, for outliers, by a displacement.
    /// Image features are projections of these. Shape: `[points]`.
    pub found_at: Vec<DVec3>,
    /// Indices of the training views that see each point of `found_at` and have its point of `positions` in front of
    /// their camera, ascending. Shape: `[points]`.
    pub seen_by: Vec<Vec<u32>>,
    /// Number of outliers.
    pub outliers: usize,
}

struct Candidate {
    /// Random number by which candidates are sorted.
    order: u64,
    position: DVec3,
    colour: [u8; 3],
}

/// Collects candidates from training views as they are rendered.
pub struct PointCollector<'a> {
    tracer: Tracer<'a>,
    cameras: &'a [Camera],
    options: PointOptions,
    bounds: (DVec3, DVec3),
    candidates: Vec<Candidate>,
}

impl<'a> PointCollector<'a> {
    pub(crate) fn new(tracer: Tracer<'a>, cameras: &'a [Camera], options: PointOptions) -> Self {
        let bounds = tracer.surface.bounds();
        Self { tracer, cameras, options, bounds, candidates: Vec::new() }
    }

    /// Samples candidates from training view `view`.
    pub fn observe(&mut self, view: usize, frame: &Frame) {
        if self.options.count == 0 {
            return;
        }
        let camera = &self.cameras[view];
        let wanted = self.options.count as f64 * CANDIDATES / self.cameras.len() as f64;
        let weights = self.weights(frame);
        let total: f64 = weights.iter().sum();
        if total <= 0.0 {
            return;
        }
        let mut draws = Draws::new(self.tracer.seed, &[0x706f_696e_7473, view as u64]);
        // Systematic sampling: one candidate per equal share of the total weight.
        let step = total / wanted.ceil();
        let mut next = step * draws.unit64();
        let mut sum = 0.0;
        for (pixel, weight) in weights.iter().enumerate() {
            sum += weight;
            while next < sum {
                next += step;
                let (x, y) = (pixel % frame.width as usize, pixel / frame.width as usize);
                let direction = camera.direction(DVec2::new(x as f64 + 0.5, y as f64 + 0.5));
                let position = camera.centre + f64::from(frame.depth[pixel]) * direction;
                let rgba = &frame.rgba[4 * pixel..4 * pixel + 4];
                let colour = [rgba[0], rgba[1], rgba[2]];
                self.candidates.push(Candidate { order: draws.bits(), position, colour });
            }
        }
    }

    /// The sampling weight of each pixel.
    fn weights(&self, frame: &Frame) -> Vec<f64> {
        let (width, height) = (frame.width as usize, frame.height as usize);
        let luminance = |i: usize| {
            let c = &frame.rgba[4 * i..4 * i + 3];
            0.299 * f64::from(c[0]) + 0.587 * f64::from(c[1]) + 0.114 * f64::from(c[2])
        };
        // A silhouette is not a feature of the surface.
        let solid = |i: usize| frame.depth[i] > 0.0 && frame.rgba[4 * i + 3] == 255;
        let slope = |i: usize, before: Option<usize>, after: Option<usize>| {
            let before = before.filter(|&j| solid(j)).unwrap_or(i);
            let after = after.filter(|&j| solid(j)).unwrap_or(i);
            luminance(after) - luminance(before)
        };
        let weight = |i: usize| {
            if !solid(i)
                || (self.options.without_thin && self.tracer.model.is_thin(frame.triangles[i]))
            {
                return 0.0;
            }
            let (x, y) = (i % width, i / width);
            let dx = slope(i, (x > 0).then(|| i - 1), (x + 1 < width).then(|| i + 1));
            let dy = slope(i, (y > 0).then(|| i - width), (y + 1 < height).then(|| i + width));
            dx.hypot(dy) + GRADIENT_FLOOR
        };
        (0..width * height).map(weight).collect()
    }

    /// The points of all observed views.
    pub fn finish(mut self) -> InitPoints {
        let PointOptions { count, noise, outliers, .. } = self.options;
        let mut draws = Draws::new(self.tracer.seed, &[0x006e_6f69_7365]);
        let (lo, hi) = self.bounds;
        let diagonal = (hi - lo).length();
        let mut points = InitPoints::default();
        self.candidates.sort_by_key(|candidate| candidate.order);
        let needed = MIN_VIEWS.min(self.cameras.len());
        // Candidates are tested in blocks, so that visibility is computed only until there are enough points.
        for block in self.candidates.chunks(4096) {
            let seen: Vec<Vec<u32>> = block.par_iter().map(|c| self.viewers(c.position)).collect();
            for (candidate, seen) in block.iter().zip(seen) {
                if points.positions.len() < count
                    && seen.len() >= needed
                    && !self.is_dropped(candidate.position, diagonal)
                {
                    points.positions.push(candidate.position);
                    points.colours.push(candidate.colour);
                    points.seen_by.push(seen);
                }
            }
            if points.positions.len() >= count {
                break;
            }
        }
        points.found_at = points.positions.clone();
        for (position, seen) in points.positions.iter_mut().zip(&mut points.seen_by) {
            if draws.unit64() < outliers {
                let share = DVec3::new(draws.unit64(), draws.unit64(), draws.unit64());
                let (lo, hi) = (lo - 0.1 * (hi - lo), hi + 0.1 * (hi - lo));
                *position = lo + share * (hi - lo);
                points.outliers += 1;
            } else if noise > 0.0 {
                let shift = DVec3::new(draws.normal(), draws.normal(), draws.normal());
                *position += noise * diagonal * shift;
            }
            // The shifted point may be behind a camera.
            seen.retain(|&view| self.cameras[view as usize].project(*position).1 > 0.0);
        }
        points
    }

    /// The training views that see a point of a surface.
    fn viewers(&self, point: DVec3) -> Vec<u32> {
        let sees = |camera: &Camera| {
            let (pixel, depth) = camera.project(point);
            if depth <= 0.0 || !camera.contains(pixel) {
                return false;
            }
            let first = self.tracer.first_solid(camera.centre, camera.direction(pixel), None);
            first.is_some_and(|(t, ..)| (t - depth).abs() <= SAME_DEPTH * depth)
        };
        let seen = self.cameras.iter().enumerate().filter(|(_, camera)| sees(camera));
        seen.map(|(i, _)| i as u32).collect()
    }

    fn is_dropped(&self, point: DVec3, diagonal: f64) -> bool {
        let cell = (point / (PATCH * diagonal).max(f64::MIN_POSITIVE)).floor();
        let key = [cell.x, cell.y, cell.z].map(|v| v as i64 as u64);
        Draws::new(self.tracer.seed ^ 0x6472_6f70, &key).unit64() < self.options.dropout
    }
}

#[cfg(test)]
mod tests;
