//! Which plane of a backend's accumulators holds which signal, and how views are weighed there.
//! Only requested signals have a plane.

use densify_policies::policy::{Needs, Signal};

/// Signals that are sums over views, in plane order.
pub(super) const SUMS: [Signal; 10] = [
    Signal::VisibleCount,
    Signal::ScreenGradient,
    Signal::ScreenGradientAbs,
    Signal::ColourGradient,
    Signal::MeanGradientX,
    Signal::MeanGradientY,
    Signal::MeanGradientZ,
    Signal::MeanGradientNorm,
    Signal::WeightSum,
    Signal::PixelCount,
];

/// The planes of the requested signals.
#[derive(Debug, Clone, Copy)]
pub(super) struct SignalPlanes {
    pub(super) sums: [Option<usize>; SUMS.len()],
    /// Largest weight of the previous epoch, and of the current one.
    pub(super) weight_max: Option<[usize; 2]>,
    /// Largest weight of the views measured since signals were last taken.
    pub(super) fresh_weight_max: Option<usize>,
    /// How many there are.
    pub(super) count: usize,
    /// See [`Needs::full_depth`].
    pub(super) full_depth: f32,
}

impl SignalPlanes {
    pub(super) fn new(needs: &Needs) -> Self {
        let requested = needs.signals;
        let mut count = 0;
        let mut next = |wanted: bool| {
            count += usize::from(wanted);
            wanted.then(|| count - 1)
        };
        let sums = SUMS.map(|signal| next(requested.contains(signal)));
        let previous = next(requested.contains(Signal::WeightMax));
        let current = next(requested.contains(Signal::WeightMax));
        let weight_max = previous.zip(current).map(|(a, b)| [a, b]);
        let fresh_weight_max = next(requested.contains(Signal::FreshWeightMax));
        Self { sums, weight_max, fresh_weight_max, count, full_depth: needs.full_depth }
    }

    /// What is kept between steps, by name and plane. Weights of fresh views are not: they are
    /// measured and taken within one event.
    pub(super) fn kept(&self) -> impl Iterator<Item = (String, usize)> + use<> {
        let sums = SUMS.iter().zip(self.sums);
        let sums = sums.filter_map(|(signal, plane)| Some((format!("{signal:?}"), plane?)));
        let epochs = ["WeightMax.previous", "WeightMax.current"].map(str::to_owned);
        sums.chain(self.weight_max.into_iter().flat_map(move |p| epochs.clone().into_iter().zip(p)))
    }
}
