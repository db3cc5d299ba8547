//! A limit of rows that rises while rows pay, and falls while rows are not missed: `--budget auto`.
//!
//! The run is cut into rungs, and some training views, the probes, are measured at the end of each,
//! before the policy's edit. In the first half of the run the limit then rises by half a doubling,
//! within the budget; policies are told the limit as their budget, and plans keep it as they keep a
//! budget, so that no policy need know. What a doubling has brought is the slope of the probes' PSNR
//! over log2(rows), fitted to the last three rungs. Training brings something meanwhile, too, which
//! cannot be told from it: the slope is rather too large, so that growth stops too late rather than too
//! early. It stops when the slope has been below [`PAYS`] twice in a row.
//!
//! Policies also do what makes images worse for a while: they insert rows, or reset opacities. Where
//! the probes are worse by more than [`UNSETTLED`] than at the best of the last [`REMEMBERED`] rungs,
//! nothing is concluded: the rung has no slope, the limit stays, and no row is removed.
//!
//! What growth has let in is sent out again. At the end of each later rung the rows are ordered by the
//! largest weight that they have in any view; as many tenths of them as the probes miss, at once, by
//! less than [`PAYS`] per doubling are removed. On one model at one step the difference is free of
//! noise, and as the rows that stay learn to fill in, it is rather too large.
//!
//! Measuring leaves the model and all that its future depends on as they were, to the bit: rows are
//! hidden by their opacity logits alone, which are then written back as they were read.

use densify_policies::plan::EditPlan;
use densify_policies::policy::{Signal, SignalSet};
use serde::{Deserialize, Serialize};

use super::probe::mean;
use super::{EditEvent, TrainError, Trainer};
use crate::backend::pieces;
use crate::gaussians::ModelArray;
use crate::schedule::scaled;
use crate::views::ViewSource;

/// What a doubling of rows must bring `[dB]`.
pub const PAYS: f64 = 0.10;
/// The probes' PSNR is so far below its best where a policy's edit is still being recovered from `[dB]`.
/// Of views drawn anew at each step, as the loss is, the noise would be larger than this; the probes
/// are the same views each time.
const UNSETTLED: f64 = 0.5;
/// Rungs after which what is lost counts as lost for good. The insertions of `diet` take a sixth of a
/// run, which is four.
const REMEMBERED: usize = 6;
/// Steps of a rung in a run of 30,000: ten rungs, or five doublings, until most policies stop to grow.
const RUNG: u32 = 1_500;
/// Rungs are whole multiples of this: policies are due every 100 steps at most.
const LEAST_RUNG: u32 = 100;
/// Rows grow by this factor at each rung.
const FACTOR: f64 = std::f64::consts::SQRT_2;
/// Fewer rows are no limit.
const LEAST_ROWS: usize = 1_000;
/// Rungs over which the slope is fitted.
const FITTED: usize = 3;
/// The share of the run after which rows are not removed any more: those that stay must settle.
const LAST_SHRINK: f64 = 0.8;
/// Most tenths of the rows that are removed at once.
const MOST_TENTHS: usize = 5;
/// The logit of an opacity that no pixel shows: of 1e-6.
const HIDDEN: f32 = -13.8;

/// The signals that the limit needs of a backend, beside the policy's.
#[must_use]
pub fn signals() -> SignalSet {
    SignalSet::from([Signal::WeightMax])
}

/// A limit that rises while rows pay.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Growth {
    /// Most rows now.
    pub limit: usize,
    /// The step at which growth was stopped, if it was.
    pub stopped: Option<u32>,
    /// Ends of rungs so far, also of those after growth at which rows might have been removed.
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
    /// Whether the probes are about as good as they have been of late; else nothing is concluded.
    pub settled: bool,
    /// What rows have brought in this settled rung and the two before, training included
    /// `[dB per doubling]`; `None` where there are not so many, rows did not become more, or growth is
    /// over.
    pub gain: Option<f64>,
}

