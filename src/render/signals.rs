//! The memory layout of signals in both backends: fields of gradient records, and planes of accumulators.
//!
//! Record layouts, strides, planes and the shaders' constants all follow from the policies' table of signals
//! ([`Signal`]). Only requested signals have memory.

use std::ops::Range;

use densify_policies::policy::{
    AuxColumn, AuxRequest, ErrorScore, Needs, PixelSum, Signal, SignalKind, SignalSet,
};

use densify_core::gaussians::{ModelArray, dc_to_rgb};

/// Values per record that training itself needs: Σq, Σq·u, Σq·z, Σq·u², Σq·u·z, Σq·z² and the
/// gradient with respect to the colour. `cpu/rasterize_bwd.rs` defines q, u, z and the blend weight w.
pub(super) const BASE: usize = 9;

/// The optional values of a record, in the order of the record.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Field {
    /// Σ|q·u|; together with `AbsY` the absolute gradients of the projected mean.
    AbsX,
    /// Σ|q·(l3·z − l1·shear·u)|.
    AbsY,
    /// Σw.
    WeightSum,
    /// Number of pixels with w > 0.
    PixelCount,
    /// Gradient with respect to camera-space depth, through the depth of pixels; with [`Setup::depth`](super::Setup),
    /// and for [`Differentiable`](super::Differentiable).
    Depth,
    /// Σw·(error of the pixel); only in training.
    Error,
    /// max w; comes last, as it is the only value that is not a sum.
    WeightMax,
}

impl Field {
    pub(super) const ALL: [Self; 7] = [
        Self::AbsX,
        Self::AbsY,
        Self::WeightSum,
        Self::PixelCount,
        Self::Depth,
        Self::Error,
        Self::WeightMax,
    ];

    const fn of_sum(sum: PixelSum) -> &'static [Self] {
        match sum {
            PixelSum::AbsGradient => &[Self::AbsX, Self::AbsY],
            PixelSum::Weight => &[Self::WeightSum],
            PixelSum::Count => &[Self::PixelCount],
            PixelSum::LargestWeight => &[Self::WeightMax],
            PixelSum::WeightedError => &[Self::Error],
        }
    }

    /// The index of this value in a complete record.
    pub(super) const fn number(self) -> usize {
        BASE + self as usize
    }

    /// Name of the shaders' constant that holds the index of this value in a record.
    #[cfg_attr(not(feature = "gpu"), expect(dead_code, reason = "used by the GPU backend only"))]
    pub(super) const fn constant(self) -> &'static str {
        match self {
            Self::AbsX => "ABS_X_AT",
            Self::AbsY => "ABS_Y_AT",
            Self::WeightSum => "WEIGHT_SUM_AT",
            Self::PixelCount => "PIXEL_COUNT_AT",
            Self::Depth => "DEPTH_AT",
            Self::Error => "ERROR_AT",
            Self::WeightMax => "WEIGHT_MAX_AT",
        }
    }
}

/// The values in a backend's records: the base, and the fields that its signals need.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct RecordLayout {
    /// A bit per [`Field`].
    fields: u8,
    /// The optional fields in order, by their index in a complete record.
    extras: [u8; RecordLayout::MOST - BASE],
}

impl RecordLayout {
    /// All fields except the error, as [`Differentiable`](super::Differentiable) needs them.
    pub(super) const DIFFERENTIATED: Self =
        Self::with(((1 << Field::ALL.len()) - 1) & !(1 << Field::Error as u8));
    /// Values in a complete record.
    pub(super) const MOST: usize = Field::WeightMax.number() + 1;

    /// The records of training steps, with or without depth in the loss.
    pub(super) fn new(signals: SignalSet, depth: bool) -> Self {
        let fields =
            signals.iter().flat_map(Signal::pixel_sums).flat_map(|&sum| Field::of_sum(sum));
        let fields = fields.chain(depth.then_some(&Field::Depth));
        Self::with(fields.fold(0, |bits, &field| bits | 1 << field as u8))
    }

    /// The layout of a step that has no depth in its loss.
    pub(super) const fn without_depth(self) -> Self {
        Self::with(self.fields & !(1 << Field::Depth as u8))
    }

    const fn with(fields: u8) -> Self {
        let mut extras = [0; Self::MOST - BASE];
        let (mut field, mut count) = (0, 0);
        while field < Field::ALL.len() {
            if fields >> field & 1 == 1 {
                extras[count] = Field::ALL[field].number() as u8;
                count += 1;
            }
            field += 1;
        }
        Self { fields, extras }
    }

    pub(super) const fn has(self, field: Field) -> bool {
        self.fields >> field as u8 & 1 == 1
    }

    /// Values per record.
    pub(super) const fn stride(self) -> usize {
        BASE + self.fields.count_ones() as usize
    }

    /// The index of a field in the records of this layout.
    #[cfg_attr(not(feature = "gpu"), expect(dead_code, reason = "used by the GPU backend only"))]
    pub(super) fn at(self, field: Field) -> Option<usize> {
        let before = self.fields & ((1 << field as u8) - 1);
        self.has(field).then(|| BASE + before.count_ones() as usize)
    }

    /// For each value beyond the base, its index in a complete record.
    pub(super) fn extras(&self) -> &[u8] {
        &self.extras[..self.stride() - BASE]
    }
}

/// True if each row's dominant pixels are counted: those in which no other row has a larger blend weight.
pub(super) fn counts_dominant(needs: &Needs) -> bool {
    let in_views = |aux: &AuxRequest| aux.columns.contains(&AuxColumn::DominantPixels);
    needs.signals.contains(Signal::DominantPixels) || needs.aux.as_ref().is_some_and(in_views)
}

