//! Measures the probe views at the end of an interval, and removes rows that hardly affect them.

use densify_policies::policy::Signal;

use super::probe_views::mean;
use super::{HIDDEN_LOGIT, MAX_TENTHS, Removal, allowed_fall, growth_signals, interval_steps};
use crate::trainer::{AtStep, EditEvent, TrainError, Trainer};
use densify_core::gaussians::ModelArray;
use densify_core::pieces::pieces;
use densify_data::views::ViewSource;

impl<V: ViewSource> Trainer<V> {
    /// Largest number of rows that a plan may result in. It is at least the current number, so that a model that starts
    /// above the limit is not reduced.
    pub(in crate::trainer) fn row_limit(&self) -> usize {
        let budget = self.backend.budget();
        let limit = self.state.auto_budget.as_ref().map_or(budget, |auto| auto.limit.min(budget));
        limit.max(self.backend.rows())
    }

    /// At the end of an interval, measures the probe views and then raises the limit or removes rows.
    pub(in crate::trainer) fn update_auto_budget(
        &mut self,
        step: u32,
    ) -> Result<Option<EditEvent>, TrainError> {
        let iterations = self.options.iterations;
        let is_due = step.is_multiple_of(interval_steps(iterations)) && step <= iterations;
        let auto =
            self.state.auto_budget.clone().filter(|_| is_due && !self.probe_views.is_empty());
        let Some(mut auto) = auto else {
            return Ok(None);
        };
        let grows = auto.stopped.is_none() && step <= iterations / 2;
        let rows = self.backend.rows();
        let removes = !grows && auto.may_remove(step, iterations) && rows >= 10;
        if !grows && !removes {
            return Ok(None);
        }
        let psnr = mean(&self.probe_psnr(step, self.sh_degree(step))?);
        let settled = auto.record(step, rows, psnr);
        if settled && grows {
            auto.update_limit(self.backend.budget());
        }
        let (gain, limit) = (auto.intervals.last().and_then(|last| last.gain), auto.limit);
        tracing::info!(step, rows, psnr, settled, gain, limit, "automatic budget");
        let mut event = None;
        if settled && removes {
            let (unimportant, change) = self.unimportant_rows(step, psnr)?;
            let after = rows - unimportant.len();
            tracing::info!(step, before = rows, after, change, "removal of unimportant rows");
            auto.removals.push(Removal { step, before: rows, after, change });
            auto.stopped.get_or_insert(step);
            // The policy may not replace the removed rows.
            auto.limit = after;
            if !unimportant.is_empty() {
                let mut plan = self.new_plan();
                plan.cause("auto budget");
                plan.prune_all(unimportant);
                event = self.execute(step, plan)?;
            }
        }
        self.state.auto_budget = Some(auto);
        Ok(event)
    }

    /// The rows to remove, and the change of the probe views' PSNR without them, relative to `psnr` with all rows
    /// `[dB]`; if no row can be removed, the change without a tenth of the rows.
    fn unimportant_rows(&mut self, step: u32, psnr: f64) -> Result<(Vec<u32>, f64), TrainError> {
        let signals = self.backend.take_signals(growth_signals()).at(step)?;
        let weights = signals.get(Signal::WeightMax).unwrap_or_default();
        let mut rows: Vec<u32> = (0..weights.len() as u32).collect();
        rows.sort_by(|&a, &b| weights[a as usize].total_cmp(&weights[b as usize]));
        self.backend.give_back(signals);
        let logits = self.opacity_logits(step)?;
        let measured = self.hide_tenths(step, psnr, &rows, logits.clone());
        self.set_opacity_logits(step, &logits)?;
        let (count, change) = measured?;
        rows.truncate(count);
        Ok((rows, change))
    }

    /// Hides the rows in the given order, a tenth at a time, until the PSNR falls too much. Returns the number of rows
    /// that can be removed, and the change of the PSNR without them (without a tenth, if none can be removed).
    fn hide_tenths(
        &mut self,
        step: u32,
        psnr: f64,
        rows: &[u32],
        mut logits: Vec<f32>,
    ) -> Result<(usize, f64), TrainError> {
        let degree = self.sh_degree(step);
        let (mut count, mut change) = (0, 0.0);
        for (tenth, hidden) in (1..=MAX_TENTHS).zip(rows.chunks((rows.len() / 10).max(1))) {
            for &row in hidden {
                logits[row as usize] = HIDDEN_LOGIT;
            }
            self.set_opacity_logits(step, &logits)?;
            let difference = mean(&self.probe_psnr(step, degree)?) - psnr;
            let is_too_much = -difference >= allowed_fall(tenth);
            if !is_too_much || count == 0 {
                change = difference;
            }
            if is_too_much {
                break;
            }
            count += hidden.len();
        }
        Ok((count, change))
    }

    fn opacity_logits(&self, step: u32) -> Result<Vec<f32>, TrainError> {
        let mut logits = Vec::with_capacity(self.backend.rows());
        for rows in pieces(self.backend.rows()) {
            logits.extend(self.backend.download_array(ModelArray::OpacityLogits, rows).at(step)?);
        }
        Ok(logits)
    }

    fn set_opacity_logits(&mut self, step: u32, logits: &[f32]) -> Result<(), TrainError> {
        for rows in pieces(logits.len()) {
            let piece = &logits[rows.clone()];
            self.backend.upload_array(ModelArray::OpacityLogits, rows, piece).at(step)?;
        }
        Ok(())
    }
}
