//! The automatic budget: a limit on the number of rows that rises while more rows improve the images, and falls while
//! rows can be removed at almost no cost in PSNR.
//!
//! The run is divided into intervals. At the end of each, before the policy's edit, the PSNR of a few training views
//! (the probe views) is measured. In the first half of the run the limit then rises by a factor of √2, up to the
//! budget. Policies receive the limit as their budget, and plans enforce it, so policies need not know about it. The
//! gain of a doubling is the slope of the PSNR over log2(rows), fitted to the last three intervals. Growth stops when
//! the gain has been below [`MIN_GAIN`] twice in a row. The gain includes the improvement by training alone, so growth
//! stops too late rather than too early.
//!
//! Some edits reduce the PSNR for a while, such as inserting rows or resetting opacities. If the PSNR is more than
//! [`MAX_DROP`] below the best of the last [`RECENT`] intervals, the interval is not evaluated: the limit stays the
//! same, and no row is removed.
//!
//! After growth, rows with low weights are pruned. At the end of each later interval the rows are sorted by their
//! largest blend weight in any view. Tenths of them are hidden one after another and removed as long as the PSNR falls
//! by less than [`MIN_GAIN`] per halving. The comparison uses the same model at the same step, so it has no noise. It
//! overestimates the fall, because the remaining rows will adapt.
//!
//! Measuring does not change the model or any other state: rows are hidden only by their opacity logits, which are
//! restored.

mod measure;
mod probe_views;

use densify_policies::policy::{Signal, SignalSet};
use serde::{Deserialize, Serialize};

use crate::schedule::scaled;
pub(super) use probe_views::probe_views;

/// PSNR that a doubling of rows must gain `[dB]`.
pub const MIN_GAIN: f64 = 0.10;
/// Drop of the PSNR below the recent best beyond which the model counts as recovering from an edit `[dB]`. The probe
/// views are always the same; with random views the noise would be larger than this.
const MAX_DROP: f64 = 0.5;
/// Number of intervals after which a drop counts as permanent. The insertions of `diet` take a sixth of a run, which is
/// less than four intervals.
const RECENT: usize = 6;
/// Number of steps per interval in a run of 30,000 steps. Most policies stop growing halfway through the run: after ten
/// intervals, or five doublings.
const INTERVAL: u32 = 1_500;
/// Intervals are multiples of this number of steps, because policies are due at most every 100 steps.
const INTERVAL_UNIT: u32 = 100;
/// Growth of the limit per interval.
const GROWTH_FACTOR: f64 = std::f64::consts::SQRT_2;
/// Smallest initial limit.
const MIN_LIMIT: usize = 1_000;
/// Number of settled intervals to which the slope is fitted.
const FITTED: usize = 3;
/// Fraction of the run after which no rows are removed, so that the remaining rows can adapt.
const LAST_REMOVAL: f64 = 0.8;
/// Largest number of tenths of the rows that are removed at once.
const MAX_TENTHS: usize = 5;
/// The logit of an opacity of 1e-6, which is invisible.
const HIDDEN_LOGIT: f32 = -13.8;

/// The signals that the automatic budget needs from a backend, in addition to the policy's.
pub fn growth_signals() -> SignalSet {
    SignalSet::from([Signal::WeightMax])
}

/// The row limit, and the measurements that determine it.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct AutoBudget {
    /// Current limit on the number of rows.
    pub limit: usize,
    /// The step at which growth stopped, if it has.
    pub stopped: Option<u32>,
    /// The intervals measured so far.
    pub intervals: Vec<Interval>,
    /// Attempts to remove rows.
    pub removals: Vec<Removal>,
    /// Number of consecutive intervals with a gain below [`MIN_GAIN`].
    pub idle: u32,
}

