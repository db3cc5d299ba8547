//! Tests of the rules of `igs`, each worked out by hand.

use super::*;
use crate::event::{Event, Outcome, View, assert_conforms, build, due_steps};

fn run(event: &Event, set: &str) -> Outcome {
    event.run("igs", set)
}

/// Rows of opacity 0.5, seen by four views with a mean absolute gradient of 1, with these edge sums
/// in one auxiliary view.
fn event(step: u32, edges: &[f32], budget: usize) -> Event {
    let mut event = Event::new(step, edges.len(), budget)
        .with_all(Signal::VisibleCount, 4.0)
        .with_all(Signal::ScreenGradientAbs, 4.0)
        .with_all(Signal::Opacity, 0.5);
    event.views = vec![view(edges)];
    event
}

fn view(edges: &[f32]) -> View {
    View { columns: vec![(AuxColumn::MapSum, edges.to_vec())], ..View::default() }
}

#[test]
fn growth_follows_the_square_root() {
    // 140 · √(3500/14000) = 70 at step 4000; √((600 − 500)/14000) = 0.0845.
    let event = event(4000, &[1.0; 60], 140);
    let done = run(&event, "");
    assert_eq!((done.ops.rows_after, done.split.len()), (70, 10));
    assert_eq!(done.ops.cause, "grow");
    assert!(!done.ops.reset_signals.is_empty());
    let after = |step| run(&Event { step, ..event.clone() }, "").ops.rows_after;
    // Not below what there is; the budget at 14,500, and not beyond it.
    assert_eq!([after(600), after(2000), after(14_500), after(14_900)], [60, 60, 120, 120]);
    let low = Event { budget: 100, ..event.clone() };
    assert_eq!(run(&Event { step: 14_500, ..low }, "").ops.rows_after, 100);
}

#[test]
fn only_candidates_with_edges_are_split() {
    // Means 3.0e-4 (just enough), 2.9e-4, large, large without edges.
    let event = event(14_400, &[1.0, 5.0, 1.0, 0.0], 100)
        .with(Signal::ScreenGradientAbs, &[12.01e-4, 11.6e-4, 1.0, 1.0]);
    let mut split = run(&event, "").split;
    split.sort_unstable();
    assert_eq!(split, [0, 2]);
    // At the end 2e-4 is enough, and the gradient is the score.
    let mut last = run(&Event { step: 14_500, ..event.clone() }, "").split;
    last.sort_unstable();
    assert_eq!(last, [0, 1, 2, 3]);
    let none = event.with(Signal::ScreenGradientAbs, &[7.9e-4; 4]);
    assert!(run(&Event { step: 14_500, ..none }, "").split.is_empty());
}

#[test]
fn rows_are_halved_along_their_longest_axis() {
    let done = run(&event(14_400, &[1.0], 100), "");
    assert_eq!(done.offspring()[0], split_long_axis(0.45, 0.6));
}

#[test]
fn each_view_has_the_same_weight() {
    // View 1: mean of 1 and 3 is 2: 0.5, 1.5, 0. View 2, a hundred times brighter: 0, 0.5, 1.5.
    let mut score = EdgeScore::default();
    score.add(7, &[1.0, 3.0, 0.0]);
    score.add(7, &[0.0, 100.0, 300.0]);
    assert_eq!(score.rows, [0.5, 2.0, 1.5]);
    score.add(7, &[0.0; 3]);
    score.add(7, &[f32::NAN, -1.0, 0.0]);
    assert_eq!(score.rows, [0.5, 2.0, 1.5]);
    // What another event has seen is forgotten.
    score.add(8, &[0.0, 2.0, 0.0]);
    assert_eq!(score.rows, [0.0, 1.0, 0.0]);
}

#[test]
fn draws_follow_the_edges() {
    let edges: Vec<f32> = (0..4000).map(|row| if row % 2 == 0 { 1.0 } else { 9.0 }).collect();
    // Room for 100 of them: 10 faint ones, within five standard deviations (3 each).
    let split = run(&event(14_400, &edges, 4114), "").split;
    let faint = split.iter().filter(|row| *row % 2 == 0).count();
    assert!((90..=110).contains(&split.len()) && faint <= 25, "{faint} of {}", split.len());
}

