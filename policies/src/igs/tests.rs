//! Tests of the rules of `igs`, each worked out by hand.

use super::*;
use crate::event::{Event, Outcome, View, assert_conforms, build, due_steps};

fn run(event: &Event, set: &str) -> Outcome {
    event.run("igs", set)
}

/// Rows of opacity 0.5, seen by four views with a mean absolute gradient of 1. In the only auxiliary view, the
/// edge sums of the rows are `edges`.
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
fn growth_follows_the_square_root_curve() {
    // 140 · √(3500/14000) = 70 at step 4000.
    let event = event(4000, &[1.0; 60], 140);
    let done = run(&event, "");
    assert_eq!((done.ops.rows_after, done.split.len()), (70, 10));
    assert_eq!(done.ops.cause, "grow");
    assert!(!done.ops.reset_signals.is_empty());
    let after = |step| run(&Event { step, ..event.clone() }, "").ops.rows_after;
    // A curve below the current number of rows prunes nothing. From step 14,500 on it is at the budget of 140, but
    // each of the 60 rows is split only once.
    assert_eq!([after(600), after(2000), after(14_500), after(14_900)], [60, 60, 120, 120]);
    let low = Event { budget: 100, ..event.clone() };
    assert_eq!(run(&Event { step: 14_500, ..low }, "").ops.rows_after, 100);
}

#[test]
fn only_candidates_with_edges_are_split() {
    // Means: 3.0e-4 (just enough), 2.9e-4, large, large but without edges.
    let event = event(14_400, &[1.0, 5.0, 1.0, 0.0], 100)
        .with(Signal::ScreenGradientAbs, &[12.01e-4, 11.6e-4, 1.0, 1.0]);
    let mut split = run(&event, "").split;
    split.sort_unstable();
    assert_eq!(split, [0, 2]);
    // After step 14,500 a gradient of 2e-4 is enough, and the gradient is the score.
    let sorted = |step| {
        let mut split = run(&Event { step, ..event.clone() }, "").split;
        split.sort_unstable();
        split
    };
    assert_eq!((sorted(14_500), sorted(14_600)), (vec![0, 2], vec![0, 1, 2, 3]));
    let below_tau = event.with(Signal::ScreenGradientAbs, &[7.9e-4; 4]);
    assert!(run(&Event { step: 14_600, ..below_tau }, "").split.is_empty());
}

#[test]
fn rows_are_halved_along_their_longest_axis() {
    let done = run(&event(14_400, &[1.0], 100), "");
    assert_eq!(done.offspring()[0], split_long_axis(0.45, 0.6));
}

#[test]
fn each_view_has_the_same_weight() {
    // View 1: the mean of 1 and 3 is 2, so the scores are 0.5, 1.5 and 0. View 2, whose edges are a hundred times as
    // strong: 0, 0.5 and 1.5.
    let mut score = EdgeScore::default();
    score.add(7, &[1.0, 3.0, 0.0]);
    score.add(7, &[0.0, 100.0, 300.0]);
    assert_eq!(score.rows, [0.5, 2.0, 1.5]);
    score.add(7, &[0.0; 3]);
    score.add(7, &[f32::NAN, -1.0, 0.0]);
    assert_eq!(score.rows, [0.5, 2.0, 1.5]);
    // Another event starts from zero.
    score.add(8, &[0.0, 2.0, 0.0]);
    assert_eq!(score.rows, [0.0, 1.0, 0.0]);
}

#[test]
fn candidates_are_drawn_in_proportion_to_edge_scores() {
    let edges: Vec<f32> = (0..4000).map(|row| if row % 2 == 0 { 1.0 } else { 9.0 }).collect();
    // Room for about 100 splits. About 10 of these should be of rows with weak edges; five standard deviations (3 each)
    // more are allowed.
    let split = run(&event(14_400, &edges, 4114), "").split;
    let weak = split.iter().filter(|row| *row % 2 == 0).count();
    assert!((90..=110).contains(&split.len()) && weak <= 25, "{weak} of {}", split.len());
}

