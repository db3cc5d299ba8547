//! A limit of rows that rises while rows pay: `--budget auto`.
//!
//! The run is cut into rungs. At the end of each the limit rises by half a doubling, within the
//! budget; policies are told the limit as their budget, and plans keep it as they keep a budget, so
//! that no policy need know. The probes are measured in the middle and at the end of each rung.
//! Between the ends of two rungs they gain by rows, and by training as such. The latter is taken from
//! the second half of the rung before, during which no row was added, and carried on with the
//! logarithm of the step. What is left, per doubling of rows, is what rows have brought.
//!
//! Growth stops when the lower end of its 95 % interval has been below [`PAYS`] twice in a row: more
//! rows have to be shown to pay. Then, at the end of each rung, the tenth of the rows that weighs
//! least in any view is hidden; where the probes lose less than [`LOSES`], it is removed, and tried
//! again, else all stay.

use densify_policies::plan::{EditPlan, OpacityRule, ScaleRule, Update};
use densify_policies::policy::{Needs, Signal, SignalSet};
use serde::{Deserialize, Serialize};

use super::probe::mean_of;
use super::{EditEvent, TrainError, Trainer};
use crate::schedule::scaled;
use crate::views::ViewSource;

/// What a doubling of rows must bring `[dB]`.
pub const PAYS: f64 = 0.10;
/// What removing the least tenth may cost `[dB]`.
const LOSES: f64 = 0.02;
/// Steps of a rung in a run of 30,000: ten rungs, or five doublings, until most policies stop to grow.
const RUNG: u32 = 1_500;
/// Rungs are whole multiples of this: policies are due every 100 steps at most.
const LEAST_RUNG: u32 = 100;
/// Rows grow by this factor at each rung.
const FACTOR: f64 = std::f64::consts::SQRT_2;
/// Doublings below which a rung says nothing.
const LEAST_GROWTH: f64 = 0.25;
/// Fewer rows are no limit.
const LEAST_ROWS: usize = 1_000;
/// The share of the run after which rows are not removed any more: those that stay must settle.
const LAST_SHRINK: f64 = 0.8;
/// An opacity that no pixel shows.
const HIDDEN: f32 = 1e-6;

/// What signals the limit needs of a backend, beside the policy's.
#[must_use]
pub fn signals() -> SignalSet {
    SignalSet::of(&[Signal::WeightMax, Signal::Opacity])
}

/// A limit that rises while rows pay.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Growth {
    /// Most rows now.
    pub limit: usize,
    /// The step at which growth was stopped, if it was.
    pub stopped: Option<u32>,
    /// Ends of rungs so far.
    pub rungs: Vec<Rung>,
    /// Attempts to do with fewer rows.
    pub shrinks: Vec<Shrink>,
    /// PSNR of each probe in the middle of this rung `[dB]`.
    middle: Vec<f64>,
    /// The same in the middle and at the end of the rung before.
    before: [Vec<f64>; 2],
    /// Rungs in a row that did not pay.
    idle: u32,
}

/// The end of a rung.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Rung {
    /// Iteration.
    pub step: u32,
    /// Rows during its second half.
    pub rows: usize,
    /// Mean PSNR of the probes `[dB]`.
    pub psnr: f64,
    /// What the rows that it added have brought, with the lower end of the 95 % interval
    /// `[dB per doubling]`; `None` where there were hardly any.
    pub gain: Option<[f64; 2]>,
}

/// An attempt to do with fewer rows.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Shrink {
    /// Iteration.
    pub step: u32,
    /// Rows before.
    pub before: usize,
    /// Rows without the least tenth.
    pub after: usize,
    /// What that changes in the probes, at once `[dB]`.
    pub change: f64,
    /// Whether they were removed.
    pub kept: bool,
}

impl Growth {
    pub(super) fn new(rows: usize, budget: usize) -> Self {
        Self { limit: rows.max(LEAST_ROWS).min(budget), ..Self::default() }
    }

    /// Takes the end of a rung into account: whether rows have paid, and what the limit is now.
    fn judge(&mut self, (step, length): (u32, u32), rows: usize, end: Vec<f64>, budget: usize) {
        let rows_before = self.rungs.last().map(|rung| rung.rows);
        let doublings =
            rows_before.map_or(0.0, |before| (rows as f64 / before.max(1) as f64).log2());
        let [middle, last] = &self.before;
        let judged =
            doublings >= LEAST_GROWTH && middle.len() == end.len() && last.len() == end.len();
        let gain = judged.then(|| {
            // Half a rung of training before this one, carried on over this one.
            let (now, length) = (f64::from(step), f64::from(length));
            let later = (now / (now - length)).ln();
            let earlier = ((now - length) / (now - 1.5 * length)).ln();
            let trend = later / earlier;
            let brought = end.iter().zip(last).zip(middle);
            let brought: Vec<f64> = brought
                .map(|((end, last), middle)| (end - last - trend * (last - middle)) / doublings)
                .collect();
            let (mean, half) = mean_of(&brought);
            [mean, mean - half]
        });
        if let Some([_, low]) = gain {
            self.idle = if low < PAYS { self.idle + 1 } else { 0 };
        }
        self.rungs.push(Rung { step, rows, psnr: mean_of(&end).0, gain });
        self.before = [std::mem::take(&mut self.middle), end];
        if self.idle >= 2 {
            self.stopped = Some(step);
            self.limit = rows;
        } else {
            let wanted = (self.limit as f64 * FACTOR).round() as usize;
            self.limit = wanted.min(budget);
        }
    }

