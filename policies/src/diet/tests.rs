//! Tests of the rules of `diet`, each worked out by hand. One file, as all tests share one kind of event.

use super::offspring::conserving_scale;
use super::*;
use crate::adc::{clone_at, split_by, split_long_axis};
use crate::event::{Event, Outcome, View, assert_conforms, build, due_steps};
use crate::plan::{EditCounts, Offspring, OpacityRule, ParentFate, Placement, ScaleRule, Seed};
use crate::policy::{Candidate, DepthMode, ErrorMode};
use crate::quota::share_of_budget;

fn run(event: &Event, set: &str) -> Outcome {
    event.run("diet", set)
}

/// Old rows of opacity 0.5 and size 0.05 (small, as the extent is 10), seen by four views. Row i has
/// importance i/100.
fn event(step: u32, rows: usize, budget: usize) -> Event {
    let importance: Vec<f32> = (0..rows).map(|row| row as f32 / 100.0).collect();
    Event::small_rows(step, rows, budget)
        .with_all(Signal::Age, 1000.0)
        .with(Signal::WeightMax, &importance)
}

/// Screen gradient sums of `rows` rows: 1, 2, 3, … for those listed, in this order, and 0 for the others.
fn gradient_sums(rows: usize, listed: &[usize]) -> Vec<f32> {
    let mut sums = vec![0.0; rows];
    for (sum, &row) in (1..).zip(listed) {
        sums[row] = sum as f32;
    }
    sums
}

// `rho` and `rho_c` are totals for the whole run, divided equally among its events: step 600 is the first of 94
// growth steps, and step 10,500 the first of 9 insertions.

fn candidate(error: f32, pixel_size: f32) -> Candidate {
    Candidate { position: [error, 0.0, 0.0], colour: [error, 0.5, 1.0], pixel_size, error }
}

#[test]
fn the_gradient_combines_screen_and_colour_gradients() {
    // Means: 4.0e-4; 2e-4 + 30·7e-6 = 4.1e-4; 2e-4 + 30·6e-6 = 3.8e-4; 30·1.4e-5 = 4.2e-4; 1.9e-4.
    let event = event(600, 5, 100)
        .with(Signal::ScreenGradient, &[16.01e-4, 8.01e-4, 8.01e-4, 0.0, 7.6e-4])
        .with(Signal::ColourGradient, &[0.0, 2.8e-5, 2.4e-5, 5.6e-5, 0.0]);
    let done = run(&event, "tau = 4e-4");
    assert_eq!(done.cloned, [3, 1, 0]);
    assert!(!done.ops.reset_signals.is_empty() && !done.ops.reset_candidates);
    assert_eq!(done.ops.cause, "grow");
    // Without colour, the screen gradient counts twice: 8.005e-4, 4.005e-4, 4.005e-4, 0, 3.8e-4.
    assert_eq!(run(&event, "tau = 4e-4\nmixed_gradient = false").cloned, [0, 1, 2]);
}

#[test]
fn at_the_budget_the_least_important_rows_are_replaced() {
    // `rho` 9.4 over 94 events is a tenth of the budget per event: two of 20 rows, the least important of those that
    // are not candidates.
    let event =
        event(600, 20, 20).with(Signal::ScreenGradient, &gradient_sums(20, &[0, 2, 9, 12, 19]));
    let done = run(&event, "rho = 9.4");
    assert_eq!(done.pruned, [1, 3]);
    assert_eq!(done.cloned, [19, 12]);
    assert_eq!(done.ops.counts, EditCounts { removed: 2, added: 2, updated: 0, denied: 3 });
    assert_eq!(run(&event, "rho = 18.8").pruned, [1, 3, 4, 5]);
    let none = run(&event, "rho = 0.0");
    assert!(none.pruned.is_empty() && none.cloned.is_empty());
    assert_eq!(none.ops.counts.denied, 5);
    let all = run(&event, "growth = \"all\"");
    assert_eq!((all.cloned.len(), all.pruned), (5, vec![1, 3, 4, 5, 6]));
}