/// Converts an accumulated value to the policy's signal. A minimum is accumulated as the largest reciprocal, which
/// starts at 0 like all other values.
pub(super) fn value_of(signal: Signal, accumulated: f32) -> f32 {
    if signal.kind() == SignalKind::Minimum { 1.0 / accumulated } else { accumulated }
}

/// The planes of the requested signals.
#[derive(Debug, Clone, Copy)]
pub(super) struct SignalPlanes {
    /// First plane of each signal, in the order of [`Signal::ALL`].
    first: [Option<usize>; Signal::ALL.len()],
    /// Number of planes.
    pub(super) count: usize,
    /// See [`Needs::full_depth`].
    pub(super) full_depth: f32,
    /// See [`Needs::error_score`].
    pub(super) score: ErrorScore,
    /// True if the first of an epoch signal's two planes belongs to the current epoch, false if the second does.
    swapped: bool,
}

/// Number of planes per signal.
const fn planes(kind: SignalKind) -> usize {
    match kind {
        SignalKind::Sum | SignalKind::Count | SignalKind::Maximum | SignalKind::Minimum => 1,
        // The previous epoch, and the current one.
        SignalKind::EpochMaximum => 2,
        SignalKind::Current | SignalKind::Attribute(_) => 0,
    }
}

impl SignalPlanes {
    pub(super) fn new(needs: &Needs) -> Self {
        let mut count = 0;
        let first = Signal::ALL.map(|signal| {
            let own = planes(signal.kind());
            let first = (own > 0 && needs.signals.contains(signal)).then_some(count);
            count += if first.is_some() { own } else { 0 };
            first
        });
        let (full_depth, score) = (needs.full_depth, needs.error_score);
        Self { first, count, full_depth, score, swapped: false }
    }

    /// The planes of a signal; its value is the maximum over them.
    pub(super) fn of_signal(&self, signal: Signal) -> Range<usize> {
        self.first[signal as usize].map_or(0..0, |first| first..first + planes(signal.kind()))
    }

    /// The plane that accumulates the current view.
    #[inline(always)]
    pub(super) fn current(&self, signal: Signal) -> Option<usize> {
        let is_second = matches!(signal.kind(), SignalKind::EpochMaximum) && !self.swapped;
        self.first[signal as usize].map(|first| first + usize::from(is_second))
    }

    /// The planes of several signals.
    pub(super) fn of_signals(&self, signals: SignalSet) -> Vec<usize> {
        signals.iter().flat_map(|signal| self.of_signal(signal)).collect()
    }

    /// Swaps the planes of the current and the previous epoch. Returns the planes to clear.
    pub(super) fn begin_epoch(&mut self) -> Vec<usize> {
        self.swapped = !self.swapped;
        let by_epoch = |signal: &Signal| matches!(signal.kind(), SignalKind::EpochMaximum);
        Signal::ALL.into_iter().filter(by_epoch).filter_map(|s| self.current(s)).collect()
    }

    /// The planes that checkpoints save, by name.
    pub(super) fn saved(&self) -> Vec<(String, usize)> {
        let mut saved = Vec::new();
        for signal in Signal::ALL {
            let Some(current) = self.current(signal) else { continue };
            match signal.kind() {
                SignalKind::Sum | SignalKind::Count | SignalKind::Maximum | SignalKind::Minimum => {
                    saved.push((format!("{signal:?}"), current));
                }
                SignalKind::EpochMaximum => {
                    let both = self.of_signal(signal);
                    let previous = both.start + both.end - 1 - current;
                    saved.push((format!("{signal:?}.previous"), previous));
                    saved.push((format!("{signal:?}.current"), current));
                }
                SignalKind::Current | SignalKind::Attribute(_) => {}
            }
        }
        saved
    }
}

/// A signal that is read from the parameters.
pub(super) struct ParameterSignal {
    /// Indices of the signal's values among a row's parameters.
    pub(super) parameters: Range<usize>,
    /// Converts a parameter to the signal's value.
    pub(super) convert: fn(f32) -> f32,
}

impl ParameterSignal {
    /// `None` for signals that are not parameters.
    pub(super) fn new(signal: Signal) -> Option<Self> {
        let as_stored = |x| x;
        let (array, convert): (_, fn(f32) -> f32) = match signal {
            Signal::Position => (ModelArray::Means, as_stored),
            Signal::LogScale => (ModelArray::LogScales, as_stored),
            Signal::Orientation => (ModelArray::Quats, as_stored),
            Signal::Colour => (ModelArray::Sh, dc_to_rgb),
            Signal::VisibleCount
            | Signal::ScreenGradient
            | Signal::ScreenGradientAbs
            | Signal::ColourGradient
            | Signal::MeanGradientX
            | Signal::MeanGradientY
            | Signal::MeanGradientZ
            | Signal::MeanGradientNorm
            | Signal::WeightMax
            | Signal::WeightSum
            | Signal::PixelCount
            | Signal::WeightedError
            | Signal::ErrorScore
            | Signal::WeightMaxRoot
            | Signal::Support
            | Signal::DepthMin
            | Signal::PixelSizeMin
            | Signal::DominantPixels
            | Signal::Opacity
            | Signal::ScaleMax
            | Signal::ScaleProduct
            | Signal::Mask
            | Signal::Age => return None,
        };
        // Degree 0: only band 0 of the coefficients.
        Some(Self { parameters: array.parameters(0), convert })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_attribute_signals_are_read_from_parameters_and_their_widths_agree() {
        for signal in Signal::ALL {
            let parameters = ParameterSignal::new(signal).map(|read| read.parameters.len());
            let width = match signal.kind() {
                SignalKind::Attribute(width) => Some(width),
                _ => None,
            };
            assert_eq!(parameters, width, "{signal:?}");
        }
    }
}
