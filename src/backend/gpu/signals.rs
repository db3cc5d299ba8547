//! Which plane of the accumulators holds which signal, and which fields of the records they need.

use densify_policies::policy::{Needs, Signal};

use crate::backend::signal_planes::{SUMS, SignalPlanes};

/// The planes of the requested signals.
#[derive(Debug, Clone, Copy)]
pub(super) struct Planes {
    /// In the order of `Frame::planes`.
    planes: SignalPlanes,
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
    pub(super) fn new(needs: &Needs) -> Self {
        let planes = SignalPlanes::new(needs);
        let any = |signals: &[Signal]| signals.iter().any(|&s| needs.signals.contains(s));
        let detail = if any(&[Signal::ScreenGradientAbs, Signal::WeightSum, Signal::PixelCount]) {
            2
        } else {
            u32::from(any(&[Signal::WeightMax, Signal::FreshWeightMax]))
        };
        Self { planes, count: planes.count as u32, detail }
    }

    /// See [`Needs::full_depth`].
    pub(super) fn full_depth(&self) -> f32 {
        self.planes.full_depth
    }

    /// As the shaders read them.
    pub(super) fn in_frame(&self) -> [[u32; 4]; 4] {
        let SignalPlanes { sums, weight_max, fresh_weight_max, .. } = self.planes;
        let mut all = [u32::MAX; 16];
        let current = weight_max.map(|[_, current]| current);
        let planes = sums.into_iter().chain([current, fresh_weight_max]);
        for (slot, plane) in all.iter_mut().zip(planes) {
            *slot = plane.map_or(u32::MAX, |plane| plane as u32);
        }
        std::array::from_fn(|i| std::array::from_fn(|k| all[4 * i + k]))
    }

    /// The planes whose largest value is a signal; none for what is not accumulated.
    pub(super) fn of(&self, signal: Signal) -> Vec<u32> {
        let SignalPlanes { sums, weight_max, fresh_weight_max, .. } = self.planes;
        let planes: Vec<usize> = match signal {
            Signal::WeightMax => weight_max.into_iter().flatten().collect(),
            Signal::FreshWeightMax => fresh_weight_max.into_iter().collect(),
            sum => {
                let place = SUMS.iter().position(|&s| s == sum);
                place.and_then(|i| sums[i]).into_iter().collect()
            }
        };
        planes.into_iter().map(|plane| plane as u32).collect()
    }

    /// What is kept between steps, by name and plane.
    pub(super) fn kept(&self) -> impl Iterator<Item = (String, u32)> + use<> {
        self.planes.kept().map(|(name, plane)| (name, plane as u32))
    }

    /// The planes that start anew with the sums.
    pub(super) fn sums(&self) -> impl Iterator<Item = u32> {
        self.planes.sums.into_iter().flatten().map(|plane| plane as u32)
    }

    pub(super) fn fresh(&self) -> Option<u32> {
        self.planes.fresh_weight_max.map(|plane| plane as u32)
    }

    /// The current epoch's largest weights become the previous one's: the planes change places.
    /// Returns the plane to clear.
    pub(super) fn begin_epoch(&mut self) -> Option<u32> {
        let [previous, current] = self.planes.weight_max?;
        self.planes.weight_max = Some([current, previous]);
        Some(previous as u32)
    }
}