#[test]
fn event_quotas_add_up_to_the_share() {
    let window = Window { from: 500, until: 10_000, every: 100 };
    let quotas = |share: f64, window: Window, budget: usize| -> Vec<usize> {
        let steps = (1..=30_000).filter(|&step| window.is_due(step));
        steps.map(|step| event_quota(share, window, step, budget)).collect()
    };
    let quarter = quotas(0.25, window, 200_000);
    assert_eq!((quarter.len(), quarter.iter().sum()), (94, 50_000));
    assert!(quarter.iter().all(|quota| (531..=532).contains(quota)));
    // Less than one row per event.
    assert_eq!(quotas(0.25, window, 100).iter().sum::<usize>(), 25);
    // As computed, 0.29 · 100 is just below 29; it counts as 29. 0.1 · 29 = 2.9 counts as 2.
    assert_eq!((share_of_budget(0.29, 100), share_of_budget(0.1, 29)), (29, 2));
    let once = Window { from: 500, until: 601, every: 100 };
    assert_eq!((quotas(0.29, once, 100), quotas(0.1, once, 29)), (vec![29], vec![2]));
    assert_eq!(event_quota(1.0, window, 650, 100), 0);
}

#[test]
fn rows_are_evicted_only_if_pruning_leaves_too_little_room() {
    // 19 rows, one dead, budget 20: there is room for 2, and eviction makes room for 2 more.
    let mut opacity = [0.5; 19];
    opacity[7] = 0.0049;
    let event = event(600, 19, 20)
        .with(Signal::ScreenGradient, &gradient_sums(19, &[7, 10, 11, 12, 13, 14]))
        .with(Signal::Opacity, &opacity);
    let done = run(&event, "rho = 9.4");
    assert_eq!(done.pruned, [0, 1, 7]);
    assert_eq!(done.cloned, [14, 13, 12, 11]);
    assert_eq!(done.ops.counts.denied, 1);
    assert_eq!(done.ops.rows_after, 20);
    // With room for all five candidates, no row is evicted.
    let roomy = run(&Event { budget: 23, ..event }, "");
    assert_eq!((roomy.pruned, roomy.cloned.len()), (vec![7], 5));
}

#[test]
fn huge_rows_are_kept_unless_a_size_limit_is_set() {
    let event = event(3000, 4, 100)
        .with(Signal::ScaleMax, &[0.05, 1.01, 1.0, 1.01])
        .with(Signal::ScreenGradient, &[0.0, 0.0, 9.0, 8.0]);
    let late = Event { step: 3100, ..event.clone() };
    let kept = run(&late, "");
    assert_eq!((kept.pruned, kept.split), (vec![], vec![2, 3]));
    // With a limit they are pruned after step 3000, at growth steps only.
    let limited = "max_scale = 0.1";
    let early = run(&event, limited);
    assert_eq!((early.pruned, early.split), (vec![], vec![2, 3]));
    let late = run(&late, limited);
    assert_eq!((late.pruned, late.split), (vec![1, 3], vec![2]));
    assert!(run(&Event { step: 3150, ..event }, limited).ops.is_empty());
}

#[test]
fn importance_may_be_measured_in_fresh_views() {
    // By default (`importance = "epochs"`), rows 0 and 1 are the least important ones; in the fresh views, rows 4 (a
    // candidate), 6 and 2 are.
    let fresh = [0.3, 0.4, 0.02, 0.5, 0.0, 0.6, 0.01, 0.7];
    let mut event = event(600, 8, 8).with(Signal::ScreenGradient, &gradient_sums(8, &[4, 7]));
    // Each row is visible in one of two views.
    let weights = |parity: usize| -> Vec<f32> {
        (0..8).map(|row| if row % 2 == parity { fresh[row] } else { 0.0 }).collect()
    };
    let view =
        |parity| View { columns: vec![(AuxColumn::WeightMax, weights(parity))], ..View::default() };
    event.views = vec![view(0), view(1)];
    assert_eq!(run(&event, "rho = 23.5").pruned, [0, 1]);
    assert_eq!(run(&event, "rho = 23.5\nimportance = \"fresh\"").pruned, [2, 6]);
    let over = Event { budget: 5, ..event.clone() };
    assert_eq!(run(&over, "rho = 0\nimportance = \"fresh\"").pruned, [2, 4, 6]);
    let mut inserting = Event { step: 10_500, ..event };
    inserting.candidates = vec![candidate(0.1, 0.01), candidate(0.2, 0.01)];
    assert_eq!(run(&inserting, "rho_c = 2.25\nimportance = \"fresh\"").pruned, [4, 6]);
}

