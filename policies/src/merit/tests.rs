//! Tests of the rules of `merit`, each worked out by hand.

use super::*;
use crate::event::{Event, Outcome, assert_conforms, due_steps};

/// Settings that switch off turnover and the colour gradient.
const BARE: &str = "rho = 0.0\nreplaceable = 0.0\ncolour_weight = 0.0\n";

fn run(event: &Event, set: &str) -> Outcome {
    let mut all: toml::Table = BARE.parse().unwrap();
    all.extend(set.parse::<toml::Table>().unwrap());
    event.run("merit", &all.to_string())
}

/// Old rows of opacity 0.5 and size 0.05 (small, as the extent is 10), seen by four views; gradient and
/// importance rise from row to row.
fn event(step: u32, rows: usize, budget: usize) -> Event {
    let rising: Vec<f32> = (1..=rows).map(|row| row as f32 / 100.0).collect();
    Event::small_rows(step, rows, budget)
        .with_all(Signal::Age, 1000.0)
        .with(Signal::ScreenGradientAbs, &rising)
        .with(Signal::WeightMax, &rising)
}

#[test]
fn the_curve_fills_the_budget_without_a_threshold() {
    // A quarter of the way: √(2000/8000) = 0.5, so 60 + (140 − 60) / 2 = 100.
    let event = event(2500, 60, 140);
    let done = run(&event, "curve_until = 8500");
    assert_eq!((done.ops.rows_after, done.pruned.len()), (100, 0));
    assert_eq!(done.cloned[..3], [59, 58, 57]);
    assert_eq!((done.ops.cause.as_str(), done.ops.reset_signals.is_empty()), ("grow", false));
    // After the curve has ended, it allows the whole budget, but each row has at most one child per event.
    let late = Event { step: 8600, ..event.clone() };
    assert_eq!(run(&late, "curve_until = 8500").ops.rows_after, 120);
    let low = Event { budget: 99, ..late };
    assert_eq!(run(&low, "curve_until = 8500").ops.rows_after, 99);
    // Pruned rows are replaced too, in their own slots.
    let mut opacity = vec![0.5; 60];
    opacity[7] = 0.004;
    opacity[9] = f32::NAN;
    let faint = run(&event.clone().with(Signal::Opacity, &opacity), "curve_until = 8500");
    assert_eq!((faint.pruned, faint.ops.rows_after), (vec![7, 9], 100));
    assert_eq!((faint.ops.counts.removed, faint.cloned.len()), (2, 42));
    // Pruned rows have no children.
    let late = Event { step: 8600, ..event.with(Signal::Opacity, &opacity) };
    let done = run(&late, "curve_until = 8500");
    assert_eq!((done.cloned.len(), done.ops.counts.denied), (58, 0));
}

#[test]
fn events_follow_the_schedule() {
    let scene = Event::new(1, 10, 10).scene;
    let due = due_steps("merit", "grow_until = 900\ngrow_every = 200", &scene);
    assert_eq!(due, [600, 800]);
    assert!(due_steps("merit", "grow_every = 0", &scene).is_empty());
}

#[test]
fn all_unimportant_rows_are_replaced() {
    // The upper median is 1.0: rows 0 to 2 are below 0.3.
    let mut importance = vec![1.0; 20];
    importance[..4].copy_from_slice(&[0.1, 0.2, 0.29, 0.31]);
    let event = event(600, 20, 20).with(Signal::WeightMax, &importance);
    let set = "replaceable = 0.3\nmost_rho = 100.0";
    let done = run(&event, set);
    assert_eq!((done.pruned, done.cloned), (vec![0, 1, 2], vec![19, 18, 17]));
    assert_eq!((done.ops.rows_after, done.ops.counts.denied), (20, 0));
    // Each of the 144 events (600 to 14,900) replaces at most 14.4 · 20 / 144 = 2 rows.
    let limited = run(&event, "replaceable = 0.3\nmost_rho = 14.4");
    assert_eq!(limited.pruned, [0, 1]);
    // At least `rho`, even if fewer are below the limit: 36 · 20 / 144 = 5.
    assert_eq!(run(&event, "replaceable = 0.3\nrho = 36.0").pruned, [0, 1, 2, 3, 4]);
    // Newborns are not replaced.
    let mut age = vec![1000.0; 20];
    age[1] = 99.0;
    let young = event.clone().with(Signal::Age, &age);
    assert_eq!(run(&young, set).pruned, [0, 2]);
    assert_eq!(run(&young, &format!("{set}\nprotect = 99")).pruned, [0, 1, 2]);
    // A row that is pruned for its opacity does not count as unimportant: three rows are replaced, not four.
    let mut opacity = vec![0.5; 20];
    opacity[0] = 0.004;
    let faint = run(&event.clone().with(Signal::Opacity, &opacity), set);
    assert_eq!((faint.pruned, faint.ops.rows_after), (vec![0, 1, 2], 20));
    // NaN is neither below the limit nor part of the median: the fifth of nine values is 1.0.
    importance[9..].fill(f32::NAN);
    assert_eq!(run(&event.with(Signal::WeightMax, &importance), set).pruned, [0, 1, 2]);
}

