//! Measures depth, normals and thin structures in the pixels of the views.

use std::collections::BTreeMap;

use glam::{DVec2, DVec3, Vec3};
use rayon::prelude::*;

use super::rows::{Rows, SolidRows};
use super::visibility::{Shown, shown, weights};
use super::{DepthErrors, KnownScene, ThinRecall, ratio};
use crate::metrics::EvaluateError;
use densify_core::image::Image8;
use densify_data::views::ViewSource;
use densify_render::{Backend, Rendering};

/// Alpha above which a pixel counts as covered.
const COVERED: f32 = 0.5;
/// Maximum number of pixels per view in which normals are compared.
const MAX_NORMALS: usize = 2000;
/// Depth error allowed in a found pixel of a thin structure, in addition to the thickness `[fraction of the depth]`.
const DEPTH_SLACK: f64 = 0.01;
/// Colour error allowed in a found pixel of a thin structure, mean over channels, in `[0, 1]`.
const COLOUR_SLACK: f32 = 0.1;

/// Sums over the pixels of the views added so far.
pub(super) struct Pixels<'a> {
    rows: &'a Rows,
    scene: &'a KnownScene<'a>,
    solid: SolidRows,
    surface_pixels: usize,
    covered_pixels: usize,
    squared_errors: f64,
    relative_errors: f64,
    /// Sum of w·(z − depth)² `[world units²]`, and of the weights w.
    spread: (f64, f64),
    /// Angles between normals `[degrees]`.
    angles: Vec<f64>,
    /// Numbers of all pixels and of found pixels, by the rounded base-2 logarithm of the structure's width `[px]`.
    thin: BTreeMap<i32, (usize, usize)>,
}

impl<'a> Pixels<'a> {
    pub(super) fn new(rows: &'a Rows, scene: &'a KnownScene<'a>) -> Result<Self, EvaluateError> {
        Ok(Self {
            rows,
            scene,
            solid: SolidRows::new(rows),
            surface_pixels: 0,
            covered_pixels: 0,
            squared_errors: 0.0,
            relative_errors: 0.0,
            spread: (0.0, 0.0),
            angles: Vec::new(),
            thin: BTreeMap::new(),
        })
    }

