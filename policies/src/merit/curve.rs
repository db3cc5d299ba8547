//! How many rows are born: what the curve still allows, and what is replaced.

use super::{Merit, MeritParams};
use crate::plan::EditPlan;
use crate::policy::{PolicyResult, Signal, Snapshot};
use crate::quota::rows_of_event;

impl Merit {
    /// How many rows the curve allows beyond those that are left.
    pub(super) fn missing(&self, step: u32, start: usize, plan: &EditPlan) -> usize {
        let MeritParams { grow_from: from, curve_until: until, .. } = self.params;
        let length = f64::from(until.saturating_sub(from).max(1));
        let passed = (f64::from(step.saturating_sub(from)) / length).min(1.0);
        let room = plan.budget().saturating_sub(start) as f64;
        let allowed = start.min(plan.budget()) + (room * passed.sqrt()).floor() as usize;
        allowed.saturating_sub(plan.rows() - plan.pruned())
    }

    /// How many rows this event replaces.
    pub(super) fn turnover(&self, now: &Snapshot<'_>, plan: &EditPlan) -> PolicyResult<usize> {
        let MeritParams { rho, most_rho, replaceable, .. } = self.params;
        let part = |share| rows_of_event(share, self.events, now.step, plan.budget());
        let importance = now.signal(Signal::WeightMax)?;
        let limit = replaceable as f32 * median(importance);
        let age = self.ages(now)?;
        let is_needless = |&row: &u32| {
            plan.is_free(row) && self.is_old(age, row) && importance[row as usize] < limit
        };
        let needless = (0..now.rows() as u32).filter(is_needless).count();
        Ok(needless.min(part(most_rho)).max(part(rho)))
    }
}

/// The middle of the numbers among these values, the upper one of two; 0 if there is none.
fn median(values: &[f32]) -> f32 {
    let mut numbers: Vec<f32> = values.iter().copied().filter(|value| value.is_finite()).collect();
    let middle = numbers.len() / 2;
    if numbers.is_empty() {
        return 0.0;
    }
    *numbers.select_nth_unstable_by(middle, f32::total_cmp).1
}