#[test]
fn fresh_views_are_rendered_if_rows_may_be_evicted() {
    let scene = Event::new(1, 1, 100).scene;
    let policy = build("diet", "importance = \"fresh\"\nrho_c = 0.45", &scene);
    let wants = |step, rows| policy.aux_views(step, rows, 100) == 100;
    // Growth may double the rows.
    assert_eq!([50, 51, 100].map(|rows| wants(600, rows)), [false, true, true]);
    // An insertion adds up to 5.
    assert_eq!([95, 96, 100].map(|rows| wants(10_500, rows)), [false, true, true]);
    // Pruning acts only on models above the budget.
    assert_eq!([100, 101].map(|rows| wants(650, rows)), [false, true]);
    // Growth and an insertion of 5 rows fall on one step: 48 + 48 + 5 is above the budget of 100.
    let both = build("diet", "importance = \"fresh\"\nrho_c = 1.4\ncompensate_from = 500", &scene);
    assert_eq!([47, 48].map(|rows| both.aux_views(1000, rows, 100)), [0, 100]);
    // Replacing the model renders all views.
    let replaces = build("diet", "importance = \"fresh\"\nreinit_at = 600", &scene);
    assert_eq!([600, 700].map(|step| replaces.aux_views(step, 100, 100)), [u32::MAX, 100]);
}

#[test]
fn new_rows_are_protected_for_an_epoch() {
    let mut age = [1000.0; 20];
    age[..5].copy_from_slice(&[0.0, 99.0, 100.0, 29.0, 30.0]);
    let mut event = event(600, 20, 20)
        .with(Signal::ScreenGradient, &gradient_sums(20, &[18, 19]))
        .with(Signal::Age, &age);
    event.scene.train_views = 300;
    assert_eq!(run(&event, "rho = 9.4").pruned, [2, 5]);
    assert_eq!(run(&event, "rho = 9.4\nprotect = 0").pruned, [0, 1]);
    assert_eq!(run(&event, "rho = 9.4\nprotect = 30").pruned, [1, 2]);
    event.scene.train_views = 30;
    assert_eq!(run(&event, "rho = 9.4").pruned, [1, 2]);
}

#[test]
fn if_too_few_rows_are_old_the_oldest_new_ones_are_evicted() {
    // One row is old, and one must be pruned.
    let event = event(600, 6, 6)
        .with(Signal::ScreenGradient, &gradient_sums(6, &[5]))
        .with(Signal::Age, &[10.0, 60.0, 60.0, 59.0, 200.0, 0.0]);
    assert_eq!(run(&event, "rho = 47").pruned, [4]);
    // Three must be pruned: the old one, and the two of age 60, the oldest of the others.
    let event = Event { budget: 3, ..event };
    let over = run(&event, "rho = 0.0");
    assert_eq!(over.pruned, [1, 2, 4]);
    assert_eq!(over.ops.cause, "grow+prune");
}