/// An attempt to do with fewer rows.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Shrink {
    /// Iteration.
    pub step: u32,
    /// Rows before.
    pub before: usize,
    /// Rows without those that are missed least; as before if a tenth would be missed too much.
    pub after: usize,
    /// What that changes in the probes, at once `[dB]`; what losing a tenth would, if none was lost.
    pub change: f64,
}

impl Growth {
    pub(super) fn new(rows: usize, budget: usize) -> Self {
        Self { limit: rows.max(LEAST_ROWS).min(budget), ..Self::default() }
    }

    /// Takes note of the end of a rung, and of whether anything may be concluded from it.
    fn note(&mut self, step: u32, rows: usize, psnr: f64) -> bool {
        let last = self.rungs.iter().rev().take(REMEMBERED);
        let best = last.map(|rung| rung.psnr).fold(f64::NEG_INFINITY, f64::max);
        let settled = psnr >= best - UNSETTLED;
        self.rungs.push(Rung { step, rows, psnr, settled, gain: None });
        settled
    }

    /// Concludes from the last rung, a settled one, whether more rows pay.
    fn judge(&mut self, budget: usize) {
        let settled = self.rungs.iter().rev().filter(|rung| rung.settled);
        let gain = slope(&settled.take(FITTED).copied().collect::<Vec<_>>());
        let Some(rung) = self.rungs.last_mut() else { return };
        rung.gain = gain;
        let Rung { step, rows, .. } = *rung;
        // A limit that rows do not come near says nothing about more of them.
        let is_full = rows as f64 * FACTOR.sqrt() >= self.limit as f64;
        let is_idle = is_full && gain.is_some_and(|gain| gain < PAYS);
        self.idle = if is_idle { self.idle + 1 } else { 0 };
        if self.idle >= 2 {
            self.stopped = Some(step);
            self.limit = rows.max(1);
        } else {
            self.limit = ((self.limit as f64 * FACTOR).round() as usize).min(budget);
        }
    }

    /// Whether rows may be removed at the end of a rung.
    fn may_shrink(&self, step: u32, iterations: u32) -> bool {
        let grown = self.stopped.is_some() || step > iterations / 2;
        grown && f64::from(step) <= LAST_SHRINK * f64::from(iterations)
    }
}

/// The slope of PSNR over log2(rows) `[dB per doubling]`, by least squares.
fn slope(rungs: &[Rung]) -> Option<f64> {
    let count = rungs.len() as f64;
    let doublings = |rung: &Rung| (rung.rows.max(1) as f64).log2();
    let x = rungs.iter().map(doublings).sum::<f64>() / count;
    let y = rungs.iter().map(|rung| rung.psnr).sum::<f64>() / count;
    let spread: f64 = rungs.iter().map(|rung| (doublings(rung) - x).powi(2)).sum();
    let common: f64 = rungs.iter().map(|rung| (doublings(rung) - x) * (rung.psnr - y)).sum();
    // That of a quarter of a doubling from end to end is the least that says something.
    let enough = rungs.len() == FITTED && spread > 2.0 * 0.125_f64.powi(2);
    enough.then(|| common / spread)
}

/// What losing so many tenths of the rows may cost `[dB]`.
fn allowed(tenths: usize) -> f64 {
    PAYS * (10.0 / (10.0 - tenths as f64)).log2()
}

/// Steps of a rung.
fn rung(iterations: u32) -> u32 {
    scaled(RUNG, iterations).next_multiple_of(LEAST_RUNG)
}

