//! Where a policy is due: what it sees, its plan, and the plan's execution.

use std::time::Instant;

use densify_policies::plan::{EditPlan, RowOps};
use densify_policies::policy::{SceneInfo, Snapshot};
use densify_policies::rng::PolicyRng;

use super::guard::asked;
use super::{EditEvent, TrainError, Trainer};
use crate::views::ViewSource;

impl<V: ViewSource> Trainer<V> {
    /// Asks the policy for a plan and executes it; policies may be due at steps at which they find
    /// nothing to do.
    pub(super) fn edit(&mut self, step: u32) -> Result<Option<EditEvent>, TrainError> {
        let start = Instant::now();
        let needs = self.measure_fresh(step)?;
        self.show_views(step)?;
        self.views_time = self.views_time.saturating_add(start.elapsed());
        let signals =
            self.backend.take_signals(needs.signals).map_err(|e| self.stopped(step, e))?;
        let limit = self.limit();
        let scene = SceneInfo { budget: limit, ..self.scene.clone() };
        let candidates = self.backend.candidates();
        let now = Snapshot { step, scene: &scene, signals: &signals, candidates };
        let mut plan = EditPlan::new(self.backend.rows(), limit);
        let rng = PolicyRng::new(self.options.seed, step);
        let planned = asked(|| self.policy.plan(&now, &rng, &mut plan)).and_then(|done| done);
        self.backend.give_back(signals);
        planned.map_err(|source| self.refused(step, source))?;
        self.execute(step, plan)
    }

    /// Executes a plan. One that changes no row and was refused nothing is no event.
    pub(super) fn execute(
        &mut self,
        step: u32,
        plan: EditPlan,
    ) -> Result<Option<EditEvent>, TrainError> {
        let mut ops = plan.compile();
        self.check_plan(step, &ops)?;
        // A limit below the budget is the trainer's own; a backend knows of one budget only.
        ops.budget = self.backend.budget();
        self.backend.apply(&ops, self.options.seed, step).map_err(|e| self.stopped(step, e))?;
        self.peak_rows = self.peak_rows.max(rows_within(&ops)).max(self.backend.rows());
        if !ops.edits_rows() && ops.counts.denied == 0 {
            return Ok(None);
        }
        let event = EditEvent::new(step, &ops);
        let EditEvent { before, removed, added, updated, denied, after, .. } = event;
        let cause = &event.cause;
        tracing::info!(step, before, removed, added, updated, denied, after, %cause, "edit");
        self.events.push(event.clone());
        Ok(Some(event))
    }

    /// A plan compiles only from accepted calls; this is the second lock on the budget, and it
    /// turns a plan that slipped through the first into an error instead of a panic in the backend.
    fn check_plan(&self, step: u32, ops: &RowOps) -> Result<(), TrainError> {
        let (rows, budget) = (self.backend.rows(), self.limit());
        let reason = if ops.rows_before != rows || ops.budget != budget {
            let RowOps { rows_before, budget: planned, .. } = ops;
            Some(format!(
                "made for {rows_before} rows of {planned}, but the model has {rows} of {budget}"
            ))
        } else {
            ops.check().err().map(|broken| broken.to_string())
        };
        reason.map_or(Ok(()), |reason| {
            Err(TrainError::BrokenPlan { step, policy: self.policy_name.clone(), reason })
        })
    }
}

/// Most rows in use at any instant of an edit: children and seeds stand in their slots before the
/// moves shorten the model.
pub(super) fn rows_within(ops: &RowOps) -> usize {
    let born = ops.child_slots.iter().copied().chain(ops.seeds.iter().map(|(slot, _)| *slot));
    let highest = born.max().map_or(0, |slot| slot as usize + 1);
    highest.max(ops.rows_before).max(ops.rows_after)
}