#[test]
fn each_shift_rule_gives_the_documented_offset() {
    let event = event(600, 3, 10)
        .with(Signal::ScreenGradient, &[3.0, 2.0, 1.0])
        .with(Signal::ScaleMax, &[0.05, 0.05, 1.0])
        .with(Signal::MeanGradientX, &[3e-4, 0.0, 1.0])
        .with(Signal::MeanGradientY, &[0.0, 0.0, 1.0])
        .with(Signal::MeanGradientZ, &[4e-4, 0.0, 1.0])
        .with(Signal::MeanGradientNorm, &[1e-3, 0.0, 3.0]);
    let shifts = |set: &str| -> Vec<[f32; 3]> {
        let offspring = run(&event, set).offspring();
        let split = offspring[2].placement;
        assert!(matches!(split, Placement::LongAxis { .. }), "a split was shifted: {split:?}");
        let offset = |placement| match placement {
            Placement::Offset(offset) => offset,
            other => panic!("{other:?}"),
        };
        offspring[..2].iter().map(|offspring| offset(offspring.placement)).collect()
    };
    let assert_near = |shifts: &[[f32; 3]], expected: [f32; 3]| {
        for axis in 0..3 {
            assert!(shifts[1][axis].abs() < 1e-30, "a row without gradients moved");
            assert!((shifts[0][axis] - expected[axis]).abs() < 1e-9, "{shifts:?}, {expected:?}");
        }
    };
    // −0.1 · 0.05 · (0.3, 0, 0.4)
    assert_near(&shifts(""), [-1.5e-3, 0.0, -2.0e-3]);
    assert_near(&shifts("kappa = 0.2"), [-3e-3, 0.0, -4e-3]);
    assert_near(&shifts("shift = \"paper\""), [3e-4, 0.0, 4e-4]);
    assert_near(&shifts("shift = \"code\""), [3e-4 / 16.0, 0.0, 4e-4 / 16.0]);
    assert_near(&shifts("shift = \"none\""), [0.0; 3]);
}

#[test]
fn large_rows_split_and_small_ones_are_cloned() {
    let event = event(600, 2, 10)
        .with(Signal::ScreenGradient, &[2.0, 1.0])
        .with(Signal::ScaleMax, &[0.101, 0.1]);
    let offspring = |set: &str| -> Vec<Offspring> { run(&event, set).offspring() };
    let [random_split, clone] = offspring("split = \"random\"")[..] else { panic!("not a pair") };
    assert_eq!((random_split, clone), (split_by(1.6), clone_at([0.0; 3])));
    assert_eq!(random_split.scale, ScaleRule::Uniform(0.625));
    let [halves, clone] = offspring("")[..] else { panic!("not a pair") };
    assert_eq!((halves, clone), (split_long_axis(0.45, 0.6), clone_at([0.0; 3])));
    let other = offspring("split_share = 0.3\nchild_opacity = 0.8")[0];
    assert_eq!(other, split_long_axis(0.3, 0.8));
}

#[test]
fn a_conserving_clone_shares_its_opacity() {
    let event = event(600, 2, 10)
        .with(Signal::ScreenGradient, &[2.0, 0.0])
        .with(Signal::Opacity, &[0.75, 0.5]);
    let done = run(&event, "clone_opacity = \"conserve\"");
    let offspring = done.offspring()[0];
    assert_eq!((offspring.parent, offspring.siblings()), (ParentFate::BecomesChild, 2));
    assert_eq!(offspring.opacity, OpacityRule::Conserved);
    // o′ = 0.5, so the factor is 0.75 / (1 − 0.25/√2).
    let ScaleRule::Uniform(scale) = offspring.scale else { panic!("{offspring:?}") };
    assert!((scale - 0.911_053).abs() < 1e-5, "{scale}");
    // The extremes given by Kheradmand et al.: faint Gaussians hardly shrink, opaque ones do.
    assert!((conserving_scale(0.05) - 0.996).abs() < 1e-3);
    assert!((conserving_scale(0.99) - 0.81).abs() < 5e-3);
    assert!((conserving_scale(0.0) - 1.0).abs() < 1e-6);
}

#[test]
fn at_the_budget_without_candidates_no_row_is_edited() {
    let pruning = run(&event(650, 20, 20), "");
    assert!(pruning.ops.is_empty() && pruning.ops.counts == EditCounts::default());
    assert_eq!(pruning.ops.cause, "");
    let growing = run(&event(700, 20, 20), "");
    assert!(!growing.ops.edits_rows() && !growing.ops.reset_signals.is_empty());
    assert_eq!(growing.ops.counts, EditCounts::default());
}

#[test]
fn a_model_above_the_budget_is_pruned_to_it() {
    let weights = [0.5, 0.1, 0.4, 0.2, 0.3, f32::NAN];
    let event = event(550, 6, 4).with(Signal::WeightMax, &weights);
    let done = run(&event, "");
    assert_eq!(done.pruned, [1, 3]);
    assert_eq!((done.ops.rows_after, done.ops.cause.as_str()), (4, "prune"));
}

