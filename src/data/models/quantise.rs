//! Conversions that several quantised formats share: quaternions by their smallest three components, opacities in a
//! byte, scales.

use densify_core::gaussians::logit;

/// Finite log-scale in place of −∞, that of a flat Gaussian; compressed PLY uses the same value.
pub(super) const FLAT: f32 = -20.0;
/// Largest magnitude of a log-scale in quantised formats: an infinite log-scale would leave no resolution for the
/// others.
pub(super) const MAX_LOG_SCALE: f32 = 20.0;
/// Opacities stay this far from 0 and 1, whose logits are infinite; other readers use the same margin.
const MARGIN: f32 = 1e-6;

/// The index of a quaternion's largest component and, in order, the three others, for the unit quaternion in which
/// the largest is positive.
pub(super) fn smallest_three(quat: [f32; 4]) -> (usize, [f32; 3]) {
    let largest = (1..4).fold(0, |max, i| if quat[i].abs() > quat[max].abs() { i } else { max });
    let length = quat.iter().map(|v| v * v).sum::<f32>().sqrt().max(f32::MIN_POSITIVE);
    let unit = 1.0f32.copysign(quat[largest]) / length;
    let mut others = (0..4).filter(|&i| i != largest).map(|i| quat[i] * unit);
    (largest, std::array::from_fn(|_| others.next().unwrap_or_default()))
}

/// The inverse of [`smallest_three`].
pub(super) fn from_smallest_three(largest: usize, others: [f32; 3]) -> [f32; 4] {
    let rest = (1.0 - others.iter().map(|v| v * v).sum::<f32>()).max(0.0).sqrt();
    let mut next = others.into_iter();
    std::array::from_fn(|i| if i == largest { rest } else { next.next().unwrap_or(0.0) })
}

/// Logit of an opacity in `[0, 1]`, always finite.
pub(super) fn quantised_logit(opacity: f32) -> f32 {
    logit(opacity.clamp(MARGIN, 1.0 - MARGIN))
}

/// Logarithm of a standard deviation; finite for 0.
pub(super) fn log_of_scale(scale: f32) -> f32 {
    if scale == 0.0 { FLAT } else { scale.ln() }
}
