//! Measures the blend weights of rows in the training views, and finds the rows in empty space.

use densify_policies::policy::{AuxColumn, AuxRequest};
use densify_scenegen::GBuffer;
use glam::DVec3;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng, SeedableRng};
use rayon::prelude::*;

use super::rows::Rows;
use super::{Floaters, KnownScene, Redundancy, needs, ratio};
use crate::metrics::EvaluateError;
use densify_core::camera::Camera;
use densify_core::image::Image8;
use densify_data::views::ViewSource;
use densify_render::{AuxInput, Backend, BackendError};

/// Number of samples on the mesh.
const SAMPLES: usize = 20_000;
const SEED: u64 = 0x6d65_7368;
/// Smallest opacity of a floater.
const MIN_OPACITY: f32 = 0.05;
/// Smallest distance of a floater from the mesh `[diagonals]`.
const MIN_DISTANCE: f64 = 0.01;
/// Share of the surface's depth by which a row must be nearer to lie before the surface.
const BEFORE: f64 = 0.05;
/// Blend weight below which a row has a negligible effect.
const NEGLIGIBLE: f32 = 0.01;
/// Minimum number of views that see through a floater's position, or that see a counted sample of the mesh.
pub(super) const MIN_VIEWS: u32 = 2;

/// Sums over the training views.
pub(super) struct Visibility {
    /// Σ α·T of each row.
    pub(super) weights: Vec<f64>,
    /// Largest α·T of each row.
    peaks: Vec<f32>,
    /// Number of views that see through each row's position.
    seen_through: Vec<u32>,
    /// Numbers of blended (row, pixel) pairs and of pixels.
    blended: (f64, f64),
    /// Weight of rows before the surface, and of all rows.
    before: (f64, f64),
    /// Samples of the mesh that are visible in enough views.
    pub(super) samples: Vec<DVec3>,
}

impl Visibility {
    pub(super) fn measure(
        backend: &mut dyn Backend,
        scene: &KnownScene<'_>,
        rows: &Rows,
        views: &impl ViewSource,
    ) -> Result<Self, EvaluateError> {
        let mut samples: Vec<(DVec3, u32)> =
            sample(&scene.truth.surface().triangles()).into_iter().map(|p| (p, 0)).collect();
        let mut visibility = Self {
            weights: vec![0.0; rows.len()],
            peaks: vec![0.0; rows.len()],
            seen_through: vec![0; rows.len()],
            blended: (0.0, 0.0),
            before: (0.0, 0.0),
            samples: Vec::new(),
        };
        let request = needs().aux.unwrap_or_default();
        for number in 0..views.count() {
            let name = views.name(number);
            let failed = |source| EvaluateError::Backend { view: name.to_owned(), source };
            let camera = views.camera(number);
            let weights = visibility.add_weights(backend, camera, &request);
            let weights = weights.map_err(failed)?;
            let (world, ray_camera) = scene.cameras(camera);
            let g_buffer = scene.g_buffer(name, &ray_camera)?;
            visibility.add_depths(rows, &weights, &world, &g_buffer);
            let places = visibility.seen_through.par_iter_mut().zip(&rows.centres);
            places.for_each(|(seen_through, &place)| {
                *seen_through += u32::from(sees_through(&world, &g_buffer, place));
            });
            let surface = scene.truth.surface();
            let undecided = samples.par_iter_mut().filter(|(_, views)| *views < MIN_VIEWS);
            undecided.for_each(|(at, views)| {
                let (pixel, depth) = ray_camera.project(*at);
                let is_shown = depth > 0.0 && ray_camera.contains(pixel);
                *views += u32::from(is_shown && !surface.blocked(ray_camera.centre, *at));
            });
        }
        let enough = samples.into_iter().filter(|(_, views)| *views >= MIN_VIEWS);
        visibility.samples = enough.map(|(place, _)| place).collect();
        Ok(visibility)
    }

