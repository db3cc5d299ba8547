//! Tests of the rules of `fastgs`, each worked out by hand.

use super::*;
use crate::event::{Event, Outcome, View, assert_conforms, build, due_steps};

fn run(event: &Event, set: &str) -> Outcome {
    event.run("fastgs", set)
}

/// Rows of opacity 0.5 and size 0.05 (large, as the extent is 10), seen by four views with absolute gradients of 1. Each
/// of the auxiliary views has a loss and a number of wrong pixels per row.
fn event(step: u32, views: &[(f32, &[f32])], budget: usize) -> Event {
    let rows = views[0].1.len();
    let mut event = Event::small_rows(step, rows, budget).with_all(Signal::ScreenGradientAbs, 4.0);
    let view = |&(loss, pixels): &(f32, &[f32])| View {
        loss,
        columns: vec![(AuxColumn::MapSum, pixels.to_vec())],
        points: Vec::new(),
    };
    event.views = views.iter().map(view).collect();
    event
}

/// Three rows in three views: the first has wrong pixels in all, the second many in one, the third hardly any.
const THREE_VIEWS: [(f32, &[f32]); 3] =
    [(0.2, &[8.0, 12.0, 1.0]), (0.05, &[6.0, 0.0, 0.0]), (0.1, &[7.0, 0.0, 1.0])];

#[test]
fn only_rows_with_wrong_pixels_in_several_views_grow() {
    // Importance: ⌊21/3⌋ = 7, ⌊12/3⌋ = 4, ⌊2/3⌋ = 0.
    let event = event(1000, &THREE_VIEWS, 99);
    let done = run(&event, "");
    assert_eq!((done.split, done.ops.rows_after), (vec![0], 4));
    assert_eq!(done.ops.cause, "densify");
    assert!(!done.ops.reset_signals.is_empty());
    assert_eq!(run(&event, "wrong_pixels = 6").split, [0]);
    assert!(run(&event, "wrong_pixels = 7").split.is_empty());
    assert_eq!(run(&event, "wrong_pixels = 3").split, [0, 1]);
    // The mean is rounded down: 6.99 is not more than 6.
    let mut less = event.clone();
    less.views[0].columns[0].1[0] = 7.9;
    assert!(run(&less, "wrong_pixels = 6").split.is_empty());
    // The gradient must be large, too: small rows are cloned by the screen gradient, large ones split by the other.
    let flat = event.clone().with(Signal::ScreenGradientAbs, &[4.0 * 1.1e-3, 4.0, 4.0]);
    assert!(run(&flat, "").split.is_empty());
    let small = event.clone().with(Signal::ScaleMax, &[0.01, 0.05, 0.05]);
    assert!(run(&small, "").cloned.is_empty());
    let small = small.with(Signal::ScreenGradient, &[8.1e-4, 0.0, 0.0]);
    assert_eq!(run(&small, "").cloned, [0]);
    // Fewer views are averaged over their own number: ⌊8/1⌋ = 8, 12, 1.
    assert_eq!(run(&event, "views = 1").split, [0, 1]);
}

#[test]
fn late_pruning_removes_faint_rows_and_those_that_remain_wrong() {
    // Σ L·n: 1.6 + 0.3 + 0.7 = 2.6; 2.4; 0.2 + 0.1 = 0.3. Scaled: 1; 2.1/2.3 = 0.913; 0.
    let late = event(18_000, &THREE_VIEWS, 99);
    // At most half of the rows are pruned.
    assert_eq!(run(&late, "").pruned.len(), 1);
    let run = |event: &Event, set: &str| run(event, &format!("late_prune_share = 1.0\n{set}"));
    let done = run(&late, "");
    assert_eq!((done.pruned, done.ops.cause.as_str()), (vec![0, 1], "late-prune"));
    assert_eq!((done.split.len(), done.ops.clamp_opacity), (0, None));
    assert_eq!(run(&late, "late_prune_score = 0.92").pruned, [0]);
    let faint = late.with(Signal::Opacity, &[0.5, 0.1, 0.09]);
    assert_eq!(run(&faint, "late_prune_score = 0.92").pruned, [0, 2]);
    // The most opaque row is spared.
    let all = run(&faint, "late_prune_score = 0.0\nlate_prune_opacity = 0.2");
    assert_eq!(all.ops.rows_after, 1);
    // Equal sums have a score of 0.
    let equal = event(18_000, &[(0.1, &[3.0; 3])], 99);
    assert!(run(&equal, "late_prune_score = 0.0").pruned.is_empty());
}

