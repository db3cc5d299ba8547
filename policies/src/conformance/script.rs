//! Scripted runs: a model without parameters, whose statistics are made up.

use std::any::Any;
use std::fmt;
use std::panic::{AssertUnwindSafe, catch_unwind};

use toml::Table;

use super::Check;
use super::pattern::{PATTERNS, Pattern, number, plausible};
use crate::plan::{EditPlan, RowOps};
use crate::policy::{
    AuxColumn, AuxRequest, AuxView, Candidate, DensityPolicy, Needs, PolicyError, PolicyState,
    SceneInfo, Signal, SignalSet, Signals, Snapshot,
};
use crate::registry::PolicyEntry;
use crate::rng::{PolicyRng, Purpose};

/// One run.
#[derive(Debug, Clone)]
pub(super) struct Scenario {
    name: &'static str,
    scene: SceneInfo,
    /// Whether plans have no room, whatever the scene's budget says.
    refuses: bool,
    pattern: Pattern,
}

impl Scenario {
    /// The budget of the plan for a model of `rows` rows.
    fn budget(&self, rows: usize) -> usize {
        if self.refuses { rows } else { self.scene.budget }
    }
}

impl Scenario {
    /// What the statistics of an event hold.
    fn pattern_at(&self, step: u32) -> Pattern {
        match self.pattern {
            Pattern::Changing => PATTERNS[step as usize % (PATTERNS.len() - 1)],
            pattern => pattern,
        }
    }
}

impl fmt::Display for Scenario {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}, statistics {:?}, {} steps", self.name, self.pattern, self.scene.iterations)
    }
}

/// A scene whose schedules, written for 30,000 steps, pass in a fiftieth of the time.
pub(super) fn scene(initial_rows: usize, budget: usize) -> SceneInfo {
    SceneInfo {
        extent: 3.0,
        train_views: 7,
        budget,
        initial_rows,
        iterations: 600,
        white_background: true,
    }
}

/// All runs that a policy must pass.
pub(super) fn scenarios() -> Vec<Scenario> {
    let models = [
        ("an empty model", scene(0, 8), false),
        ("one row at its budget", scene(1, 1), false),
        ("one row", scene(1, 16), false),
        ("a full model", scene(24, 24), false),
        ("a model with room", scene(30, 300), false),
        ("a single view", SceneInfo { train_views: 1, ..scene(30, 300) }, false),
        ("plans that refuse growth", scene(20, 200), true),
        ("full length", SceneInfo { iterations: 30_000, ..scene(20, 60) }, false),
    ];
    let runs = models.into_iter().flat_map(|(name, scene, refuses)| {
        PATTERNS.map(|pattern| Scenario { name, scene: scene.clone(), refuses, pattern })
    });
    runs.collect()
}

/// Most events of one run: a policy that is due at every step need not be led through all.
const MOST_EVENTS: usize = 400;

type Failure = (Check, String);

