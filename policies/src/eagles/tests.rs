//! Tests of the rules of `eagles`, each worked out by hand.

#![expect(clippy::float_cmp, reason = "values are exact, or rounded before they are compared")]

use super::*;
use crate::event::{Event, Outcome, assert_conforms, assert_grows_like_vanilla, build, due_steps};
use crate::parameters::REFERENCE_ITERATIONS;
use crate::policy::SignalSet;

fn run(event: &Event, set: &str) -> Outcome {
    event.run("eagles", set)
}

/// Rows with this influence; the growth rules neither densify nor prune them.
fn event(step: u32, influence: &[f32]) -> Event {
    Event::small_rows(step, influence.len(), influence.len()).with(Signal::WeightSum, influence)
}

#[test]
fn the_least_influential_rows_are_pruned_and_sums_are_reset() {
    // The 0.15 quantile of 0..=20 is 3: four rows are at or below it.
    let influence: Vec<f32> = (0..21_u8).rev().map(f32::from).collect();
    let done = run(&event(5100, &influence), "");
    assert_eq!(done.pruned, [17, 18, 19, 20]);
    assert_eq!(done.ops.cause, "prune");
    assert_eq!(done.ops.reset_signals, SignalSet::from([Signal::WeightSum]));
    assert_eq!(run(&event(5100, &influence), "prune_share = 0.5").pruned.len(), 11);
    assert!(run(&event(5100, &influence), "prune_share = 0").pruned == [20]);
    // One row is left.
    assert_eq!(run(&event(5100, &influence), "prune_share = 1.0").pruned.len(), 20);
    // Rows that were visible in no view have equal influence and are pruned together.
    let unseen = [0.0, 5.0, 0.0, f32::NAN, 0.0, 7.0, 8.0, 9.0];
    assert_eq!(run(&event(5100, &unseen), "").pruned, [0, 2, 3, 4]);
}

#[test]
fn the_resolution_rises_along_half_a_cosine() {
    let factor = |set: &str, step| {
        let policy = build("eagles", set, &Event::new(1, 1, 1).scene);
        (policy.resolution(step) * 1e6).round() / 1e6
    };
    // 1 − 0.7·½·(1 + cos(π·t/21,000)): 1 − 0.7·¾ at a third, 1 − 0.35 at half, 1 − 0.7·¼ at two thirds of 21,000.
    let factors = [0, 7000, 10_500, 14_000, 20_999, 21_000, 30_000].map(|step| factor("", step));
    assert_eq!(factors, [0.3, 0.475, 0.65, 0.825, 1.0, 1.0, 1.0]);
    assert_eq!([1, 500].map(|step| factor("whole_from = 0", step)), [1.0, 1.0]);
    assert_eq!(factor("first_resolution = 1.0", 1), 1.0);
    assert_eq!(factor("first_resolution = 0.5\nwhole_from = 100", 50), 0.75);
    let scene = Event::new(1, 1, 1).scene;
    let declared = |set: &str| build("eagles", set, &scene).needs(&scene).least_resolution;
    assert_eq!(declared(""), Some(0.3));
    assert_eq!([declared("whole_from = 0"), declared("first_resolution = 1.0")], [None, None]);
}

#[test]
fn the_schedule_is_the_published_one() {
    let due = |set: &str, iterations| {
        let scene = SceneInfo { iterations, ..Event::new(1, 1, 1).scene };
        due_steps("eagles", set, &scene)
    };
    let prunes_only = "grow_every = 0\nreset_every = 0";
    assert_eq!(due(prunes_only, REFERENCE_ITERATIONS), [5100, 10_200, 15_300, 20_400, 25_500]);
    // 7,000/30,000 of 5,100 and 27,000: 1190 and 6300.
    assert_eq!(due(prunes_only, 7000), [1190, 2380, 3570, 4760, 5950]);
    let growth = due("prune_every = 0\nreset_every = 0", REFERENCE_ITERATIONS);
    assert_eq!((growth.len(), growth[0], growth.last()), (139, 625, Some(&17_875)));
    let resets = due("prune_every = 0\ngrow_every = 0", REFERENCE_ITERATIONS);
    assert_eq!(resets, [2500, 5000, 7500, 10_000, 12_500, 15_000, 17_500]);
}

#[test]
fn growth_is_that_of_vanilla() {
    let defaults =
        "grow_every = 125\ngrow_until = 18000\nreset_every = 2500\nmax_scale_from = 2500";
    assert_grows_like_vanilla("eagles", event(625, &[1.0; 4]), defaults);
}

#[test]
fn rows_that_grow_in_an_event_are_not_pruned_in_it() {
    // The ⅓ quantile is 1; rows 0 and 1 are at or below it, and row 0 is cloned.
    let event = Event { budget: 9, ..event(625, &[0.5, 1.0, 3.0, 4.0]) }
        .with(Signal::ScreenGradient, &[1.0, 0.0, 0.0, 0.0]);
    let done = run(&event, "prune_every = 625\nprune_share = 0.3333334");
    assert_eq!((done.cloned.as_slice(), done.pruned.as_slice()), (&[0][..], &[1][..]));
    assert_eq!((done.ops.cause.as_str(), done.ops.counts.denied), ("densify+prune", 0));
}

#[test]
fn the_control_prunes_the_same_number_at_random() {
    let influence: Vec<f32> = (0..1000_u16).map(f32::from).collect();
    let done = run(&event(5100, &influence), "victims = \"random\"\nprune_share = 0.5");
    assert_eq!(done.pruned.len(), 500);
    assert!(done.pruned.iter().any(|row| *row >= 500));
}

#[test]
fn other_parameter_values_conform() {
    assert_conforms(
        "eagles",
        &[
            "victims = \"random\"\ngovernor = true",
            "whole_from = 0\nprune_every = 100\nprune_share = 1.0",
            "first_resolution = 0.01\nprune_every = 125",
        ],
    );
}
