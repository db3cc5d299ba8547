//! Made-up statistics: plausible ones, and all that can go wrong with a number.

use crate::policy::{SceneInfo, Signal};

/// What the statistics of a run hold.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Pattern {
    Plausible,
    Zero,
    Equal,
    Negative,
    Huge,
    Denormal,
    Infinite,
    MinusInfinite,
    Nan,
    /// Each number after another of the patterns above.
    Mixture,
    /// Each event after another of the patterns above.
    Changing,
}

pub(super) const PATTERNS: [Pattern; 11] = [
    Pattern::Plausible,
    Pattern::Zero,
    Pattern::Equal,
    Pattern::Negative,
    Pattern::Huge,
    Pattern::Denormal,
    Pattern::Infinite,
    Pattern::MinusInfinite,
    Pattern::Nan,
    Pattern::Mixture,
    Pattern::Changing,
];

/// A number after the pattern, from four random words.
pub(super) fn number(pattern: Pattern, bits: [u32; 4], plausible: impl Fn(f32) -> f32) -> f32 {
    let u = (bits[0] >> 9) as f32 / 8_388_608.0;
    match pattern {
        Pattern::Plausible | Pattern::Changing => plausible(u),
        Pattern::Zero => 0.0,
        Pattern::Equal => 0.5,
        Pattern::Negative => -plausible(u),
        Pattern::Huge => f32::MAX,
        Pattern::Denormal => f32::from_bits(1),
        Pattern::Infinite => f32::INFINITY,
        Pattern::MinusInfinite => f32::NEG_INFINITY,
        Pattern::Nan => f32::NAN,
        // Half of them plausible, so that policies act at all.
        Pattern::Mixture => {
            let pattern =
                if bits[1].is_multiple_of(2) { 0 } else { bits[2] as usize % (PATTERNS.len() - 2) };
            number(PATTERNS[pattern], bits, plausible)
        }
    }
}

/// A value such as a training may show, for u in [0, 1).
pub(super) fn plausible(signal: Signal, u: f32, scene: &SceneInfo) -> f32 {
    match signal {
        Signal::VisibleCount => (20.0 * u).floor(),
        Signal::ScreenGradient | Signal::ScreenGradientAbs => 0.02 * u.powi(3),
        Signal::ColourGradient => 1e-3 * u.powi(3),
        Signal::MeanGradientX | Signal::MeanGradientY | Signal::MeanGradientZ => 1e-3 * (u - 0.5),
        Signal::MeanGradientNorm => 2e-3 * u,
        Signal::WeightMax | Signal::FreshWeightMax => u,
        Signal::WeightSum | Signal::PixelCount => (1000.0 * u).floor(),
        Signal::Opacity => 0.99 * u.powi(3) + 1e-3,
        Signal::ScaleProduct => (0.15 * scene.extent * u.powi(3)).powi(3),
        Signal::ScaleMax => 0.15 * scene.extent * u.powi(3) + 1e-6,
        Signal::Age => (300.0 * u).floor(),
    }
}