/// The measurement at the end of an interval.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Interval {
    /// Iteration.
    pub step: u32,
    /// Number of rows before the policy's edit.
    pub rows: usize,
    /// Mean PSNR of the probe views `[dB]`.
    pub psnr: f64,
    /// True if the PSNR is near its recent best; otherwise the interval is not evaluated.
    pub settled: bool,
    /// Gain over the last three settled intervals including this one, with the effect of training `[dB per doubling]`.
    /// `None` if there are fewer than three, if their numbers of rows are too similar, or after growth.
    pub gain: Option<f64>,
}

/// An attempt to remove rows.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Removal {
    /// Iteration.
    pub step: u32,
    /// Rows before.
    pub before: usize,
    /// Rows after; as many as before if removing a tenth would cost too much.
    pub after: usize,
    /// Immediate change of the probe views' PSNR `[dB]`; if no row was removed, the change without a tenth of the rows.
    pub change: f64,
}

impl AutoBudget {
    pub(super) fn new(rows: usize, budget: usize) -> Self {
        Self { limit: rows.max(MIN_LIMIT).min(budget), ..Self::default() }
    }

    /// Records the end of an interval; returns whether it is settled.
    fn record(&mut self, step: u32, rows: usize, psnr: f64) -> bool {
        let recent = self.intervals.iter().rev().take(RECENT);
        let best = recent.map(|interval| interval.psnr).fold(f64::NEG_INFINITY, f64::max);
        let settled = psnr >= best - MAX_DROP;
        self.intervals.push(Interval { step, rows, psnr, settled, gain: None });
        settled
    }

    /// Raises the limit or stops growth, after a settled interval.
    fn update_limit(&mut self, budget: usize) {
        let settled = self.intervals.iter().rev().filter(|interval| interval.settled);
        let gain = slope(&settled.take(FITTED).copied().collect::<Vec<_>>());
        let Some(interval) = self.intervals.last_mut() else { return };
        interval.gain = gain;
        let Interval { step, rows, .. } = *interval;
        // If the number of rows is far below the limit, a higher limit would have no effect.
        let is_full = rows as f64 * GROWTH_FACTOR.sqrt() >= self.limit as f64;
        let is_idle = is_full && gain.is_some_and(|gain| gain < MIN_GAIN);
        self.idle = if is_idle { self.idle + 1 } else { 0 };
        if self.idle >= 2 {
            self.stopped = Some(step);
            self.limit = rows.max(1);
        } else {
            self.limit = ((self.limit as f64 * GROWTH_FACTOR).round() as usize).min(budget);
        }
    }

    /// True if rows may be removed at the end of an interval.
    fn may_remove(&self, step: u32, iterations: u32) -> bool {
        let grown = self.stopped.is_some() || step > iterations / 2;
        grown && f64::from(step) <= LAST_REMOVAL * f64::from(iterations)
    }
}

/// The slope of PSNR over log2(rows) `[dB per doubling]`, by least squares; `None` if it cannot be fitted.
fn slope(intervals: &[Interval]) -> Option<f64> {
    let count = intervals.len() as f64;
    let doublings = |interval: &Interval| (interval.rows.max(1) as f64).log2();
    let x = intervals.iter().map(doublings).sum::<f64>() / count;
    let y = intervals.iter().map(|interval| interval.psnr).sum::<f64>() / count;
    let variance: f64 = intervals.iter().map(|i| (doublings(i) - x).powi(2)).sum();
    let covariance: f64 = intervals.iter().map(|i| (doublings(i) - x) * (i.psnr - y)).sum();
    // The variance must exceed that of three equally spaced points that span a quarter of a doubling.
    let is_enough = intervals.len() == FITTED && variance > 2.0 * 0.125_f64.powi(2);
    is_enough.then(|| covariance / variance)
}

/// Fall of the PSNR that is accepted for removing this many tenths of the rows `[dB]`.
fn allowed_fall(tenths: usize) -> f64 {
    MIN_GAIN * (10.0 / (10.0 - tenths as f64)).log2()
}

/// Length of an interval `[steps]`.
fn interval_steps(iterations: u32) -> u32 {
    scaled(INTERVAL, iterations).next_multiple_of(INTERVAL_UNIT)
}

#[cfg(test)]
mod tests;