    /// Compares the depths of the rows that one view shows with the surface.
    fn add_depths(&mut self, rows: &Rows, weights: &[f32], camera: &Camera, g_buffer: &GBuffer) {
        for Shown { weight, depth, pixel } in shown(rows, weights, camera) {
            let surface = f64::from(g_buffer.depth[pixel]);
            self.before.1 += weight;
            if surface > 0.0 && depth < (1.0 - BEFORE) * surface {
                self.before.0 += weight;
            }
        }
    }

    /// See [`Geometry::weight_before_surface`](super::Geometry::weight_before_surface).
    pub(super) fn before_surface(&self) -> f64 {
        ratio(self.before.0, self.before.1)
    }

    /// Adds the blend weights of one view, and returns them. Shape: `[rows]`.
    fn add_weights(
        &mut self,
        backend: &mut dyn Backend,
        camera: &Camera,
        request: &AuxRequest,
    ) -> Result<Vec<f32>, BackendError> {
        let mut weights = Vec::new();
        for (column, values) in observed(backend, camera, request)? {
            let numbers = values.iter().map(|&value| f64::from(value));
            match column {
                AuxColumn::WeightSum => {
                    self.weights.iter_mut().zip(numbers).for_each(|(sum, value)| *sum += value);
                    weights = values;
                }
                AuxColumn::WeightMax => {
                    let peaks = self.peaks.iter_mut().zip(values);
                    peaks.for_each(|(peak, value)| *peak = peak.max(value));
                }
                AuxColumn::PixelCount => self.blended.0 += numbers.sum::<f64>(),
                _ => {}
            }
        }
        self.blended.1 += f64::from(camera.width) * f64::from(camera.height);
        Ok(weights)
    }

    /// True for a floater, by the definition of [`Floaters`].
    fn is_floater(&self, rows: &Rows, row: usize, diagonal: f64) -> bool {
        let min_distance = (MIN_DISTANCE * diagonal).max(2.0 * rows.scales[row].max_element());
        rows.opacities[row] > MIN_OPACITY
            && rows.distances[row] > min_distance
            && self.seen_through[row] >= MIN_VIEWS
    }

    pub(super) fn floaters(&self, rows: &Rows, diagonal: f64) -> Floaters {
        let all: Vec<usize> =
            (0..rows.len()).filter(|&row| self.is_floater(rows, row, diagonal)).collect();
        let weight: f64 = all.iter().map(|&row| self.weights[row]).sum();
        Floaters {
            count: all.len(),
            of_rows: ratio(all.len() as f64, rows.len() as f64),
            of_weight: ratio(weight, self.weights.iter().sum()),
        }
    }

    pub(super) fn redundancy(&self) -> Redundancy {
        let negligible = self.peaks.iter().filter(|&&peak| peak < NEGLIGIBLE).count();
        Redundancy {
            blended_per_pixel: ratio(self.blended.0, self.blended.1),
            below_one_percent: ratio(negligible as f64, self.peaks.len() as f64),
        }
    }
}

/// The requested columns of a view.
fn observed(
    backend: &mut dyn Backend,
    camera: &Camera,
    request: &AuxRequest,
) -> Result<Vec<(AuxColumn, Vec<f32>)>, BackendError> {
    let black = Image8::black(camera.width, camera.height);
    let output = backend.observe(&AuxInput::of_rows(camera, &black, request))?;
    Ok(output.columns)
}

/// The blend weights of one view. Shape: `[rows]`.
pub(super) fn weights(
    backend: &mut dyn Backend,
    camera: &Camera,
) -> Result<Vec<f32>, BackendError> {
    let columns = observed(backend, camera, &needs().aux.unwrap_or_default())?;
    let sums = columns.into_iter().find(|(column, _)| *column == AuxColumn::WeightSum);
    Ok(sums.map(|(_, sums)| sums).unwrap_or_default())
}

/// A row that a view shows.
pub(super) struct Shown {
    /// Σ α·T in the view.
    pub(super) weight: f64,
    /// Camera z of the centre `[world units]`.
    pub(super) depth: f64,
    /// Index of the pixel of the centre, or of the nearest pixel.
    pub(super) pixel: usize,
}

