//! Applies random plans in sequence to a backend and to a plain vector of Gaussians that implements the documented
//! semantics. Parameters, moments, ages, signals and the history of rows must agree, and the budget must hold.
//!
//! Moments cannot be read directly, but in a step without visible Gaussians a row moves only because of its moments and
//! age. An unedited twin backend provides the expected movement.

#![expect(clippy::float_cmp, reason = "rows must match bit for bit")]

mod calls;
mod plain;

use std::panic::{AssertUnwindSafe, catch_unwind};

use densify::core::camera::Camera;
use densify::render::Backend;
use densify::selftest::{Differentiable, Setup, Subject, scenes};
use densify::train::trainer::RowHistory;
use densify_policies::plan::{EditPlan, RowOps, Seed, Update};
use densify_policies::policy::{Needs, Signal, SignalSet};
use densify_policies::rng::PolicyRng;
use proptest::prelude::*;
use proptest::test_runner::TestRunner;

use crate::subject::{cases_on, make_with, repeatable, step_input, turned_away};
use calls::{Call, call, make_call};
use plain::{Row, execute};

const ROWS: usize = 37;
const SEED: u64 = 9;
/// Signals that edits must move with their rows: sums and age.
const SIGNALS: [Signal; 6] = [
    Signal::ScreenGradient,
    Signal::WeightMax,
    Signal::Age,
    Signal::VisibleCount,
    Signal::DepthMin,
    Signal::WeightSum,
];
/// Index in [`SIGNALS`] of the number of views in which a row was visible.
const SEEN: usize = 3;
const RESET_MOMENTS: Update = Update { keep_moments: false, ..Update::NONE };

fn view() -> Camera {
    scenes::camera(33, 25, 71)
}

fn needs() -> Needs {
    let signals = SignalSet::from(SIGNALS);
    Needs { signals, detailed_edits: true, ..Needs::default() }
}

fn step(backend: &mut dyn Backend, camera: &Camera, step: u32) -> usize {
    let target = scenes::target(camera);
    let input = step_input(step, camera, &target, 1);
    backend.train_step(&input).expect("a small image is rendered").visible
}

/// A trained backend with moments, signals and rows of different ages.
fn trained(subject: &Subject, budget: usize) -> Box<dyn Differentiable> {
    let model = scenes::cloud(ROWS, 1, &view(), 72);
    let setup = Setup { budget: budget.into(), needs: needs(), ..Setup::default() };
    let mut backend = make_with(subject, &model, setup);
    step(&mut *backend, &view(), 1);
    step(&mut *backend, &view(), 2);
    let mut plan = EditPlan::new(ROWS, budget).allowing(&needs());
    for row in (0..ROWS as u32).step_by(3) {
        plan.update(row, RESET_MOMENTS).expect("the row is free");
    }
    backend.apply(&plan.compile(), SEED, 2).expect("a plan is applied");
    step(&mut *backend, &view(), 3);
    backend
}

fn rows(backend: &mut dyn Backend) -> Vec<Row> {
    let model = backend.download().expect("a model");
    let signals = backend.take_signals(needs().signals).expect("signals are there");
    let value = |signal, row: usize| signals.get(signal).expect("a requested signal")[row];
    let row = |row: usize| Row {
        mean: model.means[row],
        log_scale: model.log_scales[row],
        quat: model.quats[row],
        logit: model.opacity_logits[row],
        sh: model.sh_of(row).to_vec(),
        signals: SIGNALS.map(|signal| value(signal, row)),
        moments: Some(row),
        opacity_rests: false,
        sh_rests_from: usize::MAX,
        has_decayed: false,
        steps: [1000 + row as u32; 2],
    };
    (0..model.len()).map(row).collect()
}

/// The rows of the unedited twin before and after a step without visible Gaussians.
fn twin(subject: &Subject) -> [Vec<Row>; 2] {
    let mut backend = trained(subject, ROWS);
    let before = rows(&mut *backend);
    assert_eq!(step(&mut *backend, &turned_away(&view()), 4), 0, "some Gaussians are visible");
    [before, rows(&mut *backend)]
}

/// The logit after a step, which clamps opacities to the safe range.
fn confined(logit: f32) -> f32 {
    logit.clamp(-9.2, 9.2)
}

/// Checks that values agree up to the rounding of a few operations.
fn assert_close(quantity: &str, row: usize, found: &[f32], expected: &[f32]) {
    let close = |(a, b): (&f32, &f32)| (a - b).abs() <= 2e-6 * (1.0 + a.abs().max(b.abs()));
    let agree = found.len() == expected.len() && found.iter().zip(expected).all(close);
    assert!(agree, "{quantity} of row {row}: {found:?}, expected {expected:?}");
}

fn check_rows(found: &[Row], expected: &[Row]) {
    assert_eq!(found.len(), expected.len());
    for (i, (found, expected)) in found.iter().zip(expected).enumerate() {
        assert_close("quat", i, &found.quat, &expected.quat);
        assert_eq!(found.signals, expected.signals, "{SIGNALS:?} of row {i}");
        assert_close("mean", i, &found.mean, &expected.mean);
        assert_close("log-scale", i, &found.log_scale, &expected.log_scale);
        // A decayed opacity has the same relative accuracy as before.
        let opacity = |row: &Row| 1.0 / (1.0 + (-f64::from(row.logit)).exp());
        let error = (opacity(found) - opacity(expected)).abs();
        if !expected.has_decayed || error > 2e-7 {
            assert_close("logit", i, &[found.logit], &[expected.logit]);
        }
        assert_close("sh", i, &found.sh, &expected.sh);
    }
}

