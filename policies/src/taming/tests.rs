//! Tests of the rules of `taming`, each worked out by hand.

use super::*;
use crate::event::{Event, Outcome, View, assert_conforms, build, due_steps};
use crate::plan::EditCounts;
use crate::policy::AuxColumn;

fn run(event: &Event, set: &str) -> Outcome {
    event.run("taming", set)
}

/// Small rows of opacity 0.5 with a screen gradient of 1 in four views. In the only auxiliary view, which has a loss of
/// 0.02, every statistic of every row is 2.
fn event(step: u32, rows: usize, budget: usize) -> Event {
    let mut event = Event::small_rows(step, rows, budget)
        .with_all(Signal::ScreenGradient, 4.0)
        .with_all(Signal::ScaleProduct, 1e-4);
    let columns = COLUMNS.map(|column| (column, vec![2.0; rows])).to_vec();
    event.views = vec![View { loss: 0.02, columns, points: Vec::new() }];
    event
}

fn set_column(view: &mut View, column: AuxColumn, values: &[f32]) {
    for (name, old) in &mut view.columns {
        if *name == column {
            *old = values.to_vec();
        }
    }
}

/// The score of every row of an event.
fn score(event: &Event, set: &str) -> Vec<f32> {
    let params: TamingParams = toml::from_str(set).unwrap();
    let mut score = Score::default();
    for view in &event.views {
        let columns = &view.columns;
        let (step, rows, loss) = (event.step, event.rows, view.loss);
        score.add(&AuxView { step, rows, loss, columns, points: &[] }, &params).unwrap();
    }
    let signals = event.signals(Signal::ALL.into());
    let now =
        Snapshot { step: event.step, scene: &event.scene, signals: &signals, candidates: &[] };
    let gradient: Vec<f32> =
        signals.get(Signal::ScreenGradient).unwrap().iter().map(|g| g / 4.0).collect();
    score.total(&now, &gradient, &params).unwrap()
}

#[test]
fn the_score_is_the_weighted_sum_of_its_terms() {
    // All terms at their medians: 50·0.02·(25 + 100 + 5 + 10 + 25 + 50 + 10 + 0.1 + 50) = 275.1.
    let mut event = event(1000, 3, 9);
    for total in score(&event, "") {
        assert!((total - 275.1).abs() < 1e-3, "{total}");
    }
    // One column at a time is doubled in row 1, which adds its coefficient.
    let coefficients = [
        (AuxColumn::MapSum, 10.0),
        (AuxColumn::PixelCount, 0.1),
        (AuxColumn::WeightSum, 50.0),
        (AuxColumn::DistanceSum, 50.0),
        (AuxColumn::Depth, 5.0),
        (AuxColumn::Radius, 10.0),
    ];
    for (column, coefficient) in coefficients {
        let mut doubled = event.clone();
        set_column(&mut doubled.views[0], column, &[2.0, 4.0, 2.0]);
        let scores = score(&doubled, "");
        assert!((scores[1] - 275.1 - coefficient).abs() < 1e-3, "{column:?}: {}", scores[1]);
    }
    let row_terms =
        [(Signal::ScreenGradient, 25.0), (Signal::Opacity, 100.0), (Signal::ScaleProduct, 25.0)];
    for (signal, coefficient) in row_terms {
        let doubled = event.clone().with(signal, &[0.25, 0.5, 0.25]);
        let scores = score(&doubled, "");
        assert!((scores[1] - 275.1 - coefficient).abs() < 1e-3, "{signal:?}: {}", scores[1]);
    }
    // A second view with half the loss, in which row 0 is not visible: row 1 gets 1.5 · 275.1 = 412.65.
    let mut second = event.views[0].clone();
    second.loss = 0.01;
    set_column(&mut second, AuxColumn::Radius, &[0.0, 2.0, 2.0]);
    event.views.push(second);
    let scores = score(&event, "");
    assert!((scores[0] - 275.1).abs() < 1e-3 && (scores[1] - 412.65).abs() < 1e-3, "{scores:?}");
}

