//! Per-row statistics: the signals that training accumulates, and the columns of auxiliary views.

use std::ops::Range;

use serde::{Deserialize, Serialize};

/// The kind of a signal, which determines where a backend stores it and when it is reset.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SignalKind {
    /// Summed over the views in which the row was visible since the last
    /// [`Reset::Signals`](crate::plan::Reset::Signals), or since the row was created.
    Sum,
    /// Like [`Sum`](Self::Sum), but an integer.
    Count,
    /// The largest value of the previous and the current epoch.
    EpochMaximum,
    /// The largest value in any view since the last reset, or since the row was created.
    Maximum,
    /// The smallest value in any view in which the row was visible, over the same time; +∞ if there was none.
    Minimum,
    /// Computed from the current parameters or age of the row; needs no memory.
    Current,
    /// Current parameters of the row, as many numbers as given, copied only at events; needs no memory in between.
    Attribute(usize),
}

/// A quantity that the backward pass must sum over the pixels of each row for a signal. Training does not need
/// it; it costs memory and time for every (row, tile) pair.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PixelSum {
    /// |dL/d(projected mean)| per axis.
    AbsGradient,
    /// The blend weight α·T.
    Weight,
    /// 1 per pixel that the row was blended into.
    Count,
    /// The maximum of the blend weight α·T, instead of a sum.
    LargestWeight,
    /// The blend weight α·T times the error of the pixel.
    WeightedError,
}

/// Declares the signals, each with name, kind, unit and pixel sums.
macro_rules! signals {
    ($(
        $(#[doc = $doc:literal])*
        $name:ident: $kind:ident $(($width:literal))? $unit:literal [$($sum:ident),*];
    )*) => {
        /// A statistic of each row that a policy may read: one or [several](Self::width) `f32`.
        #[derive(
            Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize,
        )]
        #[serde(rename_all = "snake_case")]
        pub enum Signal {
            $($(#[doc = $doc])* $name,)*
        }

        impl Signal {
            /// All signals, in declaration order; `Signal::ALL[s as usize] == s`.
            pub const ALL: [Self; [$(stringify!($name)),*].len()] = [$(Self::$name),*];

            /// The kind of the signal.
            pub const fn kind(self) -> SignalKind {
                match self {
                    $(Self::$name => SignalKind::$kind $(($width))?,)*
                }
            }

            /// The meaning: the documentation of the variant, with its links.
            pub const fn meaning(self) -> &'static str {
                match self {
                    $(Self::$name => concat!($($doc),*),)*
                }
            }

            /// The unit; `1` for none.
            pub const fn unit(self) -> &'static str {
                match self {
                    $(Self::$name => $unit,)*
                }
            }

            /// The additional sums in the backward pass that the signal needs.
            pub const fn pixel_sums(self) -> &'static [PixelSum] {
                match self {
                    $(Self::$name => &[$(PixelSum::$sum),*],)*
                }
            }
        }
    };
}