    /// Renders a view and adds its pixels.
    pub(super) fn add(
        &mut self,
        backend: &mut dyn Backend,
        views: &impl ViewSource,
        view: usize,
    ) -> Result<(), EvaluateError> {
        let scene = self.scene;
        let name = views.name(view);
        let camera = views.camera(view);
        let (world, ray_camera) = scene.cameras(camera);
        let g_buffer = scene.g_buffer(name, &ray_camera)?;
        let failed = |source| EvaluateError::Backend { view: name.to_owned(), source };
        let weights = weights(backend, camera).map_err(failed)?;
        let rendering =
            backend.render(camera, scene.background, scene.sh_degree).map_err(failed)?;
        for Shown { weight, depth, pixel } in shown(self.rows, &weights, &world) {
            if let Some(rendered) = depth_at(&rendering, pixel, scene.normalisation.scale) {
                self.spread.0 += weight * (depth - rendered) * (depth - rendered);
                self.spread.1 += weight;
            }
        }
        let width = g_buffer.width as usize;
        let at = |i: usize| DVec2::new((i % width) as f64, (i / width) as f64) + 0.5;
        let shown: Vec<usize> =
            (0..g_buffer.depth.len()).filter(|&i| g_buffer.depth[i] > 0.0).collect();
        self.surface_pixels += shown.len();
        for &i in &shown {
            if let Some(depth) = depth_at(&rendering, i, scene.normalisation.scale) {
                let truth = f64::from(g_buffer.depth[i]);
                self.covered_pixels += 1;
                self.squared_errors += (depth - truth) * (depth - truth);
                self.relative_errors += (depth - truth).abs() / truth;
            }
        }
        let covered: Vec<usize> =
            shown.iter().copied().filter(|&i| rendering.alpha[i] > COVERED).collect();
        let step = covered.len().div_ceil(MAX_NORMALS).max(1);
        let (rows, solid) = (self.rows, &self.solid);
        let angles = covered.par_iter().step_by(step).filter_map(|&i| {
            let place =
                ray_camera.centre + f64::from(g_buffer.depth[i]) * ray_camera.direction(at(i));
            let truth = Vec3::from(g_buffer.normals[i]).as_dvec3();
            Some(angle(solid.normal(rows, place)?, truth))
        });
        let angles: Vec<f64> = angles.collect();
        self.angles.extend(angles);
        if scene.truth.has_thin() {
            let source = |source| EvaluateError::View { view: name.to_owned(), source };
            let image = views.image(view).map_err(source)?;
            let KnownScene { truth, normalisation, background, .. } = *scene;
            let thin_pixels: Vec<(i32, bool)> = shown
                .par_iter()
                .filter_map(|&i| {
                    let depth = f64::from(g_buffer.depth[i]);
                    let thickness =
                        truth.thickness(ray_camera.centre, ray_camera.direction(at(i)), depth)?;
                    let octave = (thickness * ray_camera.fx / depth).log2().round() as i32;
                    let slack = thickness + DEPTH_SLACK * depth;
                    let is_close = depth_at(&rendering, i, normalisation.scale)
                        .is_some_and(|rendered| (rendered - depth).abs() < slack);
                    let is_found =
                        is_close && colour_error(&rendering, &image, i, background) < COLOUR_SLACK;
                    Some((octave, is_found))
                })
                .collect();
            for (octave, is_found) in thin_pixels {
                let (pixels, found) = self.thin.entry(octave).or_default();
                *pixels += 1;
                *found += usize::from(is_found);
            }
        }
        Ok(())
    }

    pub(super) fn depth(&self) -> DepthErrors {
        let covered = self.covered_pixels as f64;
        DepthErrors {
            rmse: ratio(self.squared_errors, covered).sqrt() / self.scene.diagonal(),
            abs_rel: ratio(self.relative_errors, covered),
            coverage: ratio(covered, self.surface_pixels as f64),
            spread: ratio(self.spread.0, self.spread.1).sqrt() / self.scene.diagonal(),
        }
    }

    /// The upper median of the angles.
    pub(super) fn normal_error(&self) -> f64 {
        let mut angles = self.angles.clone();
        angles.sort_by(f64::total_cmp);
        angles.get(angles.len() / 2).copied().unwrap_or(f64::NAN)
    }

    pub(super) fn thin(&self) -> Vec<ThinRecall> {
        let recall = |(&octave, &(pixels, found)): (&i32, &(usize, usize))| ThinRecall {
            width: f64::from(octave).exp2(),
            pixels,
            recall: ratio(found as f64, pixels as f64),
        };
        self.thin.iter().map(recall).collect()
    }
}

/// Rendered depth of a pixel `[world units]`; `None` if the pixel is not covered.
pub(super) fn depth_at(rendering: &Rendering, pixel: usize, scale: f64) -> Option<f64> {
    let alpha = rendering.alpha[pixel];
    (alpha > COVERED).then(|| f64::from(rendering.depth[pixel]) / f64::from(alpha) / scale)
}

/// Angle between two lines, in 0..=90 `[degrees]`.
fn angle(a: DVec3, b: DVec3) -> f64 {
    a.cross(b).length().atan2(a.dot(b).abs()).to_degrees()
}

fn colour_error(rendering: &Rendering, image: &Image8, pixel: usize, background: [f32; 3]) -> f32 {
    let width = rendering.width as usize;
    let truth = image.composited(pixel % width, pixel / width, background);
    let error = |c: usize| (rendering.rgb[3 * pixel + c].clamp(0.0, 1.0) - truth[c]).abs();
    (error(0) + error(1) + error(2)) / 3.0
}
