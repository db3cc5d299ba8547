//! Tests of the rules of `merit`, each worked out by hand.

use super::*;
use crate::event::{Event, Outcome, due_steps};

/// Nothing but the rule in question.
const BARE: &str =
    "rho = 0\nmu = 0\nerror_share = 0\ntax = 0\ncolour_weight = 0\nleast_views = 0\n";

fn run(event: &Event, set: &str) -> Outcome {
    event.run("merit", &format!("{BARE}{set}"))
}

/// Old rows of opacity 0.5 that four views saw, of which each later one is needed and missed more.
fn event(step: u32, rows: usize, budget: usize) -> Event {
    let rising: Vec<f32> = (1..=rows).map(|row| row as f32).collect();
    Event::new(step, rows, budget)
        .with_all(Signal::VisibleCount, 4.0)
        .with_all(Signal::Opacity, 0.5)
        .with_all(Signal::ScaleMax, 0.05)
        .with_all(Signal::Age, 1000.0)
        .with(Signal::ScreenGradientAbs, &rising)
        .with(Signal::WeightMaxRoot, &rising)
}

#[test]
fn the_curve_fills_the_budget_without_a_threshold() {
    // A quarter of the way: √(2000/8000) = 0.5, so 60 + (140 − 60) / 2 = 100.
    let event = event(2500, 60, 140);
    let done = run(&event, "curve_until = 8500");
    assert_eq!((done.ops.rows_after, done.pruned.len()), (100, 0));
    assert_eq!(done.split[..3], [59, 58, 57]);
    assert_eq!((done.ops.cause.as_str(), done.ops.reset_signals.is_empty()), ("grow", false));
    // With power 1: 60 + 80/4.
    assert_eq!(run(&event, "curve_until = 8500\ncurve = 1.0").ops.rows_after, 80);
    // Each row has at most one child in an event, and after the curve's end the budget is full.
    let late = Event { step: 8600, ..event };
    assert_eq!(run(&late, "curve_until = 8500").ops.rows_after, 120);
    let low = Event { budget: 99, ..late };
    assert_eq!(run(&low, "curve_until = 8500").ops.rows_after, 99);
}

#[test]
fn events_come_at_their_steps() {
    let scene = Event::new(1, 10, 10).scene;
    let due = due_steps("merit", "grow_until = 900\ngrow_every = 200", &scene);
    assert_eq!(due, [600, 800]);
    assert!(due_steps("merit", "grow_every = 0", &scene).is_empty());
}