signals! {
    /// Number of views whose image the row's projection overlaps, >= 0.
    VisibleCount: Count "views" [];
    /// Sum over views of ‖dL/d(mean in NDC)‖₂, >= 0. NDC gradient = pixel gradient · (W/2, H/2).
    /// [`Needs::full_depth`](crate::policy::Needs::full_depth) reduces the weight of near views in this sum, in
    /// [`ScreenGradientAbs`](Self::ScreenGradientAbs) and in [`ColourGradient`](Self::ColourGradient).
    ScreenGradient: Sum "1" [];
    /// Sum over views of ‖Σ over pixels |dL/d(mean in NDC)|‖₂ (absolute per axis, AbsGS), >= 0.
    ScreenGradientAbs: Sum "1" [AbsGradient];
    /// Sum over views of ‖dL/dc‖₂, >= 0, where c is the row's view-dependent colour as blended. Ignores the clamp
    /// at 0, so that a row clamped to black also has a gradient.
    ColourGradient: Sum "1" [];
    /// x of the sum over views of dL/d(mean) `[1 / scene units]`.
    MeanGradientX: Sum "1 / scene units" [];
    /// y of the sum over views of dL/d(mean) `[1 / scene units]`.
    MeanGradientY: Sum "1 / scene units" [];
    /// z of the sum over views of dL/d(mean) `[1 / scene units]`.
    MeanGradientZ: Sum "1 / scene units" [];
    /// Sum over views of ‖dL/d(mean)‖₂ `[1 / scene units]`, >= 0.
    MeanGradientNorm: Sum "1 / scene units" [];
    /// Largest blend weight α·T over all pixels of the previous and the current epoch, in `[0, 1]`.
    WeightMax: EpochMaximum "1" [LargestWeight];
    /// Sum of the blend weights α·T over all pixels, >= 0.
    WeightSum: Sum "pixels" [Weight];
    /// Number of pixels the row was blended into, >= 0.
    PixelCount: Count "pixels" [Count];
    /// Sum over all pixels of α·T·e, >= 0, where e is the pixel's contribution to the training loss:
    /// 0.8·|I − G| + 0.2·(1 − SSIM), averaged over channels. Divided by
    /// [`WeightSum`](Self::WeightSum) it is the mean error where the row is visible. The error map and pixel
    /// weights of [`Needs::error_score`](crate::policy::Needs::error_score) apply to this sum, too.
    WeightedError: Sum "pixels" [WeightedError];
    /// Sum over views of the row's error score, >= 0, as defined by [`ErrorScore`](crate::policy::ErrorScore).
    ErrorScore: Sum "1" [Weight, WeightedError];
    /// Sum over views of √w, >= 0, where w is the row's largest blend weight α·T in the view. Divided by
    /// [`VisibleCount`](Self::VisibleCount) it tells how much a row matters in all views that see it,
    /// whereas a single view determines [`WeightMax`](Self::WeightMax).
    WeightMaxRoot: Sum "1" [LargestWeight];
    /// Number of views in which the row's largest blend weight α·T is at least [`SUPPORT_WEIGHT`].
    Support: Count "views" [LargestWeight];
    /// Smallest camera depth of the mean `[scene units]`, > 0.
    DepthMin: Minimum "scene units" [];
    /// Smallest width of a pixel at the depth of the mean, depth / focal length `[scene units]`, > 0.
    PixelSizeMin: Minimum "scene units" [];
    /// Largest share of a view's pixels, in `[0, 1]`, that the row dominates: no other row has a larger blend
    /// weight there.
    DominantPixels: Maximum "image" [];
    /// Current opacity, in (0, 1).
    Opacity: Current "1" [];
    /// Largest of the three current standard deviations `[scene units]`, > 0.
    ScaleMax: Current "scene units" [];
    /// Product of the three current standard deviations `[scene units³]`, >= 0.
    ScaleProduct: Current "scene units³" [];
    /// Current σ(m) of the row's [mask](crate::policy::MaskTerm), in `[0, 1]`; only if a mask is declared.
    Mask: Current "1" [];
    /// Optimiser steps since the row was created or rewritten, saturating at 65,535.
    Age: Current "steps" [];
    /// Current mean `[scene units]`, in the world coordinates used for training. Their origin is the mean of
    /// the training cameras, and the unit is the distance of the farthest camera, ignoring a few that are far
    /// from all others; if all cameras coincide, it is the median distance of the points. The axes are parallel
    /// to the dataset's. See [`Snapshot::positions`](crate::policy::Snapshot::positions).
    Position: Attribute(3) "scene units" [];
    /// Natural logarithms of the three current standard deviations `[ln scene units]`, along the axes of
    /// [`Orientation`](Self::Orientation).
    LogScale: Attribute(3) "ln scene units" [];
    /// Current orientation: a quaternion q = (w, x, y, z) of any length but 0. The columns of its
    /// rotation matrix R(q) are the row's axes in scene coordinates.
    Orientation: Attribute(4) "1" [];
    /// Current base colour (band 0): red, green and blue, sRGB-encoded; not bounded to `[0, 1]`.
    Colour: Attribute(3) "1" [];
}

