//! Recognises opacities and scales that a program has written as plain values. A splat PLY holds logits and logarithms,
//! but exporters of several feed-forward models omit one conversion or both.

use crate::models::quantise::{log_of_scale, quantised_logit};
use crate::models::spatial_order::middles_and_spreads;
use densify_core::gaussians::Gaussians;

/// Whatever the scales are, numbers from 0 to 1 count as opacities if the largest is above this and they spread by more
/// than [`SPREAD`]. As logits, 0.9 to 1 would mean opacities of 0.71 to 0.73.
const NEAR_OPAQUE: f32 = 0.9;
/// Smallest spread of numbers that count as opacities. As logits, 0 to 1 would mean opacities of 0.5 to 0.73.
const SPREAD: f32 = 0.25;

/// Turns plain values into logits and logarithms where there is no doubt; returns notes on these values, and on
/// doubtful ones.
pub(super) fn undo(model: &mut Gaussians) -> Vec<String> {
    let (faintest, most_opaque) = range(&model.opacity_logits);
    let (smallest, largest) = range(model.log_scales.as_flattened());
    let may_be_opacities = faintest >= 0.0 && most_opaque > 0.0 && most_opaque <= 1.0;
    let are_opacities =
        may_be_opacities && most_opaque > NEAR_OPAQUE && most_opaque - faintest > SPREAD;
    let varies = smallest < largest || (are_opacities && largest > 0.0);
    let are_scales = smallest >= 0.0 && varies && !are_logarithms(model, &model.log_scales);
    let mut notes = Vec::new();
    if are_opacities || (may_be_opacities && are_scales) {
        for value in &mut model.opacity_logits {
            *value = quantised_logit(*value);
        }
        notes.push(
            "its opacities lie between 0 and 1, so they are read as opacities, not as logits"
                .to_owned(),
        );
    }
    if are_scales && may_be_opacities {
        for value in model.log_scales.as_flattened_mut() {
            *value = log_of_scale(*value);
        }
        notes.push(
            "none of its scales is negative, so they are read as standard deviations, not as logarithms"
                .to_owned(),
        );
    } else if are_scales {
        notes.push(format!(
            "its scales may be standard deviations instead of logarithms: none is negative, so every Gaussian is read as \
             larger than {:.3}; if they are standard deviations, export their logarithms",
            smallest.exp()
        ));
    }
    notes
}

/// Returns true if a model's `scales` are plausible as logarithms: some Gaussians are much larger than others, but most
/// are smaller than the model.
fn are_logarithms(model: &Gaussians, scales: &[[f32; 3]]) -> bool {
    let mut largest: Vec<f32> =
        scales.iter().map(|axes| axes.iter().copied().fold(0.0, f32::max)).collect();
    let middle = largest.len() / 2;
    let median = f64::from(*largest.select_nth_unstable_by(middle, f32::total_cmp).1);
    let extent = middles_and_spreads(model).iter().map(|(_, spread)| *spread).fold(0.0, f64::max);
    // With a median below ln 2, the standard deviations of half of all Gaussians would lie between 1 and 2.
    median > std::f64::consts::LN_2 && median.exp() < extent
}

/// Returns true if a model's `scales` from a file of standard deviations may be logarithms that are all positive: they are
/// plausible as logarithms, and hardly any Gaussian is flat, as most are in trained models.
pub(crate) fn may_be_logarithms(model: &Gaussians, scales: &[[f32; 3]]) -> bool {
    /// Length of the shortest axis of a flat Gaussian, relative to the median axis of all.
    const FLAT: f32 = 0.05;
    /// Largest share of axes that may be as short among logarithms.
    const FEW: f64 = 0.01;
    let mut axes = scales.as_flattened().to_vec();
    if axes.is_empty() || !are_logarithms(model, scales) {
        return false;
    }
    let middle = axes.len() / 2;
    let median = *axes.select_nth_unstable_by(middle, f32::total_cmp).1;
    let short = axes.iter().filter(|axis| **axis < FLAT * median).count();
    short as f64 <= FEW * axes.len() as f64
}

/// The smallest and the largest value.
fn range(values: &[f32]) -> (f32, f32) {
    let start = (f32::INFINITY, f32::NEG_INFINITY);
    values.iter().fold(start, |(min, max), &value| (min.min(value), max.max(value)))
}