/// Four copies of the policy go through the run together: one as in a training; a twin; one that
/// sees more than it asked for; and, from a third and from two thirds of the run on, one that has
/// been saved and restored. All must make the same plans.
pub(super) fn run(entry: &PolicyEntry, set: &Table, scenario: &Scenario) -> Result<(), Failure> {
    let scene = &scenario.scene;
    let build = || {
        let built = guarded(|| entry.build(set, scene));
        built.and_then(|built| built.map_err(|e| e.to_string())).map_err(|why| (Check::Builds, why))
    };
    let mut policy = build()?;
    let mut twins: Vec<(Check, Box<dyn DensityPolicy>)> =
        vec![(Check::Repeats, build()?), (Check::ReadsOnlyWhatItDeclares, build()?)];
    refuses_foreign_state(&mut *build()?)?;

    let needs = policy.needs(scene);
    let sound = |why| (Check::DeclaresSoundly, why);
    needs.check().map_err(sound)?;
    if needs != policy.needs(scene) || needs != twins[0].1.needs(scene) {
        return Err((Check::Repeats, "its needs change".to_owned()));
    }
    let has_fresh_signal = needs.signals.contains(Signal::FreshWeightMax);
    if has_fresh_signal != (needs.fresh_views > 0) {
        let (views, verb) =
            (needs.fresh_views, if has_fresh_signal { "asks" } else { "does not ask" });
        let why = format!("it {verb} for FreshWeightMax, but for {views} fresh views");
        return Err((Check::AsksForWhole, why));
    }
    if let Some(step) =
        (1..=scene.iterations).find(|&step| !policy.cadence(step).is_within(needs.cadence))
    {
        let (cadence, longest) = (policy.cadence(step), needs.cadence);
        return Err(sound(format!("at step {step} {cadence:?}, but {longest:?} was declared")));
    }
    let due: Vec<u32> = (1..=scene.iterations).filter(|&step| policy.is_due(step)).collect();
    let mut model = Model { rows: scene.initial_rows, candidates: Vec::new() };
    let events = due.len().min(MOST_EVENTS);
    for (event, &step) in due.iter().take(events).enumerate() {
        let rows = model.rows;
        let at = |(check, why): Failure| (check, format!("step {step}, {rows} rows: {why}"));
        if event == events / 3 || event == 2 * events / 3 {
            twins.push((Check::Remembers, restored(&*policy, build()?).map_err(at)?));
        }
        let wants_fresh =
            |policy: &dyn DensityPolicy| policy.wants_fresh(step, rows, scenario.budget(rows));
        let fresh = wants_fresh(&*policy);
        let seen = model.observe(scenario, step, &needs, fresh);
        let aux = policy.aux_views(step, rows, scenario.budget(rows));
        if aux > 0 && needs.aux.is_none() {
            let why = "it wants auxiliary views, but its needs do not say what of".to_owned();
            return Err(at((Check::AsksForWhole, why)));
        }
        let request = needs.aux.clone().unwrap_or_default();
        let views: Vec<Observed> = (0..aux.min(scene.train_views).min(MOST_VIEWS))
            .map(|view| model.view(scenario, step, view, &request))
            .collect();
        observe(&mut *policy, step, rows, &views, &request, false).map_err(at)?;
        let ops = plan(&mut *policy, scenario, &seen, false).map_err(at)?;
        for (check, twin) in &mut twins {
            if !twin.is_due(step) {
                return Err(at((*check, "a copy is not due at this step".to_owned())));
            }
            if wants_fresh(&**twin) != fresh {
                return Err(at((*check, "a copy does not agree on fresh views".to_owned())));
            }
            if twin.aux_views(step, rows, scenario.budget(rows)) != aux
                || twin.cadence(step) != policy.cadence(step)
            {
                return Err(at((*check, "a copy wants other views or another cadence".to_owned())));
            }
            let sees_all = *check == Check::ReadsOnlyWhatItDeclares;
            observe(&mut **twin, step, rows, &views, &request, sees_all).map_err(at)?;
            let again = plan(&mut **twin, scenario, &seen, sees_all).map_err(at)?;
            if again != ops {
                return Err(at((*check, format!("{ops:?}, but a copy planned {again:?}"))));
            }
            if twin.save() != policy.save() {
                return Err(at((*check, "a copy saves another state".to_owned())));
            }
        }
        model.apply(&ops);
    }
    Ok(())
}

/// Most auxiliary views that an event shows.
const MOST_VIEWS: u32 = 3;

/// What there is to see in an auxiliary view, whether it was asked for or not.
struct Observed {
    loss: f32,
    columns: Vec<(AuxColumn, Vec<f32>)>,
    points: Vec<Candidate>,
}

/// Shows the views to a copy: what it declared, or everything.
fn observe(
    policy: &mut dyn DensityPolicy,
    step: u32,
    rows: usize,
    views: &[Observed],
    request: &AuxRequest,
    sees_all: bool,
) -> Result<(), Failure> {
    for view in views {
        let declared = |column: &AuxColumn| sees_all || request.columns.contains(column);
        let columns: Vec<_> = view.columns.iter().filter(|c| declared(&c.0)).cloned().collect();
        // As many as were asked for, or any where none was.
        let most =
            if sees_all && request.points == 0 { usize::MAX } else { request.points as usize };
        let points = &view.points[..most.min(view.points.len())];
        let view = AuxView { step, rows, loss: view.loss, columns: &columns, points };
        let seen = guarded(|| policy.observe(&view)).map_err(|why| (Check::GoesOn, why))?;
        seen.map_err(|error| match error {
            PolicyError::UndeclaredColumn { column } => {
                let why = format!("{column:?} was read but not declared");
                (Check::ReadsOnlyWhatItDeclares, why)
            }
            error => (Check::GoesOn, error.to_string()),
        })?;
    }
    Ok(())
}

/// The made-up model: nothing but its size.
struct Model {
    rows: usize,
    candidates: Vec<Candidate>,
}

/// What there is to see at an event.
struct Seen {
    step: u32,
    declared: Signals,
    all: Signals,
    candidates: Vec<Candidate>,
    candidates_declared: bool,
}

impl Model {
    /// One auxiliary view.
    fn view(&self, scenario: &Scenario, step: u32, view: u32, request: &AuxRequest) -> Observed {
        let rng = PolicyRng::new(11 + u64::from(view), step);
        let pattern = scenario.pattern_at(step);
        let value = |row: u32, part: u32, plausible: &dyn Fn(f32) -> f32| {
            number(pattern, rng.bits(row, Purpose::Noise, 200 + part), plausible)
        };
        let columns = AuxColumn::ALL.into_iter().enumerate().map(|(i, column)| {
            let rows = 0..self.rows as u32;
            (column, rows.map(|row| value(row, i as u32, &|u| (40.0 * u).floor())).collect())
        });
        let points = (0..request.points.clamp(1, 4)).map(|index| Candidate {
            position: [0, 1, 2].map(|i| value(index, 20 + i, &|u| u)),
            colour: [3, 4, 5].map(|i| value(index, 20 + i, &|u| u)),
            pixel_size: value(index, 26, &|u| 0.01 * u),
            error: value(index, 27, &|u| u),
        });
        Observed {
            loss: value(0, 30, &|u| u),
            columns: columns.collect(),
            points: points.collect(),
        }
    }

