//! Measures how well Gaussians match the surface that the images were rendered from, if it is known.
//!
//! The model and the cameras are in normalised coordinates; everything is measured in the world coordinates of the
//! mesh, in `f64`. Lengths are fractions of the diagonal of the mesh's bounding box. The weight w of a row is the sum
//! of its blend weights α·T over all pixels of all training views. Samples have a fixed seed, so that results are
//! reproducible.

mod measure;

use densify_policies::policy::{AuxColumn, AuxRequest, Needs};
use serde::{Deserialize, Deserializer, Serialize};

use densify_data::dataset::GroundTruth;
use densify_data::dataset::normalise::Normalisation;
pub use measure::{MeshErrors, measure, measure_mesh};

/// The measurements. Values without data (no centre, no pixel, no thin structure) are NaN, or `null` in JSON.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Geometry {
    /// Depth errors in the measured views.
    pub depth: DepthErrors,
    /// Median angle between the surface's normal and the shortest axis of the Gaussian at a pixel `[degrees]`, in
    /// 0..=90. Of the eight Gaussians of opacity above 0.1 with the nearest centres, the densest at the surface point
    /// is used, which approximates the Gaussian with the largest blend weight. Measured at up to 2,000 pixels per view,
    /// evenly spaced among those of [`DepthErrors`].
    #[serde(deserialize_with = "or_nan")]
    pub normal_error: f64,
    /// Distances between the centres of Gaussians and the surface.
    pub centres: CentreErrors,
    /// Opaque rows in empty space.
    pub floaters: Floaters,
    /// Fraction of the weight w whose rows lie before the surface: in each training view, the camera z of a row's centre
    /// is compared with the surface's depth at the pixel of the centre (or the nearest pixel), and is more than 5 %
    /// smaller. Unlike [`Floaters`], this counts large and faint rows too.
    #[serde(default = "nan", deserialize_with = "or_nan")]
    pub weight_before_surface: f64,
    /// Recall of thin structures by width, thinnest first; empty if the scene has none.
    pub thin: Vec<ThinRecall>,
    /// Rows with negligible contributions.
    pub redundancy: Redundancy,
}

/// Errors of the rendered depth Σ α·T·z / Σ α·T against the depth of the visible surface, over the pixels that show a
/// surface and have a rendered alpha above 0.5.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct DepthErrors {
    /// Root mean square error `[diagonals]`.
    #[serde(deserialize_with = "or_nan")]
    pub rmse: f64,
    /// Mean of |error| / depth.
    #[serde(deserialize_with = "or_nan")]
    pub abs_rel: f64,
    /// Root mean square distance between the camera z of the rows' centres and the rendered depth at their pixels,
    /// weighted by the rows' blend weights in the view `[diagonals]`: how far the rows that make up a pixel are spread
    /// along its ray.
    #[serde(default = "nan", deserialize_with = "or_nan")]
    pub spread: f64,
    /// Fraction of the pixels showing a surface that have a rendered alpha above 0.5.
    #[serde(deserialize_with = "or_nan")]
    pub coverage: f64,
}

/// Distances between the centres of Gaussians and the surface; those of large Gaussians may legitimately be off it.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct CentreErrors {
    /// Mean distance from centre to mesh, weighted by w `[diagonals]`.
    #[serde(deserialize_with = "or_nan")]
    pub accuracy: f64,
    /// 95th percentile of the distance, weighted by w `[diagonals]`.
    #[serde(deserialize_with = "or_nan")]
    pub accuracy_p95: f64,
    /// Mean distance from the mesh to the nearest centre of opacity above 0.1 `[diagonals]`, over 20,000 uniform
    /// samples of the mesh, except those that fewer than two training views see.
    #[serde(deserialize_with = "or_nan")]
    pub completeness: f64,
    /// Accuracy + completeness `[diagonals]`.
    #[serde(deserialize_with = "or_nan")]
    pub chamfer: f64,
    /// Harmonic mean, in 0..=1, of precision (fraction of the weight w within 0.5 % of the diagonal from the mesh) and
    /// recall (fraction of the samples within that distance from a centre).
    #[serde(deserialize_with = "or_nan")]
    pub f_score_half_percent: f64,
    /// The same harmonic mean, with 1 % of the diagonal instead of 0.5 %.
    #[serde(deserialize_with = "or_nan")]
    pub f_score_one_percent: f64,
}

