//! Measures how well Gaussians match the surface that the images were rendered from, where known.
//!
//! The model and the cameras are in normalised coordinates; everything is measured in world
//! coordinates, those of the mesh, in `f64`. Lengths are fractions of the diagonal of the mesh's
//! bounding box. The weight of a row, w, is the sum of its blend weights α·T over all pixels of all
//! training views. Samples have a fixed seed, so that results can be repeated.

mod centres;
mod pixels;
mod rows;
mod visibility;

use densify_policies::policy::{AuxColumn, AuxRequest, Needs, Signal, SignalSet};
use densify_scenegen::{GroundTruth, Sight};
use serde::{Deserialize, Deserializer, Serialize};

use crate::backend::Backend;
use crate::camera::Camera;
use crate::dataset::normalise::Normalisation;
use crate::evaluate::EvaluateError;
use crate::views::ViewSource;
use pixels::Pixels;
use rows::Rows;
use visibility::Visibility;

/// The results. Values without data (no centre, no pixel, no thin structure) are NaN, or `null` in
/// JSON.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Geometry {
    /// Depth on the views measured.
    pub depth: DepthErrors,
    /// Median angle between the surface's normal and the shortest axis of the Gaussian at a pixel
    /// `[degrees]`, in 0..=90. The Gaussian is the densest at the surface point among the eight of
    /// opacity above 0.1 with the nearest centres; it approximates the one with the largest blend
    /// weight. Over the pixels of [`DepthErrors`], on a regular grid of about 2,000 per view.
    #[serde(deserialize_with = "or_nan")]
    pub normal_error: f64,
    /// Distance from centres to surface and back.
    pub centres: CentreErrors,
    /// Rows in empty space.
    pub floaters: Floaters,
    /// Recall of thin structures by width, thinnest first; empty if the scene has none.
    pub thin: Vec<ThinRecall>,
    /// How much is spent on little.
    pub redundancy: Redundancy,
}

/// Rendered depth, Σ α·T·z / Σ α·T, against that of the first surface, over the pixels that show a
/// surface and have a rendered alpha above 0.5.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct DepthErrors {
    /// Root mean square error `[diagonals]`.
    #[serde(deserialize_with = "or_nan")]
    pub rmse: f64,
    /// Mean of |error| / depth.
    #[serde(deserialize_with = "or_nan")]
    pub abs_rel: f64,
    /// Fraction of the pixels showing a surface that have a rendered alpha above 0.5.
    #[serde(deserialize_with = "or_nan")]
    pub coverage: f64,
}

/// Distances between centres and surface. Large Gaussians may well have their centres off it.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct CentreErrors {
    /// Mean distance from centre to mesh, weighted by w `[diagonals]`.
    #[serde(deserialize_with = "or_nan")]
    pub accuracy: f64,
    /// 95th percentile of the distance, weighted by w `[diagonals]`.
    #[serde(deserialize_with = "or_nan")]
    pub accuracy_p95: f64,
    /// Mean distance from the mesh to the nearest centre of opacity above 0.1 `[diagonals]`. Over
    /// those of 20,000 uniform samples of the mesh that at least two training views see.
    #[serde(deserialize_with = "or_nan")]
    pub completeness: f64,
    /// Accuracy + completeness `[diagonals]`.
    #[serde(deserialize_with = "or_nan")]
    pub chamfer: f64,
    /// Harmonic mean of precision (fraction of the weight w within 0.5 % of the diagonal from the
    /// mesh) and recall (fraction of the samples within that of a centre), in 0..=1.
    #[serde(deserialize_with = "or_nan")]
    pub f_score_half_percent: f64,
    /// The same at 1 %.
    #[serde(deserialize_with = "or_nan")]
    pub f_score_one_percent: f64,
}

/// Rows of opacity above 0.05 whose distance from the mesh exceeds 1 % of the diagonal and twice their
/// largest standard deviation, at a place that is empty in at least two training views: their first
/// surface is farther away, or there is none.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Floaters {
    /// Their number.
    pub count: usize,
    /// Fraction of the rows.
    #[serde(deserialize_with = "or_nan")]
    pub of_rows: f64,
    /// Fraction of the weight w.
    #[serde(deserialize_with = "or_nan")]
    pub of_weight: f64,
}