#[test]
fn half_of_the_dead_rows_are_pruned_by_their_scores() {
    // The pruning score of row 0 is 1, so its weight is 10⁶ times that of the others.
    let mut pixels = [0.0; 40];
    pixels[0] = 5.0;
    let mut opacity = [0.5; 40];
    opacity[..5].fill(0.004);
    let event = event(1000, &[(0.1, &pixels)], 40).with(Signal::Opacity, &opacity);
    let done = run(&event, "");
    assert!(done.pruned.len() == 2 && done.pruned[0] == 0 && done.pruned[1] < 5);
    assert_eq!(run(&event, "prune_share = 1.0").pruned, [0, 1, 2, 3, 4]);
    assert_eq!(done.ops.clamp_opacity, Some(0.8));
    // With a limit of size, after step 3000.
    let large = event.with(Signal::ScaleMax, &[1.1; 40]);
    let all = "prune_share = 1.0\nmax_scale = 0.1";
    assert_eq!(run(&large, all).pruned.len(), 5);
    assert_eq!(run(&Event { step: 3500, ..large }, all).ops.rows_after, 1);
}

#[test]
fn scores_of_another_event_are_forgotten() {
    let late = Event { views: Vec::new(), ..event(1500, &THREE_VIEWS, 99) };
    let mut policy = build("fastgs", "", &late.scene);
    let view = &event(1000, &THREE_VIEWS, 99).views[0];
    let columns = &view.columns;
    policy.observe(&AuxView { step: 1000, rows: 3, loss: 1.0, columns, points: &[] }).unwrap();
    assert!(late.run_policy(&mut *policy).unwrap().split.is_empty());
}

#[test]
fn growth_stops_hard_at_the_budget() {
    let event = event(1000, &[(0.1, &[9.0; 4])], 6)
        .with(Signal::ScreenGradientAbs, &[4.0, 8.0, 12.0, 4e-3]);
    let done = run(&event, "");
    assert_eq!((done.split, done.ops.rows_after, done.ops.counts.denied), (vec![2, 1], 6, 1));
}

#[test]
fn events_follow_the_published_schedule() {
    let scene = Event::new(1, 1, 1).scene;
    let due = due_steps("fastgs", "", &scene);
    let growth: Vec<u32> = (2..30).map(|event| 500 * event).collect();
    assert_eq!(due[..28], growth);
    assert_eq!(due[28..], [18_000, 21_000, 24_000, 27_000]);
    let policy = build("fastgs", "", &scene);
    assert_eq!([1000, 1001, 18_000].map(|step| policy.aux_views(step, 1, 9)), [10, 0, 10]);
    let reset = run(&event(3000, &THREE_VIEWS, 99), "").ops;
    assert_eq!((reset.clamp_opacity, reset.cause.as_str()), (Some(0.01), "densify+reset"));
    // Optimiser steps: 15,000, then ⌊20,000/32⌋ − ⌊15,000/32⌋ = 157, then 30,000/64 − 20,000/64 = 156.
    let steps = |until| (1..=until).filter(|&step| policy.cadence(step).steps_at(step)[0]).count();
    assert_eq!([15_000, 20_000, 30_000].map(steps), [15_000, 15_157, 15_313]);
    let sh = |until| (1..=until).filter(|&step| policy.cadence(step).steps_at(step)[1]).count();
    assert_eq!([15_000, 30_000].map(sh), [937, 1250]);
}

#[test]
fn sums_scale_with_the_run() {
    let cadences = |set: &str| {
        let scene = SceneInfo { iterations: 7500, ..Event::new(1, 1, 1).scene };
        let policy = build("fastgs", set, &scene);
        let longest = policy.needs(&scene).cadence;
        [3750, 3751, 5001].map(|step| policy.cadence(step)).map(|cadence| {
            assert!(cadence.is_within(longest));
            (cadence.all, cadence.sh_rest)
        })
    };
    assert_eq!(cadences(""), [(1, 4), (8, 1), (16, 1)]);
    assert_eq!(cadences("sums = \"fixed\""), [(1, 16), (32, 1), (64, 1)]);
}

#[test]
fn wrong_pixels_are_counted_in_the_map() {
    let scene = Event::new(1, 1, 1).scene;
    let needs = build("fastgs", "wrong = 0.25\nsh_rest = 0.5", &scene).needs(&scene);
    assert_eq!(needs.aux.unwrap().map, PixelMap { error: 1.0, edge: 0.0, threshold: 0.25 });
    assert_eq!(needs.rates.sh_rest, Some(Rate::constant(0.5)));
}

#[test]
fn other_parameter_values_conform() {
    assert_conforms(
        "fastgs",
        &[
            "wrong_pixels = 0\ntau = 0.0\ntau_abs = 0.0\nviews = 1",
            "prune_share = 1.0\nmin_opacity = 1.0\nlate_prune_opacity = 1.0\nlate_prune_score = 0.0\nlate_prune_share = 1.0",
            "sums = \"fixed\"\nmax_scale = 0.1\nmax_scale_from = 0\nsmall = 0.0",
        ],
    );
}