impl<V: ViewSource> Trainer<V> {
    /// The most rows that a plan may lead to now; never fewer than there are, so that a model that
    /// began with more need not be cut.
    pub(super) fn limit(&self) -> usize {
        let usable = self.options.savings.rows(self.backend.budget());
        let limit = self.growth.as_ref().map_or(usable, |growth| growth.limit.min(usable));
        limit.max(self.backend.rows())
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
        let rows = self.backend.rows();
        let shrinks = !grows && growth.may_shrink(step, iterations) && rows >= 10;
        if !grows && !shrinks {
            return Ok(None);
        }
        let psnr = mean(&self.probe(step, self.sh_degree(step))?);
        let settled = growth.note(step, rows, psnr);
        if settled && grows {
            growth.judge(self.options.savings.rows(self.backend.budget()));
        }
        let (gain, limit) = (growth.rungs.last().and_then(|rung| rung.gain), growth.limit);
        tracing::info!(step, rows, psnr, settled, gain, limit, "end of a rung");
        let mut event = None;
        if settled && shrinks {
            let (least, change) = self.least_missed(step, psnr)?;
            let after = rows - least.len();
            tracing::info!(step, before = rows, after, change, "fewer rows");
            growth.shrinks.push(Shrink { step, before: rows, after, change });
            growth.stopped.get_or_insert(step);
            // The policy may not fill up again what is removed.
            growth.limit = after;
            if !least.is_empty() {
                let mut plan = EditPlan::new(rows, self.limit());
                plan.cause("they are not missed");
                for row in least {
                    // Never refused: each row once.
                    let _ = plan.prune(row);
                }
                event = self.execute(step, plan)?;
            }
        }
        self.growth = Some(growth);
        Ok(event)
    }

    /// The rows that are missed least, as many as may be, and what the probes change without them from
    /// the PSNR that they have with `all` `[dB]`; what a tenth would change, if that is too much.
    fn least_missed(&mut self, step: u32, all: f64) -> Result<(Vec<u32>, f64), TrainError> {
        let signals = self.backend.take_signals(signals()).map_err(|e| self.stopped(step, e))?;
        let weights = signals.get(Signal::WeightMax).unwrap_or_default();
        let mut least: Vec<u32> = (0..weights.len() as u32).collect();
        least.sort_by(|&a, &b| weights[a as usize].total_cmp(&weights[b as usize]));
        self.backend.give_back(signals);
        let logits = self.opacity_logits(step)?;
        let measured = self.hide(step, all, &least, logits.clone());
        self.set_opacity_logits(step, &logits)?;
        let (gone, change) = measured?;
        least.truncate(gone);
        Ok((least, change))
    }

    /// Hides one tenth of the rows after the other, in the order of `least`, until they are missed.
    /// Returns how many rows are not missed, and what the probes change without them.
    fn hide(
        &mut self,
        step: u32,
        all: f64,
        least: &[u32],
        mut logits: Vec<f32>,
    ) -> Result<(usize, f64), TrainError> {
        let degree = self.sh_degree(step);
        let (mut gone, mut change) = (0, 0.0);
        for (tenth, rows) in (1..=MOST_TENTHS).zip(least.chunks((least.len() / 10).max(1))) {
            for &row in rows {
                logits[row as usize] = HIDDEN;
            }
            self.set_opacity_logits(step, &logits)?;
            let without = mean(&self.probe(step, degree)?) - all;
            let is_missed = -without >= allowed(tenth);
            if !is_missed || gone == 0 {
                change = without;
            }
            if is_missed {
                break;
            }
            gone += rows.len();
        }
        Ok((gone, change))
    }

    fn opacity_logits(&self, step: u32) -> Result<Vec<f32>, TrainError> {
        let mut all = Vec::with_capacity(self.backend.rows());
        for rows in pieces(self.backend.rows()) {
            let some = self.backend.download_array(ModelArray::OpacityLogits, rows);
            all.extend(some.map_err(|e| self.stopped(step, e))?);
        }
        Ok(all)
    }

    fn set_opacity_logits(&mut self, step: u32, logits: &[f32]) -> Result<(), TrainError> {
        for rows in pieces(logits.len()) {
            let some = &logits[rows.clone()];
            let done = self.backend.upload_array(ModelArray::OpacityLogits, rows, some);
            done.map_err(|e| self.stopped(step, e))?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests;
