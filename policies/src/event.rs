//! Hand-made events (steps at which a policy edits the model) for tests of policies.

use crate::conformance::check_policy_with;
use crate::plan::{EditPlan, Offspring, ParentFate, RowOps};
use crate::policy::{
    AuxColumn, AuxView, Candidate, DensityPolicy, PixelLoss, PolicyResult, SceneInfo, Signal,
    SignalSet, Signals, Snapshot,
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

/// Asserts that `pixel_loss` sets the pixel term, that the default decides by the number of training views, and that the
/// file of a run names the decision.
pub(crate) fn assert_pixel_loss(name: &str) {
    let policy = find(name).unwrap();
    for (views, by_views) in [(39, "l1"), (40, "huber")] {
        let scene = SceneInfo { train_views: views, ..Event::new(1, 1, 1).scene };
        for (set, expected) in
            [("", by_views), ("auto", by_views), ("l1", "l1"), ("huber", "huber")]
        {
            let set = if set.is_empty() { String::new() } else { format!("pixel_loss = '{set}'") };
            let saved = policy.effective(&set.parse().unwrap(), &scene).unwrap();
            assert_eq!(saved["pixel_loss"].as_str(), Some(expected), "{views} views, {set:?}");
            let used = build(name, &set, &scene).needs(&scene).pixel_loss;
            let expected = if expected == "l1" { PixelLoss::L1 } else { PixelLoss::Huber };
            assert_eq!(used, expected, "{views} views, {set:?}");
        }
    }
    assert_eq!(policy.added_parameters(), [("pixel_loss", "l1")]);
}

/// Asserts that the policy has the parameters of `vanilla`, and that at a growth step with the four rows of `event` it
/// plans like `vanilla` would if its defaults were changed to `defaults`.
pub(crate) fn assert_grows_like_vanilla(name: &str, event: Event, defaults: &str) {
    // Averaged over 4 views, the gradients are just above 2e-4, just below it, and 1e-3; the last row is faint.
    let event = Event { budget: 9, ..event }
        .with(Signal::ScreenGradient, &[8.01e-4, 7.99e-4, 4e-3, 1.0])
        .with(Signal::ScaleMax, &[0.05, 0.05, 0.2, 0.05])
        .with(Signal::Opacity, &[0.5, 0.5, 0.5, 0.001]);
    for set in ["", "tau = 0.0005", "small = 0.03", "governor = true", "min_opacity = 0.6"] {
        let ours = event.run(name, set).ops;
        assert_eq!(ours, event.run("vanilla", &format!("{defaults}\n{set}")).ops, "{set}");
        assert!(ours.edits_rows(), "{set}");
    }
    let (ours, theirs) = (find(name).unwrap(), find("vanilla").unwrap());
    let names = ours.parameter_names();
    assert!(theirs.parameter_names().iter().all(|parameter| names.contains(parameter)));
    assert!(ours.step_parameters().starts_with(theirs.step_parameters()));
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

/// An auxiliary view that the policy may observe before it plans.
#[derive(Debug, Clone, Default)]
pub(crate) struct View {
    pub(crate) loss: f32,
    pub(crate) columns: Vec<(AuxColumn, Vec<f32>)>,
    pub(crate) points: Vec<Candidate>,
}

/// The edits of a policy. Rows are numbered as before the edit, and ascend unless stated otherwise.
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

    /// Rows of opacity 0.5 and largest standard deviation 0.05 (small, as the extent is 10), seen by four views.
    pub(crate) fn small_rows(step: u32, rows: usize, budget: usize) -> Self {
        Self::new(step, rows, budget)
            .with_all(Signal::VisibleCount, 4.0)
            .with_all(Signal::Opacity, 0.5)
            .with_all(Signal::ScaleMax, 0.05)
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

    /// Runs the policy `name` with the parameters in `set`.
    pub(crate) fn run(&self, name: &str, set: &str) -> Outcome {
        self.run_policy(&mut *build(name, set, &self.scene)).unwrap()
    }

    /// The given values of the signals in `set`; 0 where none are given.
    pub(crate) fn signals(&self, set: SignalSet) -> Signals {
        let mut signals = Signals::zeros(self.rows, set);
        for (signal, values) in &self.signals {
            if let Some(column) = signals.get_mut(*signal) {
                column.copy_from_slice(values);
            }
        }
        signals
    }

    /// Lets the policy plan, with exactly the signals and at most as many views as it requests.
    pub(crate) fn run_policy(&self, policy: &mut dyn DensityPolicy) -> PolicyResult<Outcome> {
        let request = policy.needs(&self.scene).aux.unwrap_or_default();
        let views = policy.aux_views(self.step, self.rows, self.budget) as usize;
        for view in self.views.iter().take(views) {
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
        let needs = policy.needs(&self.scene);
        let now = Snapshot {
            step: self.step,
            scene: &self.scene,
            signals: &self.signals(needs.signals),
            candidates: &self.candidates,
        };
        let mut plan = EditPlan::new(self.rows, self.budget).allowing(&needs);
        policy.plan(&now, &PolicyRng::new(1, self.step), &mut plan)?;
        Ok(Outcome::new(plan.compile()))
    }
}

impl Outcome {
    /// The offspring of all families, in the order of the plan.
    pub(crate) fn offspring(&self) -> Vec<Offspring> {
        self.ops.families.iter().map(|family| self.ops.offspring(family)).collect()
    }

    fn new(ops: RowOps) -> Self {
        let grown = |fate| {
            let families = ops.families.iter().filter(move |f| f.fate() == fate);
            families.map(|family| family.parent).collect()
        };
        // Pruned rows are those whose slots are overwritten, and those beyond the new end that are not moved.
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
