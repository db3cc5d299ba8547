//! Hand-made events for the tests of policies: signals in, pruned and grown rows out.

use crate::conformance::check_policy_with;
use crate::plan::{EditPlan, Offspring, ParentFate, RowOps};
use crate::policy::{
    AuxColumn, AuxView, Candidate, DensityPolicy, PolicyResult, SceneInfo, Signal, Signals,
    Snapshot,
};
use crate::registry::find;
use crate::rng::PolicyRng;

/// The policy `name` with the parameters in `set`, a TOML table.
pub(crate) fn build(name: &str, set: &str, scene: &SceneInfo) -> Box<dyn DensityPolicy> {
    find(name).unwrap().build(&set.parse().unwrap(), scene).unwrap()
}

/// The steps of a run at which the policy is due.
pub(crate) fn due_steps(name: &str, set: &str, scene: &SceneInfo) -> Vec<u32> {
    let policy = build(name, set, scene);
    (0..=scene.iterations).filter(|&step| policy.is_due(step)).collect()
}

/// Runs the conformance suite on the policy with each of these sets of parameters.
pub(crate) fn assert_conforms(name: &str, sets: &[&str]) {
    for set in sets {
        if let Err(report) = check_policy_with(find(name).unwrap(), &set.parse().unwrap()) {
            panic!("{set}: {report}");
        }
    }
}

/// One event of a policy. Signals that are not given are zero.
#[derive(Debug, Clone)]
pub(crate) struct Event {
    pub(crate) step: u32,
    pub(crate) rows: usize,
    pub(crate) budget: usize,
    pub(crate) scene: SceneInfo,
    pub(crate) signals: Vec<(Signal, Vec<f32>)>,
    pub(crate) candidates: Vec<Candidate>,
    pub(crate) views: Vec<View>,
}

/// An auxiliary view.
#[derive(Debug, Clone, Default)]
pub(crate) struct View {
    pub(crate) loss: f32,
    pub(crate) columns: Vec<(AuxColumn, Vec<f32>)>,
    pub(crate) points: Vec<Candidate>,
}

/// What a policy did. Rows are those before the edit, ascending, unless stated otherwise.
#[derive(Debug)]
pub(crate) struct Outcome {
    pub(crate) pruned: Vec<u32>,
    /// In the order of the plan.
    pub(crate) cloned: Vec<u32>,
    /// In the order of the plan.
    pub(crate) split: Vec<u32>,
    pub(crate) ops: RowOps,
}

impl Event {
    pub(crate) fn new(step: u32, rows: usize, budget: usize) -> Self {
        let scene = SceneInfo {
            extent: 10.0,
            train_views: 100,
            budget,
            initial_rows: rows,
            iterations: 30_000,
            white_background: false,
        };
        Self {
            step,
            rows,
            budget,
            scene,
            signals: Vec::new(),
            candidates: Vec::new(),
            views: Vec::new(),
        }
    }

    pub(crate) fn with(mut self, signal: Signal, values: &[f32]) -> Self {
        assert_eq!(values.len(), self.rows * signal.width());
        self.signals.retain(|(given, _)| *given != signal);
        self.signals.push((signal, values.to_vec()));
        self
    }

    pub(crate) fn with_all(self, signal: Signal, value: f32) -> Self {
        let values = vec![value; self.rows * signal.width()];
        self.with(signal, &values)
    }

    /// What the policy `name` does with the parameters in `set`.
    pub(crate) fn run(&self, name: &str, set: &str) -> Outcome {
        self.run_policy(&mut *build(name, set, &self.scene)).unwrap()
    }

    /// Lets the policy plan, with exactly the signals and as many of the views as it asks for.
    pub(crate) fn run_policy(&self, policy: &mut dyn DensityPolicy) -> PolicyResult<Outcome> {
        let request = policy.needs(&self.scene).aux.unwrap_or_default();
        let wanted = policy.aux_views(self.step, self.rows, self.budget) as usize;
        for view in self.views.iter().take(wanted) {
            let is_declared = |c: &AuxColumn| request.columns.contains(c);
            let columns = view.columns.iter().filter(|c| is_declared(&c.0)).cloned();
            let columns: Vec<_> = columns.collect();
            policy.observe(&AuxView {
                step: self.step,
                rows: self.rows,
                loss: view.loss,
                columns: &columns,
                points: &view.points[..view.points.len().min(request.points as usize)],
            })?;
        }
        let mut signals = Signals::zeros(self.rows, policy.needs(&self.scene).signals);
        for (signal, values) in &self.signals {
            if let Some(column) = signals.get_mut(*signal) {
                column.copy_from_slice(values);
            }
        }
        let now = Snapshot {
            step: self.step,
            scene: &self.scene,
            signals: &signals,
            candidates: &self.candidates,
        };
        let needs = policy.needs(&self.scene);
        let mut plan = EditPlan::new(self.rows, self.budget).allowing(&needs);
        policy.plan(&now, &PolicyRng::new(1, self.step), &mut plan)?;
        Ok(Outcome::new(plan.compile()))
    }
}

impl Outcome {
    /// Of all families, in the order of the plan.
    pub(crate) fn offspring(&self) -> Vec<Offspring> {
        self.ops.families.iter().map(|family| self.ops.offspring(family)).collect()
    }

    fn new(ops: RowOps) -> Self {
        let grown = |fate| {
            let families = ops.families.iter().filter(move |f| f.fate() == fate);
            families.map(|family| family.parent).collect()
        };
        // Rows were pruned whose slots are overwritten, and rows of the tail that do not move.
        let is_overwritten = |row: &u32| {
            ops.child_slots.contains(row)
                || ops.seeds.iter().any(|(slot, _)| slot == row)
                || ops.moves.iter().any(|(_, to)| to == row)
        };
        let is_cut_off = |row: &u32| {
            *row as usize >= ops.rows_after && ops.moves.iter().all(|(from, _)| from != row)
        };
        let rows = 0..ops.rows_before as u32;
        Self {
            pruned: rows.filter(|row| is_overwritten(row) || is_cut_off(row)).collect(),
            cloned: grown(ParentFate::Stays),
            split: grown(ParentFate::BecomesChild),
            ops,
        }
    }
}