    fn observe(&mut self, scenario: &Scenario, step: u32, needs: &Needs, fresh: bool) -> Seen {
        let rng = PolicyRng::new(7, step);
        let pattern = scenario.pattern_at(step);
        let fill = |set: SignalSet| {
            let mut signals = Signals::zeros(self.rows, set);
            for signal in set.iter() {
                for (row, value) in (0..).zip(signals.get_mut(signal).into_iter().flatten()) {
                    let bits = rng.bits(row, Purpose::Noise, signal as u32);
                    *value = number(pattern, bits, |u| plausible(signal, u, &scenario.scene));
                }
            }
            signals
        };
        let unwanted = needs.signals.without(Signal::FreshWeightMax);
        let declared = fill(if fresh { needs.signals } else { unwanted });
        let all = fill(SignalSet::of(&Signal::ALL));
        let capacity = needs.candidates.map_or(5, |request| request.capacity);
        for index in 0..capacity.saturating_sub(self.candidates.len()).min(5) as u32 {
            let values = |part: u32| {
                let bits = rng.bits(index, Purpose::Noise, 100 + part);
                number(pattern, bits, |u| u)
            };
            self.candidates.push(Candidate {
                position: [0, 1, 2].map(values),
                colour: [3, 4, 5].map(values),
                pixel_size: values(6) * 0.01,
                error: values(7),
            });
        }
        Seen {
            step,
            declared,
            all,
            candidates: self.candidates.clone(),
            candidates_declared: needs.candidates.is_some(),
        }
    }

    fn apply(&mut self, ops: &RowOps) {
        self.rows = ops.rows_after;
        if ops.reset_candidates {
            self.candidates.clear();
        }
    }
}

/// Lets a copy plan, with what it declared or with everything.
fn plan(
    policy: &mut dyn DensityPolicy,
    scenario: &Scenario,
    seen: &Seen,
    sees_all: bool,
) -> Result<RowOps, Failure> {
    let signals = if sees_all { &seen.all } else { &seen.declared };
    let has_candidates = sees_all || seen.candidates_declared;
    let now = Snapshot {
        step: seen.step,
        scene: &scenario.scene,
        signals,
        candidates: if has_candidates { &seen.candidates } else { &[] },
    };
    let rows = now.rows();
    let budget = scenario.budget(rows);
    let mut plan = EditPlan::new(rows, budget);
    let rng = PolicyRng::new(3, seen.step);
    let planned = guarded(|| policy.plan(&now, &rng, &mut plan));
    match planned.map_err(|why| (Check::GoesOn, why))? {
        Err(PolicyError::Undeclared { signal }) => {
            let why = format!("{signal:?} was read but not declared");
            return Err((Check::ReadsOnlyWhatItDeclares, why));
        }
        Err(error) => return Err((Check::GoesOn, error.to_string())),
        Ok(()) => {}
    }
    let ops = plan.compile();
    if (ops.rows_before, ops.budget) != (rows, budget) || ops.rows_after > budget {
        let why = format!("budget {budget}, but the plan was made for {ops:?}");
        return Err((Check::KeepsItsPlan, why));
    }
    if rows > 0 && ops.rows_after == 0 {
        return Err((Check::LeavesARow, "all rows were pruned".to_owned()));
    }
    Ok(ops)
}

/// A new copy with the policy's state, which goes through text as in a checkpoint.
fn restored(
    policy: &dyn DensityPolicy,
    mut copy: Box<dyn DensityPolicy>,
) -> Result<Box<dyn DensityPolicy>, Failure> {
    let text = policy.save().to_string();
    let state: Result<PolicyState, _> = serde_json::from_str(&text);
    let state = state.map_err(|error| (Check::Remembers, error.to_string()))?;
    let result = guarded(|| copy.restore(state)).map_err(|why| (Check::Remembers, why))?;
    result.map_err(|error| (Check::Remembers, error.to_string()))?;
    Ok(copy)
}

fn refuses_foreign_state(policy: &mut dyn DensityPolicy) -> Result<(), Failure> {
    let foreign = serde_json::json!({ "conformance": "not a state" });
    match guarded(|| policy.restore(foreign)) {
        Ok(Err(PolicyError::State(_))) => Ok(()),
        Ok(Err(error)) => Err((Check::RefusesForeignState, format!("wrong error: {error}"))),
        Ok(Ok(())) => Err((Check::RefusesForeignState, "it was accepted".to_owned())),
        Err(why) => Err((Check::RefusesForeignState, why)),
    }
}

/// The result, or what a panic said.
fn guarded<T>(action: impl FnOnce() -> T) -> Result<T, String> {
    catch_unwind(AssertUnwindSafe(action)).map_err(|panic: Box<dyn Any + Send>| {
        let text = panic.downcast_ref::<String>().map(String::as_str);
        let text = text.or_else(|| panic.downcast_ref::<&str>().copied());
        format!("panic: {}", text.unwrap_or("no message"))
    })
}