/// Checks that a step without visible Gaussians moves each row like the twin's row with the same moments and age, and
/// no row with zero moments.
fn check_movement(twin: &[Vec<Row>; 2], before: &[Row], after: &[Row], expected: &[Row]) {
    let [twin_before, twin_after] = twin;
    for (i, expected) in expected.iter().enumerate() {
        let (from, to) = (&before[i], &after[i]);
        assert_eq!(to.signals[2], from.signals[2] + 1.0, "age of row {i}");
        let Some(twin_row) = expected.moments else {
            assert_eq!((from.mean, from.log_scale), (to.mean, to.log_scale), "newborn row {i}");
            assert_eq!((confined(from.logit), &from.sh), (to.logit, &to.sh), "newborn row {i}");
            assert_close("quat", i, &to.quat, &from.quat);
            continue;
        };
        let (was, is) = (&twin_before[twin_row], &twin_after[twin_row]);
        assert!(was.mean != is.mean, "row {twin_row} of the twin has no moments to compare");
        assert_eq!(to.quat, is.quat, "row {i}, twin row {twin_row}");
        let moved = |x: f32, was: f32, is: f32| x + (is - was);
        // Exact, except for rows that an update has moved.
        let follows = |quantity, from: &[f32], to: &[f32], was: &[f32], is: &[f32]| {
            let same = from == was;
            let moves =
                from.iter().zip(was.iter().zip(is)).map(|(x, (was, is))| moved(*x, *was, *is));
            assert_close(quantity, i, to, &moves.collect::<Vec<_>>());
            assert!(!same || to == is, "{quantity} of row {i}");
        };
        follows("mean", &from.mean, &to.mean, &was.mean, &is.mean);
        let moving = expected.sh_rests_from.min(from.sh.len());
        let upto = |row: &Row| row.sh[..moving].to_vec();
        follows("sh", &upto(from), &upto(to), &upto(was), &upto(is));
        assert_eq!(from.sh[moving..], to.sh[moving..], "dropped colour of row {i}");
        let scale = |a: usize| moved(from.log_scale[a], was.log_scale[a], is.log_scale[a]);
        assert_close("log-scale", i, &to.log_scale, &[0, 1, 2].map(scale));
        let logit = moved(from.logit, was.logit, is.logit);
        let logit = if expected.opacity_rests { from.logit } else { logit };
        assert_close("logit", i, &[to.logit], &[confined(logit)]);
    }
}

fn check_plans(subject: &Subject, twin: &[Vec<Row>; 2], spare: usize, plans: &[Vec<Call>]) {
    let budget = ROWS + spare;
    let mut backend = trained(subject, budget);
    let mut expected = rows(&mut *backend);
    // Start with distinct steps for every row.
    let steps: Vec<u32> = expected.iter().map(|row| row.steps[1]).collect();
    let mut history = RowHistory::from_edits(&steps, budget);
    for (event, calls) in (4..).zip(plans) {
        let mut plan = EditPlan::new(backend.rows(), budget).allowing(&needs());
        let taken: Vec<Call> =
            calls.iter().filter(|call| make_call(&mut plan, call)).cloned().collect();
        let ops = plan.compile();
        backend.apply(&ops, SEED, event).expect("a plan is applied");
        history.record(&ops, event);
        assert!(backend.rows() <= backend.budget());
        expected = execute(expected, &taken, budget, (&PolicyRng::new(SEED, event), event));
        check_rows(&rows(&mut *backend), &expected);
        let steps = |at: usize| expected.iter().map(|row| row.steps[at]).collect::<Vec<u32>>();
        assert_eq!([history.created(), history.edited()], [steps(0), steps(1)]);
    }
    let before = rows(&mut *backend);
    assert_eq!(step(&mut *backend, &turned_away(&view()), 9), 0);
    check_movement(twin, &before, &rows(&mut *backend), &expected);
}

#[test]
fn random_plans_match_the_plain_vector() {
    for subject in repeatable() {
        let twin = twin(&subject);
        let plans = prop::collection::vec(prop::collection::vec(call(), 0..40), 1..4);
        let outcome =
            TestRunner::new(cases_on(&subject, 32)).run(&(0..14_usize, plans), |(spare, plans)| {
                check_plans(&subject, &twin, spare, &plans);
                Ok(())
            });
        outcome.unwrap_or_else(|error| panic!("{}: {error}", subject.name()));
    }
}

/// `policies/src/ops/tests.rs` checks that plans keep these rules; backends check them again.
#[test]
fn a_corrupted_plan_stops_the_run() {
    type Corruption = (&'static str, fn(&mut RowOps));
    let corruptions: [Corruption; 4] = [
        ("another number of rows", |ops| ops.rows_before -= 1),
        ("another budget", |ops| ops.budget += 100),
        ("over the budget", |ops| ops.rows_after = ROWS + 3),
        ("an inconsistent plan", |ops| ops.seeds[0].0 = 1),
    ];
    for (words, corrupt) in corruptions {
        let mut backend = trained(&Subject::NATIVE, ROWS + 2);
        let mut plan = EditPlan::new(ROWS, ROWS + 2);
        plan.append(Seed::round([0.0; 3], [0.5; 3], 0.1, 0.1)).expect("there is room");
        let mut ops = plan.compile();
        corrupt(&mut ops);
        let apply = AssertUnwindSafe(|| backend.apply(&ops, SEED, 5).is_ok());
        let panic = catch_unwind(apply).expect_err(words);
        let message = panic.downcast::<String>().expect("a message");
        assert!(message.contains(words), "{message}");
    }
}