#[test]
fn rows_pruned_for_the_budget_do_not_grow() {
    // Two of six rows are too many; candidate 0 is one of them, so only candidate 5 needs an eviction.
    let event = event(600, 6, 4).with(Signal::ScreenGradient, &gradient_sums(6, &[0, 5]));
    let done = run(&event, "rho = 47");
    assert_eq!(done.pruned, [0, 1, 2]);
    assert_eq!((done.cloned, done.ops.counts.denied), (vec![5], 0));
}

#[test]
fn the_worst_pixels_become_rows() {
    // With a budget of 40, two rows are inserted per event; as there are 39 rows, one is evicted.
    let mut event = event(10_500, 39, 40);
    event.candidates = vec![candidate(0.1, 0.01), candidate(0.3, 0.02), candidate(0.2, 0.03)];
    let done = run(&event, "rho_c = 0.45");
    assert_eq!(done.pruned, [0]);
    let seeds: Vec<Seed> = done.ops.seeds.iter().map(|(_, seed)| *seed).collect();
    let seed = |error, scale| Seed::round([error, 0.0, 0.0], [error, 0.5, 1.0], scale, 0.1);
    assert_eq!(seeds, [seed(0.3, 0.04), seed(0.2, 0.06)]);
    assert_eq!(done.ops.counts, EditCounts { removed: 1, added: 2, updated: 0, denied: 0 });
    assert!(done.ops.reset_candidates && done.ops.reset_signals.is_empty());
    assert_eq!(done.ops.cause, "insert");
    let roomy = Event { budget: 41, ..event.clone() };
    assert_eq!(run(&roomy, "rho_c = 0.45").pruned, [0_u32; 0]);
    event.candidates.clear();
    let idle = run(&event, "rho_c = 0.45");
    assert!(!idle.ops.edits_rows() && idle.ops.reset_candidates);
}

#[test]
fn no_row_is_evicted_for_a_pixel_without_a_point() {
    let mut event = event(10_500, 40, 40);
    let no_point = Candidate { position: [f32::NAN; 3], ..candidate(0.9, 0.01) };
    event.candidates = vec![no_point, candidate(0.1, 0.0), candidate(0.2, 0.01)];
    let done = run(&event, "rho_c = 0.45");
    assert_eq!(done.pruned, [0]);
    assert_eq!(done.ops.counts, EditCounts { removed: 1, added: 1, updated: 0, denied: 2 });
}

#[test]
fn with_newborn_size_code_the_size_is_the_squared_geometric_mean_of_the_scales() {
    let mut event = event(10_500, 3, 40).with(Signal::ScaleMax, &[0.1, 0.4, f32::NAN]);
    event.candidates = vec![candidate(0.1, 7.0)];
    let scale = |set| run(&event, &format!("rho_c = 1\n{set}")).ops.seeds[0].1.scales[0];
    assert!((scale("newborn_size = \"code\"") - 0.04).abs() < 1e-6);
    assert!((scale("size_pixels = 0.5") - 3.5).abs() < 1e-6);
}

#[test]
fn growth_pruning_and_insertion_can_fall_on_one_step() {
    // 44 rows, budget 40: four are pruned for the budget, three candidates need room, and two rows are inserted.
    let mut event =
        event(1000, 44, 40).with(Signal::ScreenGradient, &gradient_sums(44, &[5, 40, 41]));
    event.candidates = (1..9).map(|i| candidate(i as f32 / 10.0, 0.01)).collect();
    let done = run(&event, "rho = 9.4\nrho_c = 1.4\ncompensate_from = 500");
    assert_eq!(done.ops.cause, "grow+prune+insert");
    assert_eq!(done.pruned, [0, 1, 2, 3, 4, 6, 7, 8, 9]);
    assert_eq!(done.cloned, [41, 40, 5]);
    assert_eq!((done.ops.seeds.len(), done.ops.rows_after), (2, 40));
    assert!(!done.ops.reset_signals.is_empty() && done.ops.reset_candidates);
}