/// Pixels that show a thin structure of about this width. They count as found if alpha is above 0.5,
/// the depth error is below the thickness plus 1 % of the depth, and the colour error, mean over
/// channels, is below 0.1.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct ThinRecall {
    /// Width in the image, to the nearest power of two `[px]`.
    pub width: f64,
    /// Pixels that show one.
    pub pixels: usize,
    /// Fraction of them that are found.
    pub recall: f64,
}

/// How much rows contribute to the training views.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Redundancy {
    /// Mean number of rows blended per pixel.
    #[serde(deserialize_with = "or_nan")]
    pub blended_per_pixel: f64,
    /// Fraction of the rows whose largest blend weight in any pixel of any view is below 0.01.
    #[serde(deserialize_with = "or_nan")]
    pub below_one_percent: f64,
}

/// The scene that a model is measured in.
#[derive(Debug, Clone, Copy)]
pub struct KnownScene<'a> {
    /// The surface.
    pub truth: &'a GroundTruth,
    /// From the coordinates of the surface to those of the model and the cameras.
    pub normalisation: &'a Normalisation,
    /// Background colour of the renders, sRGB-encoded in `[0, 1]`.
    pub background: [f32; 3],
    /// Spherical-harmonic degree evaluated, <= the model's.
    pub sh_degree: u8,
}

/// The needs with which the backend for [`measure`] is made.
#[must_use]
pub fn needs() -> Needs {
    let columns = vec![AuxColumn::WeightSum, AuxColumn::PixelCount];
    Needs {
        signals: SignalSet::default().with(Signal::FreshWeightMax),
        fresh_views: 1,
        aux: Some(AuxRequest { columns, ..AuxRequest::default() }),
        ..Needs::default()
    }
}

/// Measures the model in `backend`, which was made for [`needs`]: weights and visibility in the views
/// trained on; depth, normals and thin structures in `views`.
pub fn measure(
    backend: &mut dyn Backend,
    ground: &KnownScene<'_>,
    train: &impl ViewSource,
    views: &impl ViewSource,
) -> Result<Geometry, EvaluateError> {
    let rows = Rows::new(&backend.download()?, ground);
    let visibility = Visibility::measure(backend, ground, &rows, train)?;
    let mut pixels = Pixels::new(&rows, ground)?;
    for view in 0..views.count() {
        pixels.add(backend, views, view)?;
    }
    Ok(Geometry {
        depth: pixels.depth(),
        normal_error: pixels.normal_error(),
        centres: centres::errors(&rows, &visibility, ground)?,
        floaters: visibility.floaters(&rows, ground.diagonal()),
        thin: pixels.thin(),
        redundancy: visibility.redundancy(),
    })
}

impl KnownScene<'_> {
    /// Diagonal of the mesh's bounding box `[world units]`.
    fn diagonal(&self) -> f64 {
        self.truth.surface().diagonal()
    }

    /// A view's camera in world coordinates, for projecting and for casting rays.
    fn cameras(&self, scene: &Camera) -> (Camera, densify_scenegen::Camera) {
        let world = self.normalisation.world_from_scene_camera(scene);
        let caster = densify_scenegen::Camera {
            width: world.width,
            height: world.height,
            fx: world.fx,
            fy: world.fy,
            cx: world.cx,
            cy: world.cy,
            world_from_camera: world.rotation.transpose(),
            centre: world.centre(),
        };
        (world, caster)
    }

    fn sight(&self, name: &str, caster: &densify_scenegen::Camera) -> Result<Sight, EvaluateError> {
        let sight = self.truth.sight(name, caster);
        sight.map_err(|e| EvaluateError::View { view: name.to_owned(), source: e.into() })
    }
}

/// `sum / count`; NaN if `count` is 0.
fn ratio(sum: f64, count: f64) -> f64 {
    // An empty sum is −0.
    if count > 0.0 { (sum + 0.0) / count } else { f64::NAN }
}

/// JSON has no NaN, and writes it as null.
fn or_nan<'de, D: Deserializer<'de>>(from: D) -> Result<f64, D::Error> {
    Ok(Option::deserialize(from)?.unwrap_or(f64::NAN))
}

#[cfg(test)]
#[allow(clippy::float_cmp, reason = "exact values")]
mod tests;