#[test]
fn the_least_important_rows_that_are_not_parents_are_pruned() {
    // The two rows with the largest gradients are also the least important.
    let mut gradient = vec![0.1; 6];
    gradient[..2].copy_from_slice(&[5.0, 6.0]);
    let event = event(600, 6, 6).with(Signal::ScreenGradientAbs, &gradient);
    // 48 · 6 / 144 = 2.
    let done = run(&event, "rho = 48.0");
    assert_eq!((done.pruned, done.cloned), (vec![2, 3], vec![1, 0]));
    // Newborns are pruned only if there are too few others, the oldest first.
    let young = event.with(Signal::Age, &[500.0, 500.0, 10.0, 30.0, 20.0, 200.0]);
    assert_eq!(run(&young, "rho = 48.0").pruned, [3, 5]);
    // With an epoch of ten steps all rows are old.
    let scene = SceneInfo { train_views: 10, ..young.scene.clone() };
    assert_eq!(run(&Event { scene, ..young }, "rho = 48.0").pruned, [2, 3]);
}

#[test]
fn parents_are_ranked_by_mean_screen_and_colour_gradients() {
    // g: 4/4 + 30·0; 1.5/3 + 30·0.06/3; 8/2; 0.
    let event = event(8600, 4, 5)
        .with(Signal::VisibleCount, &[4.0, 3.0, 2.0, 9.0])
        .with(Signal::ScreenGradientAbs, &[4.0, 1.5, 8.0, 0.0])
        .with(Signal::ScreenGradient, &[0.1, 0.0, 0.0, 0.9])
        .with(Signal::ColourGradient, &[0.0, 0.06, 0.0, 0.0]);
    let parent = |set: &str| run(&event, &format!("curve_until = 8500\n{set}")).cloned;
    assert_eq!(parent("colour_weight = 30.0"), [1]);
    assert_eq!(parent(""), [0]);
    assert_eq!(parent("least_views = 0"), [2]);
    assert_eq!(parent("gradient = \"screen\""), [3]);
    let roomy = Event { budget: 9, ..event.clone() };
    // A row without a gradient has no children.
    let all = run(&roomy, "curve_until = 8500\nleast_views = 0").cloned;
    assert_eq!(all, [2, 0, 1]);
}

#[test]
fn small_rows_are_cloned_and_large_ones_split() {
    // The limit is 0.01 times the extent of 10.
    let event = event(8600, 2, 4).with(Signal::ScaleMax, &[0.1, 0.11]);
    let done = run(&event, "curve_until = 8500");
    assert_eq!((&done.cloned[..], &done.split[..]), (&[0][..], &[1][..]));
    assert_eq!(done.offspring(), [split_long_axis(0.45, 0.6), clone_at([0.0; 3])]);
    assert_eq!(run(&event, "curve_until = 8500\nsmall = 0.0").split, [1, 0]);
}

#[test]
fn needs_list_only_used_signals() {
    let scene = Event::new(1, 10, 10).scene;
    let needs = |set| crate::event::build("merit", set, &scene).needs(&scene);
    assert!((needs("").full_depth - 8.0).abs() < 1e-6);
    assert_eq!(needs("").signals.count(), 7);
    let minimal = "colour_weight = 0.0\nsmall = 0.0\nprotect = 0\nfull_depth = 0.0";
    assert_eq!((needs(minimal).signals.count(), needs(minimal).full_depth.to_bits()), (4, 0));
}

#[test]
fn the_pixel_loss_depends_on_the_views_unless_it_is_set() {
    crate::event::assert_pixel_loss("merit");
}

#[test]
fn other_parameter_values_conform() {
    assert_conforms(
        "merit",
        &[
            "gradient = \"screen\"\ncolour_weight = 0.0\nsmall = 0.0\nprotect = 0",
            "rho = 50.0\nleast_views = 0\ncurve_until = 0",
            "replaceable = 2.0\nmost_rho = 100.0\nmin_opacity = 0.5",
        ],
    );
}