    /// Whether the least rows may be removed at the end of a rung.
    fn may_shrink(&self, step: u32, iterations: u32) -> bool {
        let grown = self.stopped.is_some() || step >= iterations / 2;
        let late = f64::from(step) > LAST_SHRINK * f64::from(iterations);
        grown && !late && self.shrinks.last().is_none_or(|shrink| shrink.kept)
    }
}

/// Steps of a rung.
fn rung(iterations: u32) -> u32 {
    scaled(RUNG, iterations).next_multiple_of(LEAST_RUNG)
}

impl<V: ViewSource> Trainer<V> {
    /// The most rows that a plan may lead to now.
    pub(super) fn limit(&self) -> usize {
        let budget = self.backend.budget();
        self.growth.as_ref().map_or(budget, |growth| growth.limit.min(budget))
    }

    /// Measures, raises the limit, or removes rows, where `step` is due for it.
    pub(super) fn watch_growth(&mut self, step: u32) -> Result<Option<EditEvent>, TrainError> {
        let iterations = self.options.iterations;
        let length = rung(iterations);
        let (ends, halves) = (step.is_multiple_of(length), step.is_multiple_of(length / 2));
        if self.probes.is_empty() || !halves || step > iterations {
            return Ok(None);
        }
        let Some(mut growth) = self.growth.take() else { return Ok(None) };
        let (rows, budget) = (self.backend.rows(), self.backend.budget());
        let mut event = None;
        if growth.stopped.is_none() {
            let measured = self.probe(step, self.sh_degree(step))?;
            if ends {
                growth.judge((step, length), rows, measured, budget);
                if let Some(Rung { psnr, gain, .. }) = growth.rungs.last() {
                    let limit = growth.limit;
                    tracing::info!(step, rows, psnr, ?gain, limit, "end of a rung");
                }
            } else {
                growth.middle = measured;
            }
        }
        if ends && growth.may_shrink(step, iterations) {
            let (shrink, done) = self.shrink(step)?;
            if let Some(shrink) = shrink {
                growth.shrinks.push(shrink);
            }
            if done.is_some() {
                growth.stopped.get_or_insert(step);
                growth.limit = self.backend.rows();
            }
            event = done;
        }
        self.growth = Some(growth);
        Ok(event)
    }

    /// Hides the tenth of the rows that weighs least; removes it if that hardly shows.
    fn shrink(&mut self, step: u32) -> Result<(Option<Shrink>, Option<EditEvent>), TrainError> {
        let needs = Needs { signals: signals(), ..Needs::default() };
        let taken = self.backend.take_signals(&needs).map_err(|e| self.stopped(step, e))?;
        let (signals, _) = taken;
        let (Some(weights), Some(opacities)) =
            (signals.get(Signal::WeightMax), signals.get(Signal::Opacity))
        else {
            return Ok((None, None));
        };
        let before = self.backend.rows();
        let mut least: Vec<u32> = (0..before as u32).collect();
        least.sort_by(|&a, &b| weights[a as usize].total_cmp(&weights[b as usize]));
        least.truncate(before / 10);
        if least.is_empty() {
            return Ok((None, None));
        }
        let degree = self.sh_degree(step);
        let shown = self.probe(step, degree)?;
        self.set_opacities(step, &least, |_| HIDDEN)?;
        let hidden = self.probe(step, degree)?;
        self.set_opacities(step, &least, |row| opacities[row as usize])?;
        let changes: Vec<f64> = hidden.iter().zip(&shown).map(|(a, b)| a - b).collect();
        let (change, _) = mean_of(&changes);
        let kept = change > -LOSES;
        let shrink = Shrink { step, before, after: before - least.len(), change, kept };
        tracing::info!(step, before, after = shrink.after, change, kept, "fewer rows");
        if !kept {
            return Ok((Some(shrink), None));
        }
        let mut plan = EditPlan::new(before, self.limit());
        plan.cause("the least tenth is not missed");
        for row in least {
            // Never refused: each row once.
            let _ = plan.prune(row);
        }
        Ok((Some(shrink), self.execute(step, plan)?))
    }

    /// Gives rows other opacities and nothing else; no event.
    fn set_opacities(
        &mut self,
        step: u32,
        rows: &[u32],
        opacity: impl Fn(u32) -> f32,
    ) -> Result<(), TrainError> {
        let mut plan = EditPlan::new(self.backend.rows(), self.backend.budget());
        for &row in rows {
            let value = opacity(row).clamp(HIDDEN, 1.0 - f32::EPSILON);
            let update = Update {
                opacity: OpacityRule::Set(value),
                scale: ScaleRule::Uniform(1.0),
                keep_moments: true,
            };
            let _ = plan.update(row, update);
        }
        let ops = plan.compile();
        self.backend.apply(&ops, self.options.seed, step).map_err(|e| self.stopped(step, e))
    }
}

#[cfg(test)]
mod tests;
