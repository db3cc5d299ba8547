//! The number of new rows per event: the rows that the curve allows and those that replace others.

use super::{Merit, MeritParams};
use crate::plan::EditPlan;
use crate::policy::{PolicyResult, Signal, Snapshot};
use crate::quota::event_quota;

impl Merit {
    /// Number of rows by which the model, after this plan's pruning, falls short of the curve, which starts at
    /// `initial_rows`.
    pub(super) fn shortfall(&self, step: u32, initial_rows: usize, plan: &EditPlan) -> usize {
        let MeritParams { grow_from: from, curve_until: until, .. } = self.params;
        let length = f64::from(until.saturating_sub(from).max(1));
        let passed = (f64::from(step.saturating_sub(from)) / length).min(1.0);
        let room = plan.budget().saturating_sub(initial_rows) as f64;
        let allowed = initial_rows.min(plan.budget()) + (room * passed.sqrt()).floor() as usize;
        allowed.saturating_sub(plan.rows() - plan.pruned())
    }

    /// Number of rows that this event replaces: those less important than `replaceable` times the median importance,
    /// within the limits of `rho` and `most_rho`.
    pub(super) fn turnover(&self, now: &Snapshot<'_>, plan: &EditPlan) -> PolicyResult<usize> {
        let MeritParams { rho, most_rho, replaceable, .. } = self.params;
        let quota = |share| event_quota(share, self.events, now.step, plan.budget());
        let importance = now.signal(Signal::WeightMax)?;
        let limit = replaceable as f32 * median(importance);
        let age = self.ages(now)?;
        let is_unimportant = |&row: &u32| {
            plan.is_free(row) && self.is_old(age, row) && importance[row as usize] < limit
        };
        let unimportant = (0..now.rows() as u32).filter(is_unimportant).count();
        Ok(unimportant.min(quota(most_rho)).max(quota(rho)))
    }
}

/// The upper median of the finite values; 0 if there are none.
fn median(values: &[f32]) -> f32 {
    let mut finite: Vec<f32> = values.iter().copied().filter(|value| value.is_finite()).collect();
    let middle = finite.len() / 2;
    if finite.is_empty() {
        return 0.0;
    }
    *finite.select_nth_unstable_by(middle, f32::total_cmp).1
}
