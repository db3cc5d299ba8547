//! Statistics of pixels that policies can request: candidates for new rows, error scores, auxiliary views.

use serde::{Deserialize, Serialize};

use super::at_least;
use crate::signals::AuxColumn;

/// The rule by which pixel errors are summed into [`Signal::ErrorScore`](crate::policy::Signal::ErrorScore). A
/// view adds
///
/// (Σ w·M(p) / (Σ w)^`footprint`)^`view_power`, with M(p) = e(p)^`power` · (1 + `edge` · g(p) / ḡ),
///
/// both sums over the pixels p that the row is blended into, with w the row's blend weight α·T in p and e the
/// error of p according to `map`. g is the 8-neighbour Laplacian of the photograph's 8-bit luma, clipped
/// to 0..255, and ḡ its mean over the view (in a view without edges all pixels weigh the same).
///
/// The default is Σ w·e. A power above 1 emphasises the worst pixels, a footprint of 1 gives the mean error
/// independent of the row's size, and a view power below 1 favours rows with errors in many views.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ErrorScore {
    /// The error e of a pixel.
    pub map: ErrorMap,
    /// Exponent of a pixel's error, in (0, 16].
    pub power: f32,
    /// Weight of edges, >= 0; 0 ignores them at no cost.
    pub edge: f32,
    /// Exponent of the sum of blend weights in the denominator, in `[0, 1]`.
    pub footprint: f32,
    /// Exponent of a view's score, in (0, 1].
    pub view_power: f32,
}

/// The error of a pixel in an [`ErrorScore`], >= 0: the mean over channels, with I the rendering and G the
/// photograph.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ErrorMap {
    /// The pixel's contribution to the training loss: 0.8 · |I − G| + 0.2 · (1 − SSIM).
    #[default]
    Loss,
    /// |I − G|, the error of the pixel's own colour.
    L1,
    /// 1 − SSIM, the error of the structure around the pixel.
    Dssim,
}

impl ErrorMap {
    /// The weights of |I − G| and of 1 − SSIM.
    pub fn weights(self) -> [f32; 2] {
        match self {
            Self::Loss => [0.8, 0.2],
            Self::L1 => [1.0, 0.0],
            Self::Dssim => [0.0, 1.0],
        }
    }
}

impl Default for ErrorScore {
    fn default() -> Self {
        Self { map: ErrorMap::Loss, power: 1.0, edge: 0.0, footprint: 0.0, view_power: 1.0 }
    }
}

impl ErrorScore {
    /// True if `power` is 1, so that M is the error itself apart from the factor for edges.
    pub fn is_plain_map(&self) -> bool {
        self.power.total_cmp(&1.0).is_eq()
    }

    /// The score of one view, from Σ w·M and Σ w; 0 where the row has no error.
    pub fn of_view(&self, error: f32, weight: f32) -> f32 {
        if !(error > 0.0 && weight > 0.0) {
            return 0.0;
        }
        let score = if self.footprint > 0.0 { error / weight.powf(self.footprint) } else { error };
        if self.view_power < 1.0 { score.powf(self.view_power) } else { score }
    }

    pub(super) fn check(&self) -> Result<(), String> {
        at_least("error_score.edge", self.edge.into(), 0.0)?;
        for (name, value, lowest, highest) in [
            ("power", self.power, f32::MIN_POSITIVE, 16.0),
            ("footprint", self.footprint, 0.0, 1.0),
            ("view_power", self.view_power, f32::MIN_POSITIVE, 1.0),
        ] {
            if !(lowest..=highest).contains(&value) {
                let above = if lowest > 0.0 { "above 0" } else { "at least 0" };
                return Err(format!(
                    "error_score.{name} is {value}; it must be {above} and at most {highest}"
                ));
            }
        }
        Ok(())
    }
}

/// Selects pixels of the training views as candidates for new rows.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CandidateRequest {
    /// Start of the collection (exclusive) `[step]`.
    pub from: u32,
    /// End of the collection (exclusive) `[step]`.
    pub until: u32,
    /// Each step collects one candidate per this many rows, >= 1.
    pub rows_per_candidate: u32,
    /// Maximum number of candidates in the list; later ones are dropped.
    pub capacity: usize,
    /// The error that ranks pixels.
    pub error: ErrorMode,
    /// The surface point on the pixel's ray. Where the run trains on depth and that of the pixel is known, the point
    /// lies at the given depth instead.
    pub depth: DepthMode,
    /// Smallest accumulated alpha of a pixel, in `[0, 1]`: a transparent pixel has no depth.
    pub min_alpha: f32,
    /// Non-maximum suppression: only pixels with the largest error of their 3×3 neighbourhood count.
    pub spaced: bool,
}

/// The error that ranks pixels as [candidates](CandidateRequest). (Scores of rows use an [`ErrorMap`].)
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum ErrorMode {
    /// ‖dL/dC‖₂, with C the rendered colour, as in the Diet code. It responds to blurred structure and
    /// not to a constant colour offset.
    #[serde(rename = "grad")]
    Gradient,
    /// Mean over channels of |I − G|.
    L1,
    /// 0.8 · L1 + 0.2 · (1 − SSIM), per pixel.
    L1Dssim,
}

/// The surface point on a pixel's ray.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum DepthMode {
    /// The ray's closest point, in Mahalanobis distance, to the Gaussian with the largest blend
    /// weight (Mini-Splatting).
    MaxWeight,
    /// The ray's closest point to the Gaussian at which transmittance first falls below one half.
    Median,
}

/// Measurements in an auxiliary view: a training view rendered for one event of the policy.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct AuxRequest {
    /// The pixel map M that [`AuxColumn::MapSum`] sums.
    pub map: PixelMap,
    /// The statistics of each row to measure.
    pub columns: Vec<AuxColumn>,
    /// Maximum number of surface points per view: pixels drawn without replacement in proportion to their
    /// accumulated alpha, with the surface point of [`DepthMode::MaxWeight`].
    pub points: u32,
    /// Distance from the surface above which [`AuxColumn::WeightInFront`] counts a row as in front of it, as a fraction
    /// of the surface's depth, in `0..1`.
    pub margin: f32,
}

impl Default for AuxRequest {
    fn default() -> Self {
        Self { map: PixelMap::default(), columns: Vec::new(), points: 0, margin: 0.05 }
    }
}

/// The pixel map M(p) = `error`·n(e) + `edge`·n(g).
///
/// n scales a map to 0..1 by its minimum and maximum in the view (0 where they are equal), e(p) is the
/// mean over channels of |I − G|, and g(p) the 8-neighbour Laplacian of the 8-bit luma of the ground
/// truth, clipped to 0..255, with repeated borders. e and g are multiplied by the image's mask. With a
/// `threshold` above 0, n(e) is replaced by 1 where it is above the threshold and by 0 elsewhere, so that its sum counts
/// pixels.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct PixelMap {
    /// Weight of the error, >= 0.
    pub error: f32,
    /// Weight of the edges, >= 0.
    pub edge: f32,
    /// Scaled error above which a pixel counts as wrong, in `[0, 1)`; 0: errors are summed as they are.
    pub threshold: f32,
}
