//! Tests of the rules of `vanilla`, one event at a time.

use super::*;
use crate::event::{Event, Outcome, assert_conforms, due_steps};
use crate::plan::{EditCounts, OpacityRule, ParentFate, Placement, ScaleRule};

fn run(event: &Event, set: &str) -> Outcome {
    event.run("vanilla", set)
}

/// Rows of opacity 0.5 and size 0.05 (small, as the extent is 10), seen by four views.
fn event(step: u32, gradient_sums: &[f32], budget: usize) -> Event {
    Event::small_rows(step, gradient_sums.len(), budget).with(Signal::ScreenGradient, gradient_sums)
}

#[test]
fn the_threshold_applies_to_the_mean_over_views() {
    // Means over 4 views: just above 2e-4, just below it, 1e-3; no view saw the last row.
    let event = event(600, &[8.01e-4, 7.99e-4, 4e-3, 1.0], 100)
        .with(Signal::VisibleCount, &[4.0, 4.0, 4.0, 0.0]);
    let done = run(&event, "");
    assert_eq!(done.cloned, [2, 0]);
    assert!(done.split.is_empty() && done.pruned.is_empty());
    assert_eq!(done.ops.rows_after, 6);
    assert_eq!(done.ops.reset_signals, [Signal::VisibleCount, Signal::ScreenGradient].into());
    assert!(done.ops.clamp_opacity.is_none());
    assert_eq!(done.ops.cause, "densify");
}

#[test]
fn small_rows_are_cloned_and_large_ones_split() {
    let event = event(600, &[1.0, 2.0, 3.0], 100).with(Signal::ScaleMax, &[0.1, 0.101, 5.0]);
    let done = run(&event, "");
    assert_eq!(done.cloned, [0]);
    assert_eq!(done.split, [2, 1]);
    let split = done.offspring()[0];
    assert_eq!((split.children, split.parent), (1, ParentFate::BecomesChild));
    assert_eq!(split.placement, Placement::Sampled);
    assert_eq!(split.scale, ScaleRule::Uniform(0.625));
    assert_eq!(split.opacity, OpacityRule::Same);
    let clone = done.offspring()[2];
    assert_eq!((clone.children, clone.parent), (1, ParentFate::Stays));
    assert_eq!(clone.placement, Placement::Offset([0.0; 3]));
    assert_eq!((clone.scale, clone.opacity), (ScaleRule::Uniform(1.0), OpacityRule::Same));
    assert_eq!(done.ops.counts, EditCounts { removed: 0, added: 3, updated: 2, denied: 0 });
}

#[test]
fn faint_rows_are_pruned_and_do_not_grow() {
    let event = event(600, &[0.0, 9.0, 9.0, 0.0], 100)
        .with(Signal::Opacity, &[0.0049, 0.0049, 0.005, f32::NAN]);
    let done = run(&event, "");
    assert_eq!(done.pruned, [0, 1, 3]);
    assert_eq!(done.cloned, [2]);
}

#[test]
fn huge_rows_are_pruned_after_step_3000_unless_a_split_makes_them_small() {
    // The limit is 1.0. Row 2 would have children of size 0.9375, row 3 of size 1.25.
    let event =
        event(3000, &[0.0, 0.0, 9.0, 9.0], 100).with(Signal::ScaleMax, &[1.0, 1.01, 1.5, 2.0]);
    let early = run(&event, "");
    assert!(early.pruned.is_empty());
    assert_eq!(early.split, [2, 3]);
    let late = run(&Event { step: 3100, ..event.clone() }, "");
    assert_eq!(late.pruned, [1, 3]);
    assert_eq!(late.split, [2]);
    // A huge row is pruned if there is no room for its split.
    let full = run(&Event { step: 3100, budget: 4, ..event }, "");
    assert_eq!(full.pruned, [1, 2, 3]);
    assert_eq!(full.ops.counts.denied, 1);
}

#[test]
fn at_the_budget_growth_stops_and_pruning_continues() {
    let event = event(600, &[9.0, 8.0, 0.0], 3).with(Signal::Opacity, &[0.5, 0.5, 0.001]);
    let done = run(&event, "");
    assert!(done.cloned.is_empty());
    assert_eq!(done.pruned, [2]);
    assert_eq!(done.ops.counts, EditCounts { removed: 1, added: 0, updated: 0, denied: 2 });
}

#[test]
fn the_largest_gradients_grow_first() {
    let done = run(&event(600, &[1.0, 3.0, 2.0, 3.0, 4.0], 8), "");
    assert_eq!(done.cloned, [4, 1, 3]);
    assert_eq!(done.ops.counts.denied, 2);
    assert_eq!(done.ops.rows_after, 8);
}

#[test]
fn the_schedule_matches_the_original() {
    let due = |set: &str, white_background, iterations| {
        let scene = SceneInfo { white_background, iterations, ..Event::new(1, 1, 1).scene };
        due_steps("vanilla", set, &scene)
    };
    let densify = due("", false, 30_000);
    assert_eq!((densify.len(), densify[0], densify.last()), (144, 600, Some(&14_900)));
    assert_eq!(due("grow_every = 0", false, 30_000), [3000, 6000, 9000, 12_000]);
    assert_eq!(due("grow_every = 0", true, 30_000), [500, 3000, 6000, 9000, 12_000]);
    assert_eq!(due("grow_every = 0", true, 3_000), [50, 300, 600, 900, 1200]);
    assert_eq!(due("grow_every = 0\nreset_every = 0\nwhite_reset_at = 0", true, 30_000), [0; 0]);
}

#[test]
fn a_reset_and_growth_can_share_an_event() {
    let grown = run(&event(3000, &[9.0], 8), "");
    assert_eq!(grown.cloned, [0]);
    assert_eq!(grown.ops.clamp_opacity, Some(0.01));
    assert!(!grown.ops.reset_signals.is_empty());
    assert_eq!(grown.ops.cause, "densify+reset");
    let mut white = event(500, &[9.0], 8);
    white.scene.white_background = true;
    let reset = run(&white, "");
    assert!(reset.cloned.is_empty() && reset.ops.reset_signals.is_empty());
    assert_eq!((reset.ops.clamp_opacity, reset.ops.cause.as_str()), (Some(0.01), "reset"));
}

#[test]
fn the_governor_follows_the_curve_and_not_the_threshold() {
    // S = 4, B = 290 + 4, M = 145. Event 1: 4 + 290·(2/145 − 1/145²) = 7.986.
    let mut event = event(600, &[0.0, 1e-9, 3e-9, 2e-9], 294);
    assert_eq!(run(&event, "governor = true").cloned, [2, 3, 1]);
    event.scene.budget = 149;
    // 4 + 145·(2/145 − 1/145²) = 5.993: one more row.
    assert_eq!(run(&event, "governor = true").cloned, [2]);
    // The last event, 144: 4 + 145·(1 − 1/145²) = 148.99.
    let last = run(&Event { step: 14_900, ..event.clone() }, "governor = true");
    assert_eq!(last.cloned, [2, 3, 1]);
    // A model above the curve, here of 4 rows instead of 2.04, does not grow.
    let mut ahead = event;
    ahead.scene.initial_rows = 2;
    ahead.scene.budget = 5;
    assert!(run(&ahead, "governor = true").cloned.is_empty());
}

#[test]
fn other_parameter_values_conform() {
    assert_conforms("vanilla", &["governor = true", "grow_every = 0"]);
}
