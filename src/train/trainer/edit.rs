//! Edits by the policy: its inputs, its plan, and the execution of the plan.

use std::time::Instant;

use densify_policies::plan::{EditPlan, RowOps};
use densify_policies::policy::{PolicyError, SceneInfo, Snapshot};
use densify_policies::rng::PolicyRng;

use super::policy_views::call_policy;
use super::{AtStep, EditEvent, TrainError, Trainer};
use densify_core::budget::RowBudget;
use densify_data::views::ViewSource;

impl<V: ViewSource> Trainer<V> {
    /// Lets the policy plan an edit, and executes the plan. Returns an event as [`Self::execute`] does.
    pub(super) fn edit(&mut self, step: u32) -> Result<Option<EditEvent>, TrainError> {
        let start = Instant::now();
        self.show_aux_views(step)?;
        self.state.views_time = self.state.views_time.saturating_add(start.elapsed());
        let signals = self.backend.take_signals(self.needs.signals).at(step)?;
        let signals = signals.without_first(self.row_budget().frozen);
        let mut plan = self.new_plan().allowing(&self.needs);
        let scene = SceneInfo { budget: plan.budget(), ..self.scene.clone() };
        let candidates = self.backend.candidates();
        let snapshot = Snapshot { step, scene: &scene, signals: &signals, candidates };
        let rng = PolicyRng::new(self.options.seed, step);
        let planned = call_policy(|| self.policy.plan(&snapshot, &rng, &mut plan)).flatten();
        self.backend.give_back(signals);
        planned.map_err(|source| self.policy_error(step, source))?;
        self.execute(step, plan)
    }

    /// An empty plan for the rows that are not frozen.
    pub(super) fn new_plan(&self) -> EditPlan {
        let (rows, budget) = self.trained_rows_and_budget();
        EditPlan::new(rows, budget)
    }

    /// The current limit on the number of rows, including frozen ones.
    pub(super) fn row_budget(&self) -> RowBudget {
        RowBudget { total: self.row_limit(), frozen: self.options.frozen }
    }

    /// Number of rows and its limit, both without frozen rows, as policies see them.
    pub(super) fn trained_rows_and_budget(&self) -> (usize, usize) {
        let budget = self.row_budget();
        (budget.trained(self.backend.rows()), budget.trainable())
    }

    /// Executes a plan. Returns an event only if rows changed or edits were refused.
    pub(super) fn execute(
        &mut self,
        step: u32,
        plan: EditPlan,
    ) -> Result<Option<EditEvent>, TrainError> {
        let mut ops = plan.compile();
        self.check_plan(step, &ops)?;
        ops = ops.after_frozen(self.row_budget().frozen);
        // The backend checks its own budget, which may be larger than the trainer's limit.
        ops.budget = self.backend.budget();
        self.backend.apply(&ops, self.options.seed, step).at(step)?;
        if let Some(history) = &mut self.history {
            history.record(&ops, step);
        }
        self.state.peak_rows = self.state.peak_rows.max(peak_rows(&ops)).max(self.backend.rows());
        if !ops.edits_rows() && ops.counts.denied == 0 {
            return Ok(None);
        }
        let event = EditEvent::new(step, &ops);
        let EditEvent { before, removed, added, updated, denied, after, .. } = event;
        let cause = &event.cause;
        tracing::info!(step, before, removed, added, updated, denied, after, %cause, "edit");
        self.state.events.push(event.clone());
        Ok(Some(event))
    }

    /// Checks the budget and all invariants again, so that a broken plan becomes an error instead of a panic in the
    /// backend.
    fn check_plan(&self, step: u32, ops: &RowOps) -> Result<(), TrainError> {
        let (rows, budget) = self.trained_rows_and_budget();
        let reason = if ops.rows_before != rows || ops.budget != budget {
            let RowOps { rows_before, budget: planned, .. } = ops;
            format!(
                "made for {rows_before} rows and a budget of {planned}, not for {rows} and {budget}"
            )
        } else if let Err(broken) = ops.check() {
            broken.to_string()
        } else {
            return Ok(());
        };
        let problem = format!("its plan is broken: {reason}; this is a bug, please report it");
        Err(self.policy_error(step, PolicyError::Other(problem)))
    }
}

/// Largest number of rows in use during an edit: children and seeds are written before moves shorten the model.
fn peak_rows(ops: &RowOps) -> usize {
    let new = ops.child_slots.iter().copied().chain(ops.seeds.iter().map(|(slot, _)| *slot));
    let highest = new.max().map_or(0, |slot| slot as usize + 1);
    highest.max(ops.rows_before).max(ops.rows_after)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rows_written_before_the_moves_count_for_the_peak() {
        let ops =
            RowOps { rows_before: 4, rows_after: 3, child_slots: vec![1, 5], ..RowOps::default() };
        assert_eq!(peak_rows(&ops), 6);
    }
}
