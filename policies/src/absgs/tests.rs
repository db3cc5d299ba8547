//! Tests of the rules of `absgs`, each worked out by hand.

use super::*;
use crate::adc::{clone_at, split_by};
use crate::event::{Event, Outcome, assert_conforms, due_steps};
use crate::plan::{EditCounts, Offspring};

fn run(event: &Event, set: &str) -> Outcome {
    event.run("absgs", set)
}

/// Rows of opacity 0.5, seen by four views. The extent is 10, so rows up to a size of 0.01 are small.
fn event(step: u32, screen: &[f32], absolute: &[f32], scale: &[f32], budget: usize) -> Event {
    let in_four_views = |mean: &[f32]| -> Vec<f32> { mean.iter().map(|g| 4.0 * g).collect() };
    Event::small_rows(step, screen.len(), budget)
        .with(Signal::ScreenGradient, &in_four_views(screen))
        .with(Signal::ScreenGradientAbs, &in_four_views(absolute))
        .with(Signal::ScaleMax, scale)
}

#[test]
fn gradients_that_cancel_out_split_large_rows_only() {
    // The finding of the paper: row 0 is large, its gradients cancel out, and the original method would leave it as it
    // is. A small row (1) is cloned by its screen gradient alone, and a large one (3) is not split by it.
    let event = event(
        600,
        &[0.0, 0.0, 2.1e-4, 1.0],
        &[4.1e-4, 1.0, 0.0, 3.9e-4],
        &[0.011, 0.01, 0.01, 0.011],
        99,
    );
    let done = run(&event, "");
    assert_eq!((&done.split[..], &done.cloned[..]), (&[0][..], &[2][..]));
    let mut offspring = done.offspring();
    offspring.sort_by_key(Offspring::siblings);
    assert_eq!(offspring, [clone_at([0.0; 3]), split_by(1.6)]);
    assert_eq!((done.ops.cause.as_str(), done.ops.reset_signals.is_empty()), ("densify", false));
    // With the thresholds exchanged, the others grow.
    let done = run(&event, "tau = 0.0\ntau_abs = 0.00038");
    assert_eq!((done.split.len(), done.cloned.len()), (2, 2));
}

#[test]
fn growth_stops_hard_at_the_budget() {
    // Multiples of the thresholds: 3, 2, 5, 4.
    let event =
        event(600, &[6e-4, 0.0, 0.0, 8e-4], &[0.0, 8e-4, 2e-3, 0.0], &[0.01, 1.0, 1.0, 0.01], 6);
    let done = run(&event, "");
    assert_eq!((&done.split[..], &done.cloned[..]), (&[2][..], &[3][..]));
    assert_eq!((done.ops.rows_after, done.ops.counts.denied), (6, 2));
    assert_eq!(run(&Event { budget: 4, ..event.clone() }, "").ops.rows_after, 4);
    // A threshold of 0 ranks by the gradient.
    let done = run(&Event { budget: 5, ..event }, "tau = 0.0\ntau_abs = 0.0");
    assert_eq!(done.split, [2]);
}

#[test]
fn faint_and_huge_rows_are_pruned() {
    let faint = event(3100, &[0.0; 4], &[1.0; 4], &[0.1, 0.1, 1.5, 1.7], 99)
        .with(Signal::Opacity, &[0.004, 0.005, 0.5, 0.5]);
    let done = run(&faint, "");
    assert_eq!((done.pruned, done.split.len()), (vec![0], 3));
    // Row 2 is smaller than 0.1 · 10 after its split, row 3 is not.
    let done = run(&faint, "max_scale = 0.1");
    assert_eq!((done.pruned, done.split.len()), (vec![0, 3], 2));
    let early = Event { step: 3000, ..faint };
    assert_eq!(run(&early, "max_scale = 0.1\ntau_abs = 9.0").pruned, [0]);
}

#[test]
fn faint_rows_are_pruned_once_late_in_the_run() {
    let late = event(18_000, &[1.0; 3], &[1.0; 3], &[0.1; 3], 99)
        .with(Signal::Opacity, &[0.11, 0.09, 0.08]);
    let all = "last_prune_share = 1.0";
    let done = run(&late, all);
    assert_eq!((done.pruned, done.split.len()), (vec![1, 2], 0));
    assert_eq!((done.ops.cause.as_str(), done.ops.clamp_opacity), ("last-prune", None));
    assert_eq!(run(&late, &format!("{all}\nlast_prune_opacity = 0.2")).pruned, [1, 2]);
    // At most half of the rows are pruned, the faintest.
    assert_eq!(run(&late, "").pruned, [2]);
    // The late prune may coincide with growth, after which one row is left.
    let twice = Event { step: 600, ..late }.with(Signal::Opacity, &[0.003, 0.004, 0.05]);
    let done = run(&twice, "last_prune_at = 600\ntau_abs = 9.0\nlast_prune_share = 1.0");
    assert_eq!((done.pruned, done.ops.rows_after), (vec![0, 1], 1));
    let done = run(&twice, "last_prune_at = 600\ntau_abs = 9.0\nmin_opacity = 0.01");
    let counts = EditCounts { removed: 2, added: 0, updated: 0, denied: 0 };
    assert_eq!(done.ops.counts, counts);
}

#[test]
fn opacities_are_limited_and_reset() {
    let scene = Event::new(1, 1, 1).scene;
    let due = due_steps("absgs", "grow_every = 0", &scene);
    let mut expected: Vec<u32> = (1..30).map(|event| 500 * event).collect();
    expected.push(18_000);
    assert_eq!(due, expected);
    let limit = |step| {
        let event = event(step, &[0.0; 2], &[0.0; 2], &[0.1; 2], 9);
        run(&event, "").ops.clamp_opacity
    };
    assert_eq!(
        [500, 600, 2500, 3000, 12_000].map(limit),
        [Some(0.8), None, Some(0.8), Some(0.01), Some(0.01)]
    );
    let white = SceneInfo { white_background: true, ..scene };
    let policy = crate::event::build("absgs", "limit_every = 0\ngrow_every = 0", &white);
    assert!(policy.is_due(500) && !policy.is_due(1000) && policy.is_due(3000));
}

#[test]
fn other_parameter_values_conform() {
    assert_conforms(
        "absgs",
        &[
            "tau = 0.0\ntau_abs = 0.0\nsmall = 0.0",
            "min_opacity = 0.5\nlast_prune_opacity = 1.0\nmax_scale = 0.1\nmax_scale_from = 0",
            "last_prune_at = 200\nlimit_every = 0\nreset_every = 0",
        ],
    );
}
