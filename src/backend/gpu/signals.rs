//! Which plane of the accumulators holds which signal, and which fields of the records they need.

use densify_policies::policy::{Signal, SignalSet};

/// Signals that are sums over views, in the order of `Frame::planes`.
const SUMS: [Signal; 10] = [
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
pub(super) struct Planes {
    sums: [Option<u32>; SUMS.len()],
    /// Largest weight of the previous epoch, and of the current one; they change places.
    weight_max: Option<[u32; 2]>,
    fresh: Option<u32>,
    /// How many there are.
    pub(super) count: u32,
    /// 0: what training needs, 1: and the largest blend weight, 2: every field of a record.
    pub(super) detail: u32,
}

/// Numbers per record of a detail.
pub(super) const fn record_stride(detail: u32) -> u64 {
    match detail {
        0 => 9,
        1 => 10,
        _ => 15,
    }
}

impl Planes {
    pub(super) fn new(requested: SignalSet) -> Self {
        let mut count = 0;
        let mut next = |wanted: bool| {
            count += u32::from(wanted);
            wanted.then(|| count - 1)
        };
        let sums = SUMS.map(|signal| next(requested.contains(signal)));
        let previous = next(requested.contains(Signal::WeightMax));
        let current = next(requested.contains(Signal::WeightMax));
        let fresh = next(requested.contains(Signal::FreshWeightMax));
        let any = |signals: &[Signal]| signals.iter().any(|&s| requested.contains(s));
        let detail = if any(&[Signal::ScreenGradientAbs, Signal::WeightSum, Signal::PixelCount]) {
            2
        } else {
            u32::from(any(&[Signal::WeightMax, Signal::FreshWeightMax]))
        };
        Self { sums, weight_max: previous.zip(current).map(|(a, b)| [a, b]), fresh, count, detail }
    }

    /// As the shaders read them.
    pub(super) fn in_frame(&self) -> [[u32; 4]; 4] {
        let mut all = [u32::MAX; 16];
        for (slot, plane) in all.iter_mut().zip(self.sums) {
            *slot = plane.unwrap_or(u32::MAX);
        }
        all[10] = self.weight_max.map_or(u32::MAX, |[_, current]| current);
        all[11] = self.fresh.unwrap_or(u32::MAX);
        std::array::from_fn(|i| std::array::from_fn(|k| all[4 * i + k]))
    }

    /// The planes whose largest value is a signal; none for what is not accumulated.
    pub(super) fn of(&self, signal: Signal) -> Vec<u32> {
        match signal {
            Signal::WeightMax => self.weight_max.into_iter().flatten().collect(),
            Signal::FreshWeightMax => self.fresh.into_iter().collect(),
            sum => {
                let place = SUMS.iter().position(|&s| s == sum);
                place.and_then(|i| self.sums[i]).into_iter().collect()
            }
        }
    }

    /// What is kept between steps, by name and plane. Weights of fresh views are not: they are
    /// measured and taken within one event.
    pub(super) fn kept(&self) -> impl Iterator<Item = (String, u32)> {
        let sums = SUMS.iter().zip(self.sums);
        let sums = sums.filter_map(|(signal, plane)| Some((format!("{signal:?}"), plane?)));
        let epochs = ["WeightMax.previous", "WeightMax.current"].map(str::to_owned);
        sums.chain(self.weight_max.into_iter().flat_map(move |p| epochs.clone().into_iter().zip(p)))
    }

    /// The planes that start anew with the sums.
    pub(super) fn sums(&self) -> impl Iterator<Item = u32> {
        self.sums.into_iter().flatten()
    }

    pub(super) fn fresh(&self) -> Option<u32> {
        self.fresh
    }

    /// The current epoch's largest weights become the previous one's; returns the plane to clear.
    pub(super) fn begin_epoch(&mut self) -> Option<u32> {
        let [previous, current] = self.weight_max?;
        self.weight_max = Some([current, previous]);
        Some(previous)
    }
}
