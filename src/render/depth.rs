//! Depth in the loss of a training step.

use std::ops::Range;

use clap::ValueEnum;
use serde::{Deserialize, Serialize};

use densify_core::image::depth::DepthMap;

use super::StepInput;

/// The term of the loss that compares a rendering with given depth.
///
/// A term is a mean over pixels, weighted by their confidence times their mask. Inverse depths are multiplied by the
/// [median](DepthMap::median) of the given depth, D, so that a weight means the same in every unit of length. X* is
/// the given inverse depth of a pixel, w and x the blend weights and inverse depths of the Gaussians on its ray. Blend
/// weights receive gradient, because that is what removes Gaussians in front of a surface.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Hash, ValueEnum, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum DepthTerm {
    /// D·|X − X*| with X = Σ w·x / Σ w, the expected inverse depth; 0 where nothing is rendered.
    #[default]
    Expected,
    /// D·Σ w·|x − X*| + 1 − Σ w, which also makes the pixels with given depth opaque.
    Samples,
}

/// Given depth of a view with its part in the loss.
#[derive(Debug, Clone, Copy)]
pub struct DepthTarget<'a> {
    /// The depth, of the camera's size.
    pub map: &'a DepthMap,
    /// Weight of the term, >= 0.
    pub weight: f32,
    /// The term.
    pub term: DepthTerm,
}

/// Smallest X, as a multiple of the largest possible one, at which a pixel has a distortion term. Every x is less than
/// 10¹⁵·X then, also of Gaussians that do not reach the pixel, so that no square overflows.
const LEAST_INVERSE: f32 = 1e-15;

/// The depth in the loss of a step, from which both backends compute the gradients of pixels; `cpu/depth_gradient.rs`
/// has the formulas.
#[derive(Debug, Clone, Copy)]
pub(super) struct DepthLoss<'a> {
    /// The given depth, if there is any.
    pub(super) map: Option<&'a DepthMap>,
    /// The term of pixels with given depth.
    pub(super) term: DepthTerm,
    /// The photograph's mask, if it has one.
    pub(super) mask: Option<&'a [u8]>,
    /// Width of the image `[px]`.
    pub(super) width: usize,
    /// Weight of the term.
    pub(super) weight: f32,
    /// D/K and 1/K, the factors of distances and of transmittances in the value of the term; 0 if K is.
    pub(super) by_distance: f32,
    pub(super) by_transmittance: f32,
    /// Weight of the distortion of a pixel.
    pub(super) distortion: f32,
    /// The smallest X of pixels with a distortion term `[1/scene units]`.
    pub(super) least_inverse: f32,
}

/// The part of a pixel in a [`DepthLoss`].
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct PixelDepth {
    /// Value of the term, without its weight.
    pub(super) value: f32,
    /// The centre c, and the factors of ρ(x − c), of (x − c)², and of the sum of weights.
    pub(super) centre: f32,
    pub(super) by_depth: f32,
    pub(super) square: f32,
    pub(super) by_alpha: f32,
}

impl<'a> DepthLoss<'a> {
    /// The depth in the loss of a step; `None` if there is none. `confidence` returns the sum of [`confidence_in`] over
    /// all pixels.
    ///
    /// # Panics
    /// When there is depth in the loss, but the backend has no room for it (`is_set_up`), or when the given depth has
    /// another size than the camera: bugs in the caller.
    pub(super) fn new(
        input: &StepInput<'a>,
        near: f32,
        is_set_up: bool,
        confidence: impl FnOnce(&DepthMap, Option<&[u8]>) -> usize,
    ) -> Option<Self> {
        let StepInput { camera, target, depth, distortion, .. } = *input;
        if depth.is_none() && distortion <= 0.0 {
            return None;
        }
        assert!(is_set_up, "a step with depth on a backend that is not set up for it");
        let pixels = f64::from(camera.width) * f64::from(camera.height);
        let mask = target.mask.as_deref();
        let mut loss = Self {
            map: None,
            term: DepthTerm::Expected,
            mask,
            width: camera.width as usize,
            weight: 0.0,
            by_distance: 0.0,
            by_transmittance: 0.0,
            distortion: (f64::from(distortion) / pixels) as f32,
            least_inverse: LEAST_INVERSE / near,
        };
        if let Some(DepthTarget { map, weight, term }) = depth {
            let sizes = [[map.width, map.height], [camera.width, camera.height]];
            assert_eq!(sizes[0], sizes[1], "camera and given depth differ in size");
            let total = confidence(map, mask) as f64 / CONFIDENCE_UNIT;
            let each = if total > 0.0 { 1.0 / total } else { 0.0 };
            (loss.map, loss.term, loss.weight) = (Some(map), term, weight);
            loss.by_distance = (f64::from(map.median) * each) as f32;
            loss.by_transmittance = each as f32;
        }
        Some(loss)
    }