#[test]
fn scores_of_another_event_are_forgotten() {
    let late = Event { views: Vec::new(), ..event(1500, 3, 9) };
    let mut policy = build("taming", "", &late.scene);
    let observed = &event(1000, 3, 9).views[0];
    let (columns, points) = (&observed.columns, &[][..]);
    policy.observe(&AuxView { step: 1000, rows: 3, loss: 1.0, columns, points }).unwrap();
    // Without a score no row is drawn.
    assert!(late.run_policy(&mut *policy).unwrap().cloned.is_empty());
}

#[test]
fn growth_is_bounded_by_the_curve_and_the_number_of_candidates() {
    // From 100 rows to 942 over 29 events: the first adds ⌊842·(2/29 − 1/29²)⌋ = ⌊842·57/841⌋ = 57.
    let event = event(1000, 100, 942);
    let done = run(&event, "");
    assert_eq!((done.ops.rows_after, done.cloned.len()), (157, 57));
    assert!(!done.ops.reset_signals.is_empty());
    assert_eq!(done.ops.cause, "densify");
    // Only 30 rows are candidates.
    let gradient: Vec<f32> = (0..100).map(|row| if row < 30 { 8.01e-4 } else { 7.9e-4 }).collect();
    let few = event.clone().with(Signal::ScreenGradient, &gradient);
    assert_eq!(run(&few, "").ops.rows_after, 130);
    // `multiplier` sets the end of the curve, which is never above the plan's budget.
    assert_eq!(run(&event, "multiplier = 3.0").ops.rows_after, 113);
    assert_eq!(run(&Event { budget: 120, ..event.clone() }, "multiplier = 9").ops.rows_after, 101);
    assert!(!run(&event, "multiplier = 0.5").ops.edits_rows());
}

#[test]
fn small_and_large_rows_share_the_growth() {
    // 57 births for 30 small and 70 large: ⌊57·0.3⌋ = 17 clones, ⌊57·0.7⌋ = 39 splits.
    let scale: Vec<f32> = (0..100).map(|row| if row < 30 { 0.1 } else { 0.101 }).collect();
    let done = run(&event(1000, 100, 942).with(Signal::ScaleMax, &scale), "");
    assert_eq!((done.cloned.len(), done.split.len()), (17, 39));
    assert!(done.cloned.iter().all(|row| *row < 30) && done.split.iter().all(|row| *row >= 30));
    let offspring = |row| {
        let family = done.ops.families.iter().find(|f| f.parent == row).unwrap();
        done.ops.offspring(family)
    };
    assert_eq!(offspring(done.cloned[0]), clone_at([0.0; 3]));
    assert_eq!(offspring(done.split[0]), split_by(1.6));
}

#[test]
fn only_rows_with_a_score_are_drawn() {
    // Rows that are visible in no view (with a radius of 0) have no score and are never drawn.
    let mut event = event(1000, 100, 942);
    let radii: Vec<f32> = (0..100).map(|row| if row % 2 == 0 { 2.0 } else { 0.0 }).collect();
    set_column(&mut event.views[0], AuxColumn::Radius, &radii);
    let done = run(&event, "");
    // All 50 rows with a score grow, although the curve allows 57.
    assert_eq!(done.cloned.len(), 50);
    assert!(done.cloned.iter().all(|row| row % 2 == 0));
}

#[test]
fn half_of_the_dead_rows_are_pruned() {
    let mut opacity = [0.5; 20];
    opacity[..5].fill(0.004);
    let event = event(1000, 20, 20).with(Signal::Opacity, &opacity);
    let done = run(&event, "");
    // ⌊5/2⌋ = 2 of the five dead rows.
    assert_eq!(done.ops.counts, EditCounts { removed: 2, added: 0, updated: 0, denied: 0 });
    assert!(done.pruned.iter().all(|row| *row < 5));
    assert_eq!(run(&event, "prune_share = 1").pruned, [0, 1, 2, 3, 4]);
    // Nothing is pruned at the last event.
    assert!(run(&Event { step: 14_500, ..event.clone() }, "").pruned.is_empty());
    assert_eq!(run(&Event { step: 14_000, ..event.clone() }, "").pruned.len(), 2);
    // Rows with a low score are drawn more often; row 0 has a score of 0, so it is drawn.
    let mut scored = event.clone();
    let mut radii = vec![2.0; 20];
    radii[0] = 0.0;
    set_column(&mut scored.views[0], AuxColumn::Radius, &radii);
    assert!(run(&scored, "").pruned.contains(&0));
    // Pruning by size, after step 3000.
    let mut scale = [0.05; 20];
    scale[5..9].fill(1.01);
    let huge = event.with(Signal::ScaleMax, &scale);
    assert_eq!(run(&Event { step: 3000, ..huge.clone() }, "").ops.counts.removed, 2);
    assert_eq!(run(&Event { step: 3500, ..huge }, "").ops.counts.removed, 4);
}