#[test]
fn faint_rows_are_pruned_at_each_growth_step_and_first_at_step_300() {
    let event = event(300, &[1.0; 4], 100).with(Signal::Opacity, &[0.0199, 0.02, 0.004, f32::NAN]);
    let first = run(&event, "");
    assert_eq!((first.pruned, first.ops.cause.as_str()), (vec![0, 2, 3], "first-prune"));
    assert!(first.split.is_empty() && !first.ops.reset_signals.is_empty());
    let growing = run(&Event { step: 600, ..event.clone() }, "");
    assert_eq!(growing.pruned, [2, 3]);
    // The curve allows ⌊100 · √(100/14000)⌋ = 8: all rows but the one with NaN are drawn. Row 2 is pruned, as its
    // children would have an opacity of 0.6 · 0.004.
    assert_eq!((growing.split.len(), growing.ops.counts.denied), (2, 0));
    let all = event.clone().with(Signal::Opacity, &[0.001, 0.002, 0.001, 0.0]);
    assert_eq!(run(&all, "").pruned, [0, 2, 3]);
    // If the first prune and a growth step fall on one step, the prune comes before the draw. The curve allows two rows
    // at a budget of 24, and the one remaining row is split, not the pruned ones, which have stronger edges.
    let budget = 24;
    let edges = vec![view(&[1e9, 1.0, 1e9, 1e9])];
    let event = Event { step: 600, budget, views: edges, ..event };
    let both = run(&event, "first_prune_at = 600");
    assert_eq!((both.pruned, both.split), (vec![0, 2, 3], vec![1]));
}

#[test]
fn rows_are_split_before_they_are_pruned() {
    // At step 4000 the curve allows ⌊7 · √(3500/14000)⌋ = 3 Gaussians, as many as there are: nothing is split
    // although one is pruned; the next growth step uses its slot.
    let faint = event(4000, &[1.0; 3], 7).with(Signal::Opacity, &[0.5, 0.004, 0.5]);
    let done = run(&faint, "");
    assert_eq!((&done.pruned[..], done.split.len(), done.ops.rows_after), (&[1][..], 0, 2));
    assert!(done.ops.reset_signals.is_empty(), "nothing was split");
    let next = event(4000, &[1.0; 2], 7);
    assert_eq!(run(&next, "").split.len(), 1);
    // ⌊9 · 0.5⌋ = 4: the only row with edges is drawn. Its children would have opacities of
    // 0.6 · 0.0083 < 0.005, so it is pruned, and no other row is split instead.
    let last = event(4000, &[0.0, 1.0, 0.0], 9);
    let drawn = |opacity: f32| {
        let done = run(&last.clone().with(Signal::Opacity, &[0.5, opacity, 0.5]), "");
        assert!(!done.ops.reset_signals.is_empty());
        (done.pruned, done.split, done.ops.counts.denied)
    };
    assert_eq!(drawn(0.0083), (vec![1], vec![], 0));
    assert_eq!(drawn(0.0084), (vec![], vec![1], 0));
    // A row that is below the limit itself is drawn like any other.
    assert_eq!(drawn(0.004), (vec![1], vec![], 0));
}

#[test]
fn the_last_growth_step_prunes_no_faint_rows() {
    let pruned = |step, set: &str| {
        let faint = event(step, &[0.0; 2], 9).with(Signal::Opacity, &[0.5, 0.004]);
        run(&faint.with_all(Signal::ScreenGradientAbs, 0.0), set).pruned
    };
    assert_eq!([pruned(14_800, ""), pruned(14_900, "")], [vec![1], vec![]]);
    assert_eq!(pruned(14_900, "prune_last = true"), [1]);
    // In a shorter run, of 7,000 iterations, growth ends before step 3,500.
    let short = "grow_until = 3500\ngrow_from = 117";
    assert_eq!([pruned(3_300, short), pruned(3_400, short)], [vec![1], vec![]]);
    // A row whose children have an opacity of 0.6 · 0.004 is split, too. The row with NaN is still pruned.
    let split = event(14_900, &[1.0; 2], 9).with(Signal::Opacity, &[0.004, f32::NAN]);
    let done = run(&split, "");
    assert_eq!((done.pruned, done.split), (vec![1], vec![0]));
}