    /// The inverse depth given in a pixel `[1/scene units]`, its confidence times its mask, and its mask; the first two
    /// are 0 where none is given.
    #[inline(always)]
    pub(super) fn given(&self, pixel: usize) -> [f32; 3] {
        let mask = self.mask.map_or(1.0, |mask| f32::from(mask[pixel]) * (1.0 / 255.0));
        let Some(map) = self.map else { return [0.0, 0.0, mask] };
        let [inverse, confidence] = map.inverse_depth(pixel);
        let confidence = confidence * mask;
        [if confidence > 0.0 { inverse } else { 0.0 }, confidence, mask]
    }

    /// The part of a pixel, from what is [given](Self::given) there, its final transmittance and, as accumulated in the
    /// forward pass, the weighted sum of x, or of |x − X*| for samples in pixels with given depth.
    ///
    /// Written without branches on pixels, so that the compiler can vectorise it.
    #[inline(always)]
    pub(super) fn at_pixel(
        &self,
        [inverse, confidence, mask]: [f32; 3],
        transmittance: f32,
        sum: f32,
    ) -> PixelDepth {
        let is_known = confidence > 0.0;
        let alpha = 1.0 - transmittance;
        let is_seen = alpha > 0.0;
        let expected = sum / if is_seen { alpha } else { 1.0 };
        let by_distance = confidence * self.by_distance;
        let mut found = match self.term {
            DepthTerm::Expected => {
                let error = expected - inverse;
                let slope = self.weight * by_distance / if is_seen { alpha } else { 1.0 };
                let slope = if error < 0.0 { -slope } else { slope };
                let is_off = is_seen & (error != 0.0);
                PixelDepth {
                    value: if is_seen { by_distance * error.abs() } else { 0.0 },
                    centre: expected,
                    by_depth: if is_off { slope } else { 0.0 },
                    ..PixelDepth::default()
                }
            }
            DepthTerm::Samples => {
                let by_transmittance = confidence * self.by_transmittance;
                PixelDepth {
                    value: by_distance * sum + by_transmittance * transmittance,
                    centre: if is_known { inverse } else { expected },
                    by_depth: self.weight * by_distance,
                    by_alpha: -self.weight * by_transmittance,
                    square: 0.0,
                }
            }
        };
        let has_square = is_seen & !is_known & (expected >= self.least_inverse);
        let square = self.distortion * mask / expected / expected;
        found.square = if has_square { square } else { 0.0 };
        found
    }
}

/// What [`confidence_in`] returns for a pixel of full confidence that is not masked.
const CONFIDENCE_UNIT: f64 = 255.0 * 255.0;

/// The sum of confidence times mask over pixels, in units of 1/255².
pub(super) fn confidence_in(map: &DepthMap, mask: Option<&[u8]>, pixels: Range<usize>) -> usize {
    let known = map.inverse[pixels.clone()].iter().zip(&map.confidence[pixels.clone()]);
    let known =
        known.map(|(&inverse, &confidence)| usize::from(confidence) * usize::from(inverse > 0));
    match mask {
        Some(mask) => {
            known.zip(&mask[pixels]).map(|(known, &mask)| known * usize::from(mask)).sum()
        }
        None => 255 * known.sum::<usize>(),
    }
}