/// Smallest blend weight that counts for [`Signal::Support`].
pub const SUPPORT_WEIGHT: f32 = 0.02;

impl Signal {
    /// True if the signal accumulates until a policy [resets](crate::plan::Reset) it.
    pub const fn is_resettable(self) -> bool {
        matches!(
            self.kind(),
            SignalKind::Sum | SignalKind::Count | SignalKind::Maximum | SignalKind::Minimum
        )
    }

    /// Numbers per row.
    pub const fn width(self) -> usize {
        match self.kind() {
            SignalKind::Attribute(width) => width,
            _ => 1,
        }
    }
}

/// A set of [`Signal`]s.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct SignalSet(u32);

impl SignalSet {
    /// This set with `signal`.
    #[must_use]
    pub fn with(self, signal: Signal) -> Self {
        Self(self.0 | 1 << signal as u32)
    }

    /// The signals of either set.
    #[must_use]
    pub fn union(self, other: Self) -> Self {
        Self(self.0 | other.0)
    }

    /// True if the set is empty.
    pub fn is_empty(self) -> bool {
        self.0 == 0
    }

    /// True if `signal` is in the set.
    pub fn contains(self, signal: Signal) -> bool {
        self.0 & (1 << signal as u32) != 0
    }

    /// Number of signals in the set.
    pub fn count(self) -> usize {
        self.0.count_ones() as usize
    }

    /// Numbers per row of all signals in the set.
    pub fn width(self) -> usize {
        self.iter().map(Signal::width).sum()
    }

    /// The signals in the set, in declaration order.
    pub fn iter(self) -> impl Iterator<Item = Signal> {
        Signal::ALL.into_iter().filter(move |&s| self.contains(s))
    }
}

impl FromIterator<Signal> for SignalSet {
    fn from_iter<I: IntoIterator<Item = Signal>>(signals: I) -> Self {
        signals.into_iter().fold(Self::default(), Self::with)
    }
}

impl<const N: usize> From<[Signal; N]> for SignalSet {
    fn from(signals: [Signal; N]) -> Self {
        signals.into_iter().collect()
    }
}

/// The values of some signals at one step.
#[derive(Debug, Clone, Default)]
pub struct Signals {
    rows: usize,
    set: SignalSet,
    /// Columns, one after another in declaration order. Shape: `[set, rows, width]`.
    values: Vec<f32>,
}

impl Signals {
    /// Columns for `set`, all zero, of shape `[rows, width]` each.
    pub fn zeros(rows: usize, set: SignalSet) -> Self {
        Self::zeros_in(Vec::new(), rows, set)
    }

    /// Like [`zeros`](Self::zeros), in the allocation of `values`, whose contents are discarded.
    pub fn zeros_in(mut values: Vec<f32>, rows: usize, set: SignalSet) -> Self {
        values.clear();
        values.resize(rows * set.width(), 0.0);
        Self { rows, set, values }
    }

    /// The allocation of all columns, for reuse.
    pub fn into_values(self) -> Vec<f32> {
        self.values
    }

    /// Number of rows.
    pub fn rows(&self) -> usize {
        self.rows
    }

    /// The column of `signal`, if the set contains it. Shape: `[rows, width]`.
    pub fn get(&self, signal: Signal) -> Option<&[f32]> {
        self.range(signal).map(|range| &self.values[range])
    }

    /// The column of `signal` for writing, if the set contains it. Shape: `[rows, width]`.
    pub fn get_mut(&mut self, signal: Signal) -> Option<&mut [f32]> {
        self.range(signal).map(|range| &mut self.values[range])
    }