#[test]
fn the_faint_are_pruned_at_each_growth_and_first_at_step_300() {
    let event = event(300, &[1.0; 4], 100).with(Signal::Opacity, &[0.0199, 0.02, 0.004, f32::NAN]);
    let first = run(&event, "");
    assert_eq!((first.pruned, first.ops.cause.as_str()), (vec![0, 2, 3], "first-prune"));
    assert!(first.split.is_empty() && first.ops.reset_signals.is_empty());
    let growing = run(&Event { step: 600, ..event.clone() }, "");
    assert_eq!(growing.pruned, [2, 3]);
    // Pruned rows are not drawn.
    assert_eq!((growing.split.len(), growing.ops.counts.denied), (2, 0));
    let all = event.with(Signal::Opacity, &[0.001, 0.002, 0.001, 0.0]);
    assert_eq!(run(&all, "").pruned, [0, 2, 3]);
}

#[test]
fn a_fifth_is_pruned_after_each_reset() {
    let opacity = [0.5, 0.01, 0.4, 0.3, 0.02, 0.2, 0.9, 0.03, 0.8, 0.7];
    let event = event(3300, &[1.0; 10], 10).with(Signal::Opacity, &opacity);
    let done = run(&event, "");
    assert_eq!(done.pruned, [1, 4]);
    assert_eq!(done.ops.cause, "recovery-prune+grow");
    // The dead are counted among the fifth.
    let one_dead =
        event.clone().with(Signal::Opacity, &opacity.map(|o| if o < 0.015 { 0.001 } else { o }));
    assert_eq!(run(&one_dead, "").pruned, [1, 4]);
    assert!(run(&event, "recovery_share = 0").pruned.is_empty());
    for step in [3000, 3200, 3400] {
        assert!(run(&Event { step, ..event.clone() }, "").pruned.is_empty(), "{step}");
    }
}

#[test]
fn opacities_are_reset_twice() {
    let at = |step| run(&event(step, &[1.0], 10), "").ops.clamp_opacity;
    assert_eq!([at(3000), at(6000), at(9000), at(3100)], [Some(0.05), Some(0.05), None, None]);
    let scene = Event::new(1, 1, 1).scene;
    let due = |set: &str, scene| {
        due_steps("igs", &format!("grow_every = 0\nfirst_prune_at = 0\n{set}"), scene)
    };
    assert_eq!(due("", &scene), [3000, 3300, 6000, 6300]);
    assert_eq!(due("resets = 9", &scene), [3000, 3300, 6000, 6300, 9000, 9300, 12_000, 12_300]);
    assert_eq!(due("recovery_share = 0", &scene), [3000, 6000]);
    assert_eq!(due("reset_every = 0", &scene), [0; 0]);
    // The recovery prune comes before the next reset: after at most half the interval.
    let short = SceneInfo { iterations: 600, ..scene };
    assert_eq!(due("", &short), [100, 150, 200, 250]);
}

#[test]
fn all_views_are_rendered_after_a_recovery_prune() {
    let policy = build("igs", "", &Event::new(1, 1, 1).scene);
    let views = |count: u32| -> Vec<u32> {
        (0..=30_000).filter(|&step| policy.aux_views(step, 1, 9) == count).collect()
    };
    assert_eq!(views(u32::MAX), [3400, 6400]);
    // 600..14,400 except these two.
    let some = views(10);
    assert_eq!((some.len(), some[0], some.last()), (137, 600, Some(&14_400)));
}

#[test]
fn the_optimiser_steps_less_often_towards_the_end() {
    let scene = Event::new(1, 1, 1).scene;
    let policy = build("igs", "", &scene);
    let all = |step| policy.cadence(step).all;
    assert_eq!([all(1), all(15_000), all(15_001), all(22_500)], [1, 1, 5, 5]);
    assert_eq!([all(22_501), all(30_000)], [20, 20]);
    let needs = policy.needs(&scene);
    assert_eq!(needs.cadence, Cadence { all: 20, sh_rest: 1 });
    let rates = "mean_start = 0.5\nmean_end = 0.25\nsh_rest = 0.125";
    assert_eq!(
        build("igs", rates, &scene).needs(&scene).rates,
        RateOverrides {
            mean: Some(Rate { start: 0.5, end: 0.25 }),
            sh_rest: Some(Rate::constant(0.125)),
            ..RateOverrides::default()
        }
    );
    let plain = build("igs", "sum = 1\nsum_more = 1", &scene);
    assert_eq!(plain.needs(&scene).cadence, Cadence::default());
}

#[test]
fn every_choice_conforms() {
    assert_conforms(
        "igs",
        &[
            "views = 1\nfinal_from = 1\ntau = 0.0",
            "tau = 0.0\nrecovery_share = 1.0\nresets = 99\nfirst_prune_opacity = 1.0",
        ],
    );
}