#[test]
fn dead_rows_do_not_grow() {
    let event = event(14_500, 4, 1000).with(Signal::Opacity, &[0.5, 0.004, 0.5, f32::NAN]);
    let mut cloned = run(&event, "").cloned;
    cloned.sort_unstable();
    assert_eq!(cloned, [0, 2]);
}

#[test]
fn the_published_draw_prunes_fewer_and_other_rows() {
    // 4 of 400 rows are dead: the ⌊4/2⌋ = 2 rows drawn from all rows are unlikely to be among them.
    let mut opacity = [0.5; 400];
    opacity[..4].fill(0.004);
    let mut event = event(1000, 400, 400).with(Signal::Opacity, &opacity);
    assert_eq!(run(&event, "").pruned.len(), 2);
    assert!(run(&event, "prune = \"published\"").pruned.is_empty());
    // Rows 0 and 1 are split. Only index 2 has a score of 0, so it is drawn. Among the remaining rows 2, 3,
    // 4, … index 2 is row 4, which is pruned although the score is that of row 2.
    let mut scale = [0.05; 400];
    scale[..2].fill(0.5);
    let mut gradient = [0.0; 400];
    gradient[..2].fill(4.0);
    let mut opacity = [0.5; 400];
    opacity[4] = 0.004;
    opacity[9] = 0.004;
    let mut radii = vec![2.0; 400];
    radii[2] = 0.0;
    set_column(&mut event.views[0], AuxColumn::Radius, &radii);
    let mut event = Event { budget: 1000, ..event }
        .with(Signal::Opacity, &opacity)
        .with(Signal::ScreenGradient, &gradient)
        .with(Signal::ScaleMax, &scale);
    event.scene.budget = 1000;
    let done = run(&event, "prune = \"published\"");
    assert_eq!((done.split.len(), done.pruned), (2, vec![4]));
}

#[test]
fn opacities_are_reset_as_in_the_original() {
    let resets = |white_background| {
        let scene = SceneInfo { white_background, ..Event::new(1, 1, 1).scene };
        due_steps("taming", "grow_every = 0", &scene)
    };
    assert_eq!(resets(false), [3000, 6000, 9000, 12_000]);
    assert_eq!(resets(true), [500, 3000, 6000, 9000, 12_000]);
    let done = run(&event(3000, 3, 9), "");
    assert_eq!((done.ops.clamp_opacity, done.ops.cause.as_str()), (Some(0.01), "densify+reset"));
}

#[test]
fn views_and_cadence_follow_the_parameters() {
    let scene = Event::new(1, 1, 1).scene;
    let policy = build("taming", "sh_every = 5\nsh_rest = 0.5\nerror_weight = 3", &scene);
    assert_eq!([policy.aux_views(1000, 1, 9), policy.aux_views(3001, 1, 9)], [10, 0]);
    assert_eq!(build("taming", "views = 0", &scene).aux_views(1000, 1, 9), u32::MAX);
    let needs = policy.needs(&scene);
    assert_eq!(policy.cadence(1), Cadence { all: 1, sh_rest: 5 });
    assert_eq!(needs.cadence, policy.cadence(1));
    let sh_rest = Some(Rate::constant(0.5));
    assert_eq!(needs.rates, RateOverrides { sh_rest, ..RateOverrides::default() });
    assert_eq!(needs.aux.unwrap().map, PixelMap { error: 3.0, edge: 50.0, threshold: 0.0 });
}

#[test]
fn other_parameter_values_conform() {
    assert_conforms(
        "taming",
        &[
            "tau = 0.0\nviews = 0\nprune_share = 1.0",
            "prune = \"published\"\nmultiplier = 2.0\ntau = 0.0",
        ],
    );
}