/// The rows with a weight in a view, and with a centre in front of its camera.
pub(super) fn shown<'a>(
    rows: &'a Rows,
    weights: &'a [f32],
    camera: &'a Camera,
) -> impl Iterator<Item = Shown> + 'a {
    let last = |side: u32| f64::from(side.max(1) - 1);
    let (right, bottom) = (last(camera.width), last(camera.height));
    weights.iter().zip(&rows.centres).filter_map(move |(&weight, &place)| {
        let (pixel, depth) = camera.project(place);
        if weight <= 0.0 || depth <= 0.0 || !pixel.is_finite() {
            return None;
        }
        let (x, y) = (pixel.x.clamp(0.0, right) as usize, pixel.y.clamp(0.0, bottom) as usize);
        Some(Shown { weight: f64::from(weight), depth, pixel: y * camera.width as usize + x })
    })
}

/// True if a view sees through a point, to a surface behind it or to the background.
fn sees_through(camera: &Camera, g_buffer: &GBuffer, place: DVec3) -> bool {
    let (pixel, depth) = camera.project(place);
    let (width, height) = (f64::from(g_buffer.width), f64::from(g_buffer.height));
    let on_image = (0.0..width).contains(&pixel.x) && (0.0..height).contains(&pixel.y);
    if !(depth > 0.0 && on_image) {
        return false;
    }
    let shown = g_buffer.depth[pixel.y as usize * g_buffer.width as usize + pixel.x as usize];
    shown <= 0.0 || depth < f64::from(shown)
}

/// Samples of uniform density on the triangles, in the order of the triangles.
pub(super) fn sample(triangles: &[[DVec3; 3]]) -> Vec<DVec3> {
    let area = |[a, b, c]: &[DVec3; 3]| 0.5 * (*b - *a).cross(*c - *a).length();
    let total: f64 = triangles.iter().map(area).sum();
    if !(total > 0.0 && total.is_finite()) {
        return Vec::new();
    }
    let mut rng = ChaCha8Rng::seed_from_u64(SEED);
    let mut unit = move || (rng.next_u64() >> 11) as f64 / (1_u64 << 53) as f64;
    let mut points = Vec::with_capacity(SAMPLES);
    let (mut at, mut end) = (0, area(&triangles[0]));
    for stratum in 0..SAMPLES {
        let place = (stratum as f64 + unit()) / SAMPLES as f64 * total;
        while place >= end && at + 1 < triangles.len() {
            at += 1;
            end += area(&triangles[at]);
        }
        let [a, b, c] = triangles[at];
        let (root, v) = (unit().sqrt(), unit());
        points.push(a + root * ((1.0 - v) * (b - a) + v * (c - a)));
    }
    points
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn samples_lie_on_the_triangles_with_uniform_density() {
        // A triangle of area 3 in z = 0, one of area 0, and one of area 1 in z = 1.
        let first = [DVec3::ZERO, 3.0 * DVec3::X, 2.0 * DVec3::Y];
        let line = [DVec3::ZERO, DVec3::X, 2.0 * DVec3::X];
        let second = [DVec3::Z, DVec3::Z + DVec3::X, DVec3::Z + 2.0 * DVec3::Y];
        let points = sample(&[first, line, second]);
        assert_eq!(points.len(), SAMPLES);
        let low = points.iter().filter(|p| p.z < 0.5).count();
        assert!(low.abs_diff(SAMPLES * 3 / 4) <= 1, "{low}");
        let mut mean = DVec3::ZERO;
        for p in points.iter().filter(|p| p.z < 0.5) {
            assert!(p.x >= 0.0 && p.y >= 0.0 && p.x / 3.0 + p.y / 2.0 <= 1.0 + 1e-9, "{p}");
            mean += *p / low as f64;
        }
        assert!(mean.distance(DVec3::new(1.0, 2.0 / 3.0, 0.0)) < 0.03, "{mean}");
        assert_eq!(points, sample(&[first, line, second]));
        assert!(sample(&[line]).is_empty());
    }
}