#[test]
fn schedules_match_the_paper() {
    let due = |set: &str, iterations: u32| {
        due_steps("diet", set, &SceneInfo { iterations, ..Event::new(1, 1, 1).scene })
    };
    let grow = due("prune_every = 0\ninsert_every = 0", 30_000);
    assert_eq!((grow.len(), grow[0], grow.last()), (94, 600, Some(&9900)));
    let insert = due("prune_every = 0\ngrow_every = 0", 30_000);
    assert_eq!(insert, (10_500..15_000).step_by(500).collect::<Vec<_>>());
    let prune = due("grow_every = 0\ninsert_every = 0", 30_000);
    assert_eq!((prune.len(), prune[0], prune.last()), (289, 550, Some(&14_950)));
    let insert = due("prune_every = 0\ngrow_every = 0", 3000);
    // In a run of a tenth of the length, the interval would be 50 steps, but it does not shrink below 100.
    assert_eq!(insert, (1100..1500).step_by(100).collect::<Vec<_>>());
}

#[test]
fn needs_list_only_used_signals() {
    let mut scene = Event::new(1, 1, 1).scene;
    scene.budget = 30_000;
    let needs = |set: &str| build("diet", set, &scene).needs(&scene);
    let full = needs("");
    assert_eq!(full.signals.count(), 11);
    assert!(full.signals.contains(Signal::MeanGradientNorm) && full.signals.contains(Signal::Age));
    let request = full.candidates.unwrap();
    // 500 steps of 30,000/3000 pixels.
    assert_eq!((request.capacity, request.from, request.until), (5000, 10_000, 15_000));
    assert_eq!((request.error, request.depth), (ErrorMode::L1Dssim, DepthMode::MaxWeight));
    assert!(request.spaced && request.rows_per_candidate == 3000);
    assert!((request.min_alpha - 0.5).abs() < 1e-9);

    // 0.8 times the extent.
    assert!((full.full_depth - 0.8 * scene.extent).abs() < 1e-6 * scene.extent);
    assert!(needs("full_depth = 0.0").full_depth.abs() < 1e-9);

    let lean = needs("shift = \"none\"\nmixed_gradient = false\nprotect = 0\nrho_c = 0.0");
    let listed: Vec<Signal> = lean.signals.iter().collect();
    use Signal::{Opacity, ScaleMax, ScreenGradient, VisibleCount, WeightMax};
    assert_eq!(listed, [VisibleCount, ScreenGradient, WeightMax, Opacity, ScaleMax]);
    assert_eq!(lean.candidates, None);
    let renders = needs("importance = \"fresh\"");
    assert_eq!(renders.aux.unwrap().columns, [AuxColumn::WeightMax]);
    assert!(full.aux.is_none() && !renders.signals.contains(WeightMax));
    // The number of views does not scale with the run.
    let short = SceneInfo { iterations: 3000, ..scene.clone() };
    let rendered = |set| build("diet", set, &short).aux_views(100, 1, 0);
    assert_eq!(rendered("importance = \"fresh\""), 100);
    assert_eq!(rendered("importance = \"fresh\"\nfresh_views = 7"), 7);
    assert!(!needs("shift = \"paper\"").signals.contains(Signal::MeanGradientNorm));
    let switched = needs(
        "error = \"grad\"\ndepth = \"median\"\nnms = false\nrows_per_candidate = 1\nmin_alpha = 0",
    );
    let request = switched.candidates.unwrap();
    assert!(request.min_alpha.abs() < 1e-9);
    assert_eq!((request.error, request.depth), (ErrorMode::Gradient, DepthMode::Median));
    assert_eq!((request.spaced, request.capacity), (false, 30_000));
    assert_eq!(needs("error = \"l1\"").candidates.unwrap().error, ErrorMode::L1);
    assert_eq!(needs("compensate_until = 10000").candidates, None);
}

#[test]
fn the_pixel_loss_depends_on_the_views_unless_it_is_set() {
    crate::event::assert_pixel_loss("diet");
}

/// A view that shows surface points on a line, one unit apart, starting at `from`.
fn surface(from: f32, count: u32) -> View {
    let point =
        |i: u32| Candidate { position: [from + i as f32, 0.0, 0.0], ..candidate(0.5, 0.01) };
    View { points: (0..count).map(point).collect(), ..View::default() }
}