#[test]
fn the_budget_holds_while_rows_are_split_and_pruned() {
    // The model is at the budget of 4 and the curve at its end: nothing is split, one row is pruned.
    let full = event(14_600, &[1.0; 4], 4).with(Signal::Opacity, &[0.5, 0.004, 0.5, 0.5]);
    let done = run(&full, "");
    assert_eq!((&done.pruned[..], done.split.len(), done.ops.rows_after), (&[1][..], 0, 3));
    // Room for one: one of the four rows is drawn. If it is row 1, nothing is split, as its children would be too
    // faint. Row 1 is pruned in any case.
    let room = run(&Event { budget: 5, ..full.clone() }, "");
    assert_eq!((room.pruned, room.ops.counts.denied), (vec![1], 0));
    assert!(room.split.len() <= 1);
    // Room for all: all are drawn, and three are split.
    let all = run(&Event { budget: 8, ..full }, "");
    assert_eq!((&all.pruned[..], all.split.len(), all.ops.rows_after), (&[1][..], 3, 6));
}

#[test]
fn a_fifth_is_pruned_after_each_of_two_resets() {
    let opacity = [0.5, 0.01, 0.4, 0.3, 0.02, 0.2, 0.9, 0.03, 0.8, 0.7];
    let event = event(3300, &[1.0; 10], 10).with(Signal::Opacity, &opacity);
    let done = run(&event, "");
    // The rows below the quantile, which is at rank 0.2 · 9 = 1.8 in ascending order of opacity.
    assert_eq!(done.pruned, [1, 4]);
    assert_eq!(done.ops.cause, "recovery-prune+grow");
    assert!(!done.ops.reset_signals.is_empty());
    // Row 1 is below `min_opacity` and is not counted. Of the other nine, two are below rank 0.2 · 8 = 1.6.
    let one_dead = opacity.map(|o| if o < 0.015 { 0.001 } else { o });
    let one_dead = event.clone().with(Signal::Opacity, &one_dead);
    assert_eq!(run(&one_dead, "").pruned, [1, 4, 7]);
    // Equal opacities are pruned together or not at all.
    let equal = event.clone().with(Signal::Opacity, &opacity.map(|o| o.max(0.03)));
    assert!(run(&equal, "").pruned.is_empty());
    assert!(run(&event, "recovery_share = 0").pruned.is_empty());
    for step in [3000, 3200, 3400, 9300, 12_300] {
        assert!(run(&Event { step, ..event.clone() }, "").pruned.is_empty(), "{step}");
    }
    assert_eq!(run(&Event { step: 6300, ..event.clone() }, "").pruned, [1, 4]);
    assert_eq!(run(&Event { step: 9300, ..event }, "recoveries = 3").pruned, [1, 4]);
}

#[test]
fn recovery_prunes_take_their_share_of_the_rows_after_the_splits() {
    // Step 3300: √(2800/14000) = 0.447; ⌊20 · 0.447⌋ = 8: the two of six rows with edges are drawn.
    let opacity = [0.9, 0.1, 0.05, 0.3, 0.4, 0.2];
    let event = event(3300, &[0.0, 1.0, 0.0, 0.0, 1.0, 0.0], 20).with(Signal::Opacity, &opacity);
    // The opacities are then 0.05, 0.06, 0.06, 0.2, 0.24, 0.24, 0.3, 0.9. The quantile is at rank
    // 0.2 · 7 = 1.4; only row 2 is below the next value, 0.06.
    let done = run(&event, "");
    assert_eq!((done.pruned, done.ops.rows_after), (vec![2], 7));
    // Rank 0.3 · 7 = 2.1: values below 0.2 are pruned, among them both children of row 1, so row 1 is pruned.
    // (Rank 0.28 · 7 = 1.96 gives 0.06. If a split row counted once, rank 0.28 · 5 = 1.4 would give 0.2.)
    assert_eq!(run(&event, "recovery_share = 0.28").pruned, [2]);
    let more = run(&event, "recovery_share = 0.3");
    assert_eq!((more.pruned, more.split), (vec![1, 2], vec![4]));
}

#[test]
fn the_limit_is_the_first_value_at_or_above_the_quantile() {
    let eleven: Vec<f32> = (0..11_u8).map(f32::from).collect();
    // At rank 2.5 the quantile is between 2 and 3, so the limit is 3.
    let limits: Vec<f32> =
        [0.0, 0.2, 0.25, 1.0].iter().map(|&share| limit_of_share(eleven.clone(), share)).collect();
    assert_eq!(limits, [0.0, 2.0, 3.0, 10.0]);
    // 0.07 · 100 is 7.000000000000001 as computed.
    let hundred = (0..=100_u8).map(f32::from).collect();
    assert_eq!(vec![limit_of_share(hundred, 0.07)], [7.0]);
    assert_eq!((limit_of_share(vec![], 0.2), limit_of_share(vec![5.0], 0.2)), (0.0, 5.0));
}

