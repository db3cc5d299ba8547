//! Measures depth, normals and thin structures in the pixels of the views.

use std::collections::BTreeMap;

use glam::{DVec2, DVec3, Vec3};
use rayon::prelude::*;

use super::rows::{Finder, Rows};
use super::{DepthErrors, KnownScene, ThinRecall, ratio};
use crate::metrics::EvaluateError;
use densify_core::image::Image8;
use densify_data::views::ViewSource;
use densify_render::{Backend, Rendering};

/// Alpha above which a pixel is covered.
const COVERED: f32 = 0.5;
/// Maximum number of pixels of a view whose normals are compared.
const NORMALS: usize = 2000;
/// Largest depth error of a thin structure, in addition to its thickness `[fraction of the depth]`.
const DEPTH_SLACK: f64 = 0.01;
/// Largest colour error of a thin structure, mean over channels.
const COLOUR_SLACK: f32 = 0.1;

/// Sums over the pixels.
pub(super) struct Pixels<'a> {
    rows: &'a Rows,
    ground: &'a KnownScene<'a>,
    finder: Finder,
    surface: usize,
    covered: usize,
    squares: f64,
    relative: f64,
    /// Angles between normals `[degrees]`.
    angles: Vec<f64>,
    /// Numbers of pixels and of found pixels, by the base-2 logarithm of the width.
    thin: BTreeMap<i32, (usize, usize)>,
}

impl<'a> Pixels<'a> {
    pub(super) fn new(rows: &'a Rows, ground: &'a KnownScene<'a>) -> Result<Self, EvaluateError> {
        Ok(Self {
            rows,
            ground,
            finder: Finder::new(rows),
            surface: 0,
            covered: 0,
            squares: 0.0,
            relative: 0.0,
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
        let ground = self.ground;
        let name = views.name(view);
        let (_, caster) = ground.cameras(views.camera(view));
        let g_buffer = ground.g_buffer(name, &caster)?;
        let rendering = backend
            .render(views.camera(view), ground.background, ground.sh_degree)
            .map_err(|source| EvaluateError::Backend { view: name.to_owned(), source })?;
        let width = g_buffer.width as usize;
        let at = |i: usize| DVec2::new((i % width) as f64, (i / width) as f64) + 0.5;
        let shown: Vec<usize> =
            (0..g_buffer.depth.len()).filter(|&i| g_buffer.depth[i] > 0.0).collect();
        self.surface += shown.len();
        for &i in &shown {
            if let Some(depth) = depth_at(&rendering, i, ground.normalisation.scale) {
                let truth = f64::from(g_buffer.depth[i]);
                self.covered += 1;
                self.squares += (depth - truth) * (depth - truth);
                self.relative += (depth - truth).abs() / truth;
            }
        }
        let covered: Vec<usize> =
            shown.iter().copied().filter(|&i| rendering.alpha[i] > COVERED).collect();
        let step = covered.len().div_ceil(NORMALS).max(1);
        let (rows, finder) = (self.rows, &self.finder);
        let angles = covered.par_iter().step_by(step).filter_map(|&i| {
            let place = caster.centre + f64::from(g_buffer.depth[i]) * caster.direction(at(i));
            let truth = Vec3::from(g_buffer.normals[i]).as_dvec3();
            let normal = finder.normal(rows, place)?;
            Some(angle(normal, truth))
        });
        let angles: Vec<f64> = angles.collect();
        self.angles.extend(angles);
        if ground.truth.has_thin() {
            let source = |source| EvaluateError::View { view: name.to_owned(), source };
            let image = views.image(view).map_err(source)?;
            let KnownScene { truth, normalisation, background, .. } = *ground;
            let thin_pixels: Vec<(i32, bool)> = shown
                .par_iter()
                .filter_map(|&i| {
                    let depth = f64::from(g_buffer.depth[i]);
                    let thickness =
                        truth.thickness(caster.centre, caster.direction(at(i)), depth)?;
                    let octave = (thickness * caster.fx / depth).log2().round() as i32;
                    let slack = thickness + DEPTH_SLACK * depth;
                    let right = depth_at(&rendering, i, normalisation.scale)
                        .is_some_and(|rendered| (rendered - depth).abs() < slack);
                    let found =
                        right && colour_error(&rendering, &image, i, background) < COLOUR_SLACK;
                    Some((octave, found))
                })
                .collect();
            for (octave, found) in thin_pixels {
                let (pixels, hits) = self.thin.entry(octave).or_default();
                *pixels += 1;
                *hits += usize::from(found);
            }
        }
        Ok(())
    }

    pub(super) fn depth(&self) -> DepthErrors {
        let covered = self.covered as f64;
        DepthErrors {
            rmse: ratio(self.squares, covered).sqrt() / self.ground.diagonal(),
            abs_rel: ratio(self.relative, covered),
            coverage: ratio(covered, self.surface as f64),
        }
    }

    /// The upper median of the angles.
    pub(super) fn normal_error(&self) -> f64 {
        let mut angles = self.angles.clone();
        angles.sort_by(f64::total_cmp);
        angles.get(angles.len() / 2).copied().unwrap_or(f64::NAN)
    }

    pub(super) fn thin(&self) -> Vec<ThinRecall> {
        let recall = |(&octave, &(pixels, hits)): (&i32, &(usize, usize))| ThinRecall {
            width: f64::from(octave).exp2(),
            pixels,
            recall: ratio(hits as f64, pixels as f64),
        };
        self.thin.iter().map(recall).collect()
    }
}

/// Rendered depth of a covered pixel `[world units]`.
fn depth_at(rendering: &Rendering, pixel: usize, scale: f64) -> Option<f64> {
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
    let off = |c: usize| (rendering.rgb[3 * pixel + c].clamp(0.0, 1.0) - truth[c]).abs();
    (off(0) + off(1) + off(2)) / 3.0
}