#[test]
fn the_model_is_replaced_by_surface_points() {
    // Budget 10, two views: ⌊8/2⌋ = 4 points of each.
    let mut event = event(5000, 9, 10);
    event.scene.train_views = 2;
    event.views = vec![surface(0.0, 9), surface(100.0, 9)];
    let policy = build("diet", "reinit_at = 5000", &event.scene);
    assert_eq!(policy.needs(&event.scene).aux.unwrap().points, 4);
    assert_eq!([policy.aux_views(5000, 9, 10), policy.aux_views(5100, 9, 10)], [u32::MAX, 0]);
    let done = run(&event, "reinit_at = 5000");
    assert_eq!(done.ops.counts, EditCounts { removed: 9, added: 8, updated: 0, denied: 0 });
    assert_eq!((done.ops.rows_after, done.ops.cause.as_str()), (8, "reinit"));
    assert!(!done.ops.reset_signals.is_empty() && done.ops.reset_candidates);
    // The three nearest neighbours of point 0 are at distances 1, 2 and 3; those of point 1 at 1, 1 and 2.
    let seeds: Vec<Seed> = done.ops.seeds.iter().map(|(_, seed)| *seed).collect();
    let sizes = [(14.0_f32 / 3.0).sqrt(), 2.0_f32.sqrt()];
    for (seed, size) in seeds.iter().zip(sizes) {
        assert!((seed.scales[2] - size).abs() < 1e-5, "{seed:?} {size}");
    }
    assert_eq!((seeds[1].position, seeds[1].colour), ([1.0, 0.0, 0.0], [0.5, 0.5, 1.0]));
    assert!(seeds.iter().all(|seed| (seed.opacity - 0.1).abs() < 1e-6));
    assert!((seeds[4].position[0] - 100.0).abs() < 1e-6);
    // Never more than `reinit_share` of the budget, however many points there are.
    event.views = vec![surface(0.0, 9); 3];
    event.scene.train_views = 1;
    assert_eq!(run(&event, "reinit_at = 5000\nreinit_share = 0.4").ops.rows_after, 4);
    // At other steps, and without points, the model is kept.
    assert!(run(&Event { step: 5050, ..event.clone() }, "reinit_at = 5000").ops.is_empty());
    event.views.clear();
    assert!(run(&event, "reinit_at = 5000").ops.is_empty());
    assert!(build("diet", "", &event.scene).needs(&event.scene).aux.is_none());
}

#[test]
fn coinciding_and_isolated_points_have_a_size() {
    let mut event = event(5000, 3, 10);
    event.scene.train_views = 1;
    let point = Candidate { position: [1.0, 2.0, 3.0], ..candidate(0.5, 0.01) };
    let no_point = Candidate { position: [f32::NAN; 3], ..point };
    let scales = |points: Vec<Candidate>| -> Vec<f32> {
        let views = vec![View { points, ..View::default() }];
        let done = run(&Event { views, ..event.clone() }, "reinit_at = 5000");
        done.ops.seeds.iter().map(|(_, seed)| seed.scales[1]).collect()
    };
    // 2e-4 and 0.02 times the extent of 10.
    assert_eq!(scales(vec![point, point]), [2e-3, 2e-3]);
    assert_eq!(scales(vec![point, no_point]), [0.2]);
}

#[test]
fn other_parameter_values_conform() {
    assert_conforms(
        "diet",
        &[
            "mixed_gradient = false\nshift = \"none\"\nprotect = 0",
            "growth = \"all\"\nshift = \"paper\"\nnewborn_size = \"code\"",
            "shift = \"code\"\nclone_opacity = \"conserve\"\nrho = 20.0\nrho_c = 9.0",
            "rho_c = 0.0\nrho = 0.0\ntau = 0.0",
            "compensate_from = 1\ninsert_every = 4\nrho_c = 0.3",
            "importance = \"fresh\"",
            "reinit_at = 100\nprune_every = 1",
            "reinit_at = 300\nreinit_share = 1.0\nimportance = \"fresh\"",
            "importance = \"fresh\"\ncompensate_from = 1\ninsert_every = 4\nrho_c = 0.3",
            "importance = \"fresh\"\ngrowth = \"all\"\nrho_c = 1.0\nfresh_views = 1",
        ],
    );
}
