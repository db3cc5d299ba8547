//! A hand-made event for the tests of policies: columns in, who was pruned and who grew out.

use crate::plan::{EditPlan, ParentFate, RowOps};
use crate::policy::{
    AuxColumn, AuxView, Candidate, DensityPolicy, PolicyError, SceneInfo, Signal, SignalSet,
    Signals, Snapshot,
};
use crate::rng::PolicyRng;

/// One event. Columns that are not given are zero.
#[derive(Debug, Clone)]
pub(crate) struct Event {
    pub(crate) step: u32,
    pub(crate) rows: usize,
    pub(crate) budget: usize,
    pub(crate) scene: SceneInfo,
    pub(crate) columns: Vec<(Signal, Vec<f32>)>,
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
            columns: Vec::new(),
            candidates: Vec::new(),
            views: Vec::new(),
        }
    }

    pub(crate) fn with(mut self, signal: Signal, column: &[f32]) -> Self {
        assert_eq!(column.len(), self.rows);
        self.columns.retain(|(given, _)| *given != signal);
        self.columns.push((signal, column.to_vec()));
        self
    }

    pub(crate) fn with_all(self, signal: Signal, value: f32) -> Self {
        let column = vec![value; self.rows];
        self.with(signal, &column)
    }

    /// Lets the policy plan, with exactly the signals and as many of the views as it asks for.
    pub(crate) fn run(&self, policy: &mut dyn DensityPolicy) -> Result<Outcome, PolicyError> {
        let request = policy.needs(&self.scene).aux.unwrap_or_default();
        let wanted = policy.aux_views(self.step, self.rows, self.budget) as usize;
        for view in self.views.iter().take(wanted) {
            let asked = |c: &AuxColumn| request.columns.contains(c);
            let columns: Vec<_> = view.columns.iter().filter(|c| asked(&c.0)).cloned().collect();
            policy.observe(&AuxView {
                step: self.step,
                rows: self.rows,
                loss: view.loss,
                columns: &columns,
                points: &view.points[..view.points.len().min(request.points as usize)],
            })?;
        }
        let mut set: SignalSet = policy.needs(&self.scene).signals;
        if !policy.wants_fresh(self.step, self.rows, self.budget) {
            set = set.without(Signal::FreshWeightMax);
        }
        let mut signals = Signals::zeros(self.rows, set);
        for (signal, values) in &self.columns {
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
        let mut plan = EditPlan::new(self.rows, self.budget);
        policy.plan(&now, &PolicyRng::new(1, self.step), &mut plan)?;
        Ok(Outcome::of(plan.compile()))
    }
}

impl Outcome {
    fn of(ops: RowOps) -> Self {
        let grown = |fate| {
            let of_fate = ops.families.iter().filter(move |f| f.offspring.parent == fate);
            of_fate.map(|family| family.parent).collect()
        };
        // A slot that is written or moved into was pruned; so was a row of the tail left behind.
        let is_hole = |row: &u32| {
            ops.child_slots.contains(row)
                || ops.seeds.iter().any(|(slot, _)| slot == row)
                || ops.moves.iter().any(|(_, to)| to == row)
        };
        let is_left = |row: &u32| {
            *row as usize >= ops.rows_after && ops.moves.iter().all(|(from, _)| from != row)
        };
        Self {
            pruned: (0..ops.rows_before as u32).filter(|r| is_hole(r) || is_left(r)).collect(),
            cloned: grown(ParentFate::Stays),
            split: grown(ParentFate::BecomesChild),
            ops,
        }
    }
}
