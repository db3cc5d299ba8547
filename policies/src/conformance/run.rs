//! Takes several copies of a policy through a scripted run and compares their plans.

use std::any::Any;
use std::panic::{AssertUnwindSafe, catch_unwind};

use toml::Table;

use super::Check;
use super::scenarios::Scenario;
use super::synthetic::{Event, Model, View};
use crate::plan::{EditPlan, Refused, RowOps};
use crate::policy::{
    AuxRequest, AuxView, DensityPolicy, Needs, PolicyError, PolicyState, Snapshot,
};
use crate::registry::PolicyEntry;
use crate::rng::PolicyRng;

/// Maximum number of auxiliary views per event.
const MAX_VIEWS: u32 = 3;

type Failure = (Check, String);

/// Runs a scenario with several copies of the policy: two as in training, one that is shown more than it
/// declares, and two restored from states saved one third and two thirds of the way through the run. All must make
/// the same plans; a copy that differs fails the check stored with it. Returns true if any plan edited the model.
pub(super) fn run(entry: &PolicyEntry, set: &Table, scenario: &Scenario) -> Result<bool, Failure> {
    let scene = &scenario.scene;
    let build = || {
        let built = catch_panic(|| entry.build(set, scene));
        built.and_then(|built| built.map_err(|e| e.to_string())).map_err(|e| (Check::Builds, e))
    };
    let mut policy = build()?;
    let mut copies: Vec<(Check, Box<dyn DensityPolicy>)> =
        vec![(Check::IsDeterministic, build()?), (Check::ReadsOnlyDeclared, build()?)];
    check_foreign_state(&mut *build()?)?;
    let needs = policy.needs(scene);
    check_needs(&*policy, &needs, scenario)?;
    if needs != policy.needs(scene) || needs != copies[0].1.needs(scene) {
        return Err((Check::IsDeterministic, "its needs differ between calls".to_owned()));
    }

    let due: Vec<u32> = (1..=scene.iterations).filter(|&step| policy.is_due(step)).collect();
    let mut model = Model { rows: scene.initial_rows, candidates: Vec::new() };
    let mut edits = false;
    let events = due.len().min(scenario.max_events());
    for (event, &step) in due.iter().take(events).enumerate() {
        let rows = model.rows;
        let locate = |(check, e): Failure| (check, format!("step {step}, {rows} rows: {e}"));
        if event == events / 3 || event == 2 * events / 3 {
            copies.push((Check::RestoresState, restored(&*policy, build()?).map_err(locate)?));
        }
        let ops = run_event(&mut *policy, &mut copies, &needs, scenario, &mut model, step);
        let ops = ops.map_err(locate)?;
        edits |= ops.edits_rows();
        model.apply(&ops);
    }
    Ok(edits)
}

/// Checks that the needs, and the values that may vary by step, are consistent and in range.
fn check_needs(
    policy: &dyn DensityPolicy,
    needs: &Needs,
    scenario: &Scenario,
) -> Result<(), Failure> {
    let out_of_range = |reason| (Check::DeclaresValidNumbers, reason);
    needs.check().map_err(out_of_range)?;
    let mut steps = 1..=scenario.scene.iterations;
    for step in steps.clone() {
        let at_step = |reason| out_of_range(format!("at step {step}, {reason}"));
        policy.loss_terms(step, needs.loss_terms).check().map_err(at_step)?;
        policy.noise(step, needs.noise).map_or(Ok(()), |noise| noise.check()).map_err(at_step)?;
        needs.check_resolution(policy.resolution(step)).map_err(at_step)?;
    }
    match steps.find(|&step| !policy.cadence(step).is_within(needs.cadence)) {
        None => Ok(()),
        Some(step) => {
            let (cadence, longest) = (policy.cadence(step), needs.cadence);
            Err(out_of_range(format!("at step {step}: {cadence:?}, but {longest:?} was declared")))
        }
    }
}

/// One event: the policy plans, and every copy must do the same.
fn run_event(
    policy: &mut dyn DensityPolicy,
    copies: &mut [(Check, Box<dyn DensityPolicy>)],
    needs: &Needs,
    scenario: &Scenario,
    model: &mut Model,
    step: u32,
) -> Result<RowOps, Failure> {
    let (rows, budget) = (model.rows, scenario.budget(model.rows));
    let (pattern, scene) = (scenario.pattern_at(step), &scenario.scene);
    let event = model.event(pattern, scene, step, needs);
    let aux = policy.aux_views(step, rows, budget);
    if aux > 0 && needs.aux.is_none() {
        let reason = "it requests auxiliary views, but its needs do not say what to measure there";
        return Err((Check::RequestsConsistently, reason.to_owned()));
    }
    let request = needs.aux.clone().unwrap_or_default();
    let views: Vec<View> = (0..aux.min(scene.train_views).min(MAX_VIEWS))
        .map(|view| model.view(pattern, step, view, &request))
        .collect();
    let schedule = |policy: &dyn DensityPolicy| {
        let terms = policy.loss_terms(step, needs.loss_terms);
        let resolution = policy.resolution(step);
        (policy.cadence(step), terms, policy.noise(step, needs.noise), resolution)
    };
    // The schedule is read before planning, as a plan may change the policy's state.
    let expected = schedule(policy);
    observe(policy, step, rows, &views, &request, false)?;
    let ops = plan(policy, scenario, &event, needs, false)?;
    for (check, copy) in copies {
        let differs = |difference: &str| (*check, format!("a copy {difference}"));
        if !copy.is_due(step) {
            return Err(differs("is not due at this step"));
        }
        if copy.aux_views(step, rows, budget) != aux || schedule(&**copy) != expected {
            return Err(differs("differs in views, cadence, resolution, loss terms or noise"));
        }
        let sees_all = *check == Check::ReadsOnlyDeclared;
        observe(&mut **copy, step, rows, &views, &request, sees_all)?;
        let again = plan(&mut **copy, scenario, &event, needs, sees_all)?;
        if again != ops {
            return Err((*check, format!("it planned {ops:?}, but a copy {again:?}")));
        }
        if copy.save() != policy.save() {
            return Err(differs("saves a different state"));
        }
    }
    Ok(ops)
}