/// Rows of opacity above 0.05 whose distance from the mesh exceeds 1 % of the diagonal and twice their largest standard
/// deviation, at a position that at least two training views see through: these show a farther surface there, or none.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct Floaters {
    /// Number of floaters.
    pub count: usize,
    /// Number of floaters as a fraction of all rows.
    #[serde(deserialize_with = "or_nan")]
    pub of_rows: f64,
    /// Weight w of the floaters as a fraction of that of all rows.
    #[serde(deserialize_with = "or_nan")]
    pub of_weight: f64,
}

/// Pixels that show thin structures of about the same width. A pixel counts as found if its alpha is above 0.5, its
/// depth error below the thickness plus 1 % of the depth, and its mean colour error over the channels below 0.1.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct ThinRecall {
    /// Width in the image, to the nearest power of two `[px]`.
    pub width: f64,
    /// Number of pixels that show a thin structure.
    pub pixels: usize,
    /// Fraction of these pixels that are found.
    pub recall: f64,
}

/// Contributions of rows to the training views.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct Redundancy {
    /// Mean number of rows blended per pixel.
    #[serde(deserialize_with = "or_nan")]
    pub blended_per_pixel: f64,
    /// Fraction of the rows whose blend weight is below 0.01 in every pixel of every view.
    #[serde(deserialize_with = "or_nan")]
    pub below_one_percent: f64,
}

/// A scene whose surface is known.
#[derive(Clone, Copy)]
pub struct KnownScene<'a> {
    /// The surface.
    pub truth: &'a GroundTruth,
    /// Transform from the coordinates of the surface to those of the model and the cameras.
    pub normalisation: &'a Normalisation,
    /// Background colour of the renders, sRGB-encoded in `[0, 1]`.
    pub background: [f32; 3],
    /// Spherical-harmonic degree evaluated, <= the model's.
    pub sh_degree: u8,
    /// Called before each view; measuring ends with an error once it returns true.
    pub is_stopped: &'a dyn Fn() -> bool,
}

/// The values that the backend for [`measure`] must record; pass them when creating the backend.
pub fn needs() -> Needs {
    let columns = vec![AuxColumn::WeightSum, AuxColumn::WeightMax, AuxColumn::PixelCount];
    Needs { aux: Some(AuxRequest { columns, ..AuxRequest::default() }), ..Needs::default() }
}

/// Peak memory for [`measure`] in addition to the backend and the surface `[bytes]`. Per row: two copies of the model
/// (while it is read or downloaded), position, axes, sums and two search trees. Per pixel: the renders, the surface's
/// depth and normals, and the files of both. In addition: samples and angles.
pub fn bytes(rows: usize, sh_degree: u8, image: (u32, u32), views: usize) -> u64 {
    let row = 2 * 4 * (11 + 3 * densify_core::gaussians::sh_coefficients(sh_degree) as u64) + 512;
    let pixels = u64::from(image.0) * u64::from(image.1);
    rows as u64 * row + pixels * 128 + views as u64 * (16 << 10) + (4 << 20)
}

/// The value of a measurement that files of older versions lack.
fn nan() -> f64 {
    f64::NAN
}

/// Reads a number that may be NaN, which JSON writes as null.
fn or_nan<'de, D: Deserializer<'de>>(from: D) -> Result<f64, D::Error> {
    Ok(Option::deserialize(from)?.unwrap_or(f64::NAN))
}