#[test]
fn opacities_are_reset_four_times() {
    let limit = |step| run(&event(step, &[1.0], 10), "").ops.clamp_opacity;
    let four = [3000, 6000, 9000, 12_000];
    assert_eq!(four.map(limit), [Some(0.05); 4]);
    assert_eq!([limit(3100), limit(14_900)], [None; 2]);
    let scene = Event::new(1, 1, 1).scene;
    let due = |set: &str, scene| {
        due_steps("igs", &format!("grow_every = 0\nfirst_prune_at = 0\n{set}"), scene)
    };
    assert_eq!(due("", &scene), [3000, 3300, 6000, 6300, 9000, 12_000]);
    assert_eq!(due("resets = 2", &scene), [3000, 3300, 6000, 6300]);
    let nine = "resets = 9\nrecoveries = 9";
    assert_eq!(due(nine, &scene), [3000, 3300, 6000, 6300, 9000, 9300, 12_000, 12_300]);
    // No recovery prune without a reset.
    assert_eq!(due("resets = 1\nrecoveries = 9", &scene), [3000, 3300]);
    assert_eq!(due("recovery_share = 0", &scene), four);
    assert_eq!(due("recoveries = 0", &scene), four);
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
    // The growth steps from 600 to 14,500 except these two.
    let ten_views = views(10);
    assert_eq!((ten_views.len(), ten_views[0], ten_views.last()), (138, 600, Some(&14_500)));
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

/// Number of iterations at which the optimiser steps, in each of the two quarters after `sum_from`.
fn optimiser_steps(set: &str, iterations: u32) -> [usize; 2] {
    let scene = SceneInfo { iterations, ..Event::new(1, 1, 1).scene };
    let policy = build("igs", set, &scene);
    let longest = policy.needs(&scene).cadence;
    let count = |from: u32, to: u32| {
        let is_due = |step| {
            assert!(policy.cadence(step).is_within(longest), "{step}");
            policy.cadence(step).steps_at(step)[0]
        };
        (from + 1..=to).filter(|&step| is_due(step)).count()
    };
    let quarter = iterations / 4;
    [count(2 * quarter, 3 * quarter), count(3 * quarter, iterations)]
}

#[test]
fn the_number_of_optimiser_steps_is_kept_in_short_runs() {
    // 7500/5 and 7500/20 steps; a run twice as long sums over 10 and 40 iterations.
    assert_eq!(optimiser_steps("", 30_000), [1500, 375]);
    assert_eq!(optimiser_steps("", 60_000), [1500, 375]);
    // A run of 7,000 sums over 5 · 7/30 = 1.17 and 20 · 7/30 = 4.67 iterations, rounded to 1 and 5.
    assert_eq!(optimiser_steps("", 7000), [1750, 350]);
    // 20 · 2/30 = 1.33 becomes 1: an optimiser step at every iteration.
    assert_eq!(optimiser_steps("", 2000), [500, 500]);
    assert_eq!(optimiser_steps("", 4), [1, 1]);
    // As published: 1,750/5 steps, and one at each multiple of 20 from 5,260 to 7,000.
    let fixed = "sums = \"fixed\"";
    assert_eq!(optimiser_steps(fixed, 30_000), [1500, 375]);
    assert_eq!(optimiser_steps(fixed, 7000), [350, 88]);
    // Values set by the user scale too.
    assert_eq!(optimiser_steps("sum = 30", 7000), [250, 350]);
    assert_eq!(optimiser_steps(&format!("sum = 30\n{fixed}"), 7000), [59, 88]);
    // 20 · 400 / 3 is clamped to the maximum.
    let scene = SceneInfo { iterations: 4_000_000, ..Event::new(1, 1, 1).scene };
    let long = build("igs", "", &scene);
    assert_eq!(long.needs(&scene).cadence, Cadence { all: 1000, sh_rest: 1 });
}

#[test]
fn other_parameter_values_conform() {
    assert_conforms(
        "igs",
        &[
            "views = 1\nfinal_from = 1\ntau = 0.0",
            "tau = 0.0\nrecovery_share = 1.0\nresets = 99\nfirst_prune_opacity = 1.0",
        ],
    );
}