/// Shows the views to a policy: only declared columns and points or, if it `sees_all`, all of them.
fn observe(
    policy: &mut dyn DensityPolicy,
    step: u32,
    rows: usize,
    views: &[View],
    request: &AuxRequest,
    sees_all: bool,
) -> Result<(), Failure> {
    for view in views {
        let columns = view.columns.iter();
        let columns = columns.filter(|(column, _)| sees_all || request.columns.contains(column));
        let columns: Vec<_> = columns.cloned().collect();
        // With `sees_all`, a policy that requested no points is shown all of them; one that requested some is
        // shown no more than those.
        let max_points =
            if sees_all && request.points == 0 { usize::MAX } else { request.points as usize };
        let points = &view.points[..max_points.min(view.points.len())];
        let view = AuxView { step, rows, loss: view.loss, columns: &columns, points };
        let observed = catch_panic(|| policy.observe(&view)).map_err(unexpected_error)?;
        observed.map_err(|error| match error {
            PolicyError::UndeclaredColumn { column } => {
                (Check::ReadsOnlyDeclared, format!("{column:?} was read but not declared"))
            }
            error => unexpected_error(error.to_string()),
        })?;
    }
    Ok(())
}

/// Lets a policy write its plan from the declared inputs only or, if it `sees_all`, from all inputs.
fn plan(
    policy: &mut dyn DensityPolicy,
    scenario: &Scenario,
    event: &Event,
    needs: &Needs,
    sees_all: bool,
) -> Result<RowOps, Failure> {
    let has_candidates = sees_all || needs.candidates.is_some();
    let now = Snapshot {
        step: event.step,
        scene: &scenario.scene,
        signals: if sees_all { &event.all } else { &event.declared },
        candidates: if has_candidates { &event.candidates } else { &[] },
    };
    let rows = now.rows();
    let budget = scenario.budget(rows);
    let mut plan = EditPlan::new(rows, budget).allowing(needs);
    let rng = PolicyRng::new(3, event.step);
    let planned = catch_panic(|| policy.plan(&now, &rng, &mut plan)).map_err(unexpected_error)?;
    planned.map_err(|error| match error {
        PolicyError::Undeclared { signal } => {
            (Check::ReadsOnlyDeclared, format!("{signal:?} was read but not declared"))
        }
        error => unexpected_error(error.to_string()),
    })?;
    if plan.was_undeclared() {
        return Err((Check::DeclaresEdits, Refused::Undeclared.to_string()));
    }
    let ops = plan.compile();
    if (ops.rows_before, ops.budget) != (rows, budget) || ops.rows_after > budget {
        let reason = format!("given {rows} rows and budget {budget}, it planned {ops:?}");
        return Err((Check::KeepsPlan, reason));
    }
    if rows > 0 && ops.rows_after == 0 {
        return Err((Check::LeavesARow, "all rows were pruned".to_owned()));
    }
    Ok(ops)
}

fn unexpected_error(reason: String) -> Failure {
    (Check::NeverFails, reason)
}

/// Gives `copy` the policy's state, through JSON text as in a checkpoint.
fn restored(
    policy: &dyn DensityPolicy,
    mut copy: Box<dyn DensityPolicy>,
) -> Result<Box<dyn DensityPolicy>, Failure> {
    let failure = |reason| (Check::RestoresState, reason);
    let text = policy.save().to_string();
    let state: PolicyState =
        serde_json::from_str(&text).map_err(|error| failure(error.to_string()))?;
    let result = catch_panic(|| copy.restore(state)).map_err(failure)?;
    result.map_err(|error| failure(error.to_string()))?;
    Ok(copy)
}

fn check_foreign_state(policy: &mut dyn DensityPolicy) -> Result<(), Failure> {
    let foreign = serde_json::json!({ "conformance": "not a state" });
    let reason = match catch_panic(|| policy.restore(foreign)) {
        Ok(Err(PolicyError::State(_))) => return Ok(()),
        Ok(Err(error)) => format!("the state was refused with the wrong error: {error}"),
        Ok(Ok(())) => "the state was accepted".to_owned(),
        Err(panic) => panic,
    };
    Err((Check::RejectsForeignState, reason))
}

/// The result of `action`, or the message of its panic.
fn catch_panic<T>(action: impl FnOnce() -> T) -> Result<T, String> {
    catch_unwind(AssertUnwindSafe(action)).map_err(|panic: Box<dyn Any + Send>| {
        let text = panic.downcast_ref::<String>().map(String::as_str);
        let text = text.or_else(|| panic.downcast_ref::<&str>().copied());
        format!("panic: {}", text.unwrap_or("no message"))
    })
}
