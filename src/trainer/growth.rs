//! A limit of rows that rises while rows pay: `--budget auto`.
//!
//! The run is cut into rungs. At the end of each, before the policy's edit, the tenth of the rows that
//! weighs least in any view is hidden, and the probes are rendered with and without it. That is what
//! the last rows bring, on one model at one step: the difference does not hold what training brings
//! meanwhile, which is larger and cannot be told from what growth brings where both are read off the
//! same curve. Per doubling of rows it is 1 / log2(10 / 9) = 6.6 times as much. Rows are not trained
//! anew without the tenth, so that it is rather too large than too small.
//!
//! While growth goes on, the limit then rises by half a doubling, within the budget; policies are told
//! the limit as their budget, and plans keep it as they keep a budget, so that no policy need know.
//! Growth stops when the lower end of the 95 % interval has been below [`PAYS`] twice in a row: more
//! rows have to be shown to pay. After it the tenth is removed where the probes lose less than
//! [`LOSES`] by that, and the next one is tried at the end of the next rung; else all stay.

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
    /// Rungs in a row that did not pay.
    pub idle: u32,
}

/// The end of a rung.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Rung {
    /// Iteration.
    pub step: u32,
    /// Rows, before the policy's edit.
    pub rows: usize,
    /// Mean PSNR of the probes `[dB]`.
    pub psnr: f64,
    /// What the least tenth of the rows brings, with the lower end of the 95 % interval
    /// `[dB per doubling]`.
    pub gain: [f64; 2],
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

    /// Takes the end of a rung into account: what the probes show with all rows, and without the least
    /// tenth.
    fn judge(&mut self, step: u32, rows: usize, [all, fewer]: [&[f64]; 2], budget: usize) {
        let doublings = (rows as f64 / (rows - tenth(rows)) as f64).log2();
        let brought: Vec<f64> = all.iter().zip(fewer).map(|(a, b)| (a - b) / doublings).collect();
        let (mean, half) = mean_of(&brought);
        let gain = [mean, mean - half];
        // A limit that rows do not come near says nothing about more of them.
        let is_full = rows as f64 * FACTOR.sqrt() >= self.limit as f64;
        self.idle = if gain[1] < PAYS && is_full { self.idle + 1 } else { 0 };
        self.rungs.push(Rung { step, rows, psnr: mean_of(all).0, gain });
        if self.idle >= 2 {
            self.stopped = Some(step);
            self.limit = rows.max(1);
        } else {
            self.limit = ((self.limit as f64 * FACTOR).round() as usize).min(budget);
        }
    }

    /// Whether the least rows may be removed at the end of a rung.
    fn may_shrink(&self, step: u32, iterations: u32) -> bool {
        let grown = self.stopped.is_some() || step > iterations / 2;
        let late = f64::from(step) > LAST_SHRINK * f64::from(iterations);
        grown && !late && self.shrinks.last().is_none_or(|shrink| shrink.kept)
    }
}

/// The rows that are hidden.
fn tenth(rows: usize) -> usize {
    rows / 10
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
        let due = step.is_multiple_of(rung(iterations)) && step <= iterations;
        let Some(mut growth) = self.growth.clone().filter(|_| due && !self.probes.is_empty())
        else {
            return Ok(None);
        };
        let grows = growth.stopped.is_none() && step <= iterations / 2;
        let shrinks = growth.may_shrink(step, iterations);
        let (rows, budget) = (self.backend.rows(), self.backend.budget());
        if !(grows || shrinks) || tenth(rows) == 0 {
            return Ok(None);
        }
        let (least, [all, fewer]) = self.without_least(step)?;
        let mut event = None;
        if grows {
            growth.judge(step, rows, [&all, &fewer], budget);
            if let Some(Rung { psnr, gain: [gain, low], .. }) = growth.rungs.last() {
                let limit = growth.limit;
                tracing::info!(step, rows, psnr, gain, low, limit, "end of a rung");
            }
        } else {
            let changes: Vec<f64> = fewer.iter().zip(&all).map(|(a, b)| a - b).collect();
            let (change, _) = mean_of(&changes);
            let (after, kept) = (rows - least.len(), change > -LOSES);
            tracing::info!(step, before = rows, after, change, kept, "fewer rows");
            growth.shrinks.push(Shrink { step, before: rows, after, change, kept });
            growth.stopped.get_or_insert(step);
            growth.limit = rows.max(1);
            if kept {
                let mut plan = EditPlan::new(rows, self.limit());
                plan.cause("the least tenth is not missed");
                for row in least {
                    // Never refused: each row once.
                    let _ = plan.prune(row);
                }
                event = self.execute(step, plan)?;
                growth.limit = self.backend.rows();
            }
        }
        self.growth = Some(growth);
        Ok(event)
    }

    /// The tenth of the rows that weighs least, and the PSNR of the probes with and without it.
    fn without_least(&mut self, step: u32) -> Result<(Vec<u32>, [Vec<f64>; 2]), TrainError> {
        let needs = Needs { signals: signals(), ..Needs::default() };
        let taken = self.backend.take_signals(&needs).map_err(|e| self.stopped(step, e))?;
        let of = |signal| taken.0.get(signal).unwrap_or_default();
        let (weights, opacities) = (of(Signal::WeightMax), of(Signal::Opacity));
        let mut least: Vec<u32> = (0..weights.len() as u32).collect();
        least.sort_by(|&a, &b| weights[a as usize].total_cmp(&weights[b as usize]));
        least.truncate(tenth(weights.len()));
        let degree = self.sh_degree(step);
        let all = self.probe(step, degree)?;
        self.set_opacities(step, &least, |_| HIDDEN)?;
        let fewer = self.probe(step, degree)?;
        self.set_opacities(step, &least, |row| opacities[row as usize])?;
        Ok((least, [all, fewer]))
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