    /// Removes the first `rows` rows in place.
    ///
    /// # Panics
    /// When there are fewer than `rows`.
    #[must_use]
    pub fn without_first(mut self, rows: usize) -> Self {
        assert!(rows <= self.rows, "without {rows} of {} rows", self.rows);
        if rows == 0 {
            return self;
        }
        let rows_left = self.rows - rows;
        let (mut from, mut to) = (0, 0);
        for width in self.set.iter().map(Signal::width) {
            self.values.copy_within(from + width * rows..from + width * self.rows, to);
            from += width * self.rows;
            to += width * rows_left;
        }
        self.values.truncate(to);
        self.rows = rows_left;
        self
    }

    fn range(&self, signal: Signal) -> Option<Range<usize>> {
        let mut start = 0;
        for column in self.set.iter() {
            let end = start + column.width() * self.rows;
            if column == signal {
                return Some(start..end);
            }
            start = end;
        }
        None
    }
}

/// A per-row statistic of one auxiliary view. Sums and maxima run over the pixels that the row was
/// blended into; all columns are 0 for rows that are not on screen.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum AuxColumn {
    /// Sum of the values of the [pixel map](crate::policy::PixelMap), not weighted by alpha, >= 0.
    MapSum,
    /// Number of pixels, >= 0.
    PixelCount,
    /// Sum of the blend weights α·T, >= 0.
    WeightSum,
    /// Sum of the distances from the pixel's centre to the projected mean `[px]`, >= 0.
    DistanceSum,
    /// Largest blend weight α·T, in `[0, 1]`.
    WeightMax,
    /// Number of pixels in which no other row has a larger blend weight, >= 0.
    DominantPixels,
    /// Sum of the blend weights α·T over pixels whose surface lies behind the row's mean, by more than the
    /// [margin](crate::policy::AuxRequest::margin), >= 0. The surface is the given depth if the run trains on depth
    /// and it is known at the pixel, or else the depth of the row at which transmittance falls below ½. Divided by
    /// [`WeightSum`](Self::WeightSum) it is the share of the row's weight before the surface.
    WeightInFront,
    /// Camera z of the mean `[scene units]`.
    Depth,
    /// Radius on screen, three standard deviations along the longer axis, rounded up `[px]`.
    Radius,
}

impl AuxColumn {
    /// All columns, in declaration order.
    pub const ALL: [Self; 9] = [
        Self::MapSum,
        Self::PixelCount,
        Self::WeightSum,
        Self::DistanceSum,
        Self::WeightMax,
        Self::DominantPixels,
        Self::WeightInFront,
        Self::Depth,
        Self::Radius,
    ];
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn all_lists_every_signal_in_order() {
        for (index, signal) in Signal::ALL.into_iter().enumerate() {
            assert_eq!(signal as usize, index);
        }
        assert_eq!(SignalSet::from(Signal::ALL).iter().collect::<Vec<_>>(), Signal::ALL);
    }

    #[test]
    fn a_set_contains_the_signals_added_to_it() {
        let set = SignalSet::from([Signal::Age, Signal::VisibleCount]).with(Signal::Opacity);
        let listed: Vec<Signal> = set.iter().collect();
        assert_eq!(listed, [Signal::VisibleCount, Signal::Opacity, Signal::Age]);
        assert_eq!(set.with(Signal::Age), set);
        assert!(!set.contains(Signal::WeightMax) && !SignalSet::default().contains(Signal::Age));
    }

    #[test]
    fn columns_have_the_width_of_their_signal_and_do_not_overlap() {
        let set =
            SignalSet::from([Signal::Age, Signal::Orientation, Signal::Position, Signal::Colour]);
        let mut signals = Signals::zeros(2, set);
        for (signal, value) in set.iter().zip(1_u8..) {
            signals.get_mut(signal).unwrap().fill(f32::from(value));
        }
        for (signal, value) in set.iter().zip(1_u8..) {
            assert_eq!(signals.get(signal).unwrap(), vec![f32::from(value); 2 * signal.width()]);
        }
        assert_eq!((set.width(), signals.into_values().len()), (11, 22));
    }
}
