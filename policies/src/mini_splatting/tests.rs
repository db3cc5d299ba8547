//! Tests of the rules of `mini-splatting`, each worked out by hand.

#![expect(clippy::float_cmp, reason = "values are copied without rounding")]

use super::*;
use crate::event::{Event, Outcome, View, assert_conforms, build, due_steps};
use crate::plan::{OpacityRule, ScaleRule};

fn run(event: &Event, set: &str) -> Outcome {
    event.run("mini-splatting", set)
}

/// Rows of opacity 0.5 along a line, one unit apart; the growth rules neither densify nor prune them.
fn event(step: u32, rows: usize) -> Event {
    let line: Vec<f32> = (0..rows).flat_map(|row| [row as f32, 0.0, 0.0]).collect();
    Event::small_rows(step, rows, rows).with(Signal::Position, &line)
}

/// A view in which rows have these sums of blend weights and numbers of pixels, and dominate so many of them.
fn view(weights: &[f32], pixels: &[f32], dominated: &[f32]) -> View {
    let columns = [
        (AuxColumn::WeightSum, weights),
        (AuxColumn::PixelCount, pixels),
        (AuxColumn::DominantPixels, dominated),
    ];
    View {
        columns: columns.map(|(column, values)| (column, values.to_vec())).into(),
        ..View::default()
    }
}

#[test]
fn dominant_rows_are_split() {
    let event = Event { budget: 9, ..event(600, 4) }
        // H·W/5000 is 2e-4 of the pixels; row 3 grows by its gradient and is not split as well.
        .with(Signal::DominantPixels, &[1.99e-4, 2.01e-4, 0.5, 0.6])
        .with(Signal::ScreenGradient, &[0.0, 0.0, 0.0, 1.0]);
    let done = run(&event, "");
    assert_eq!((done.cloned.as_slice(), done.split.as_slice()), (&[3][..], &[2, 1][..]));
    assert_eq!(done.offspring()[1].scale, ScaleRule::Uniform(1.0 / 1.6));
    assert!(done.ops.reset_signals.contains(Signal::DominantPixels));
    assert_eq!(run(&event, "dominant_share = 0.4").split, [2]);
    assert!(run(&event, "dominant_share = 1.0").split.is_empty());
    // The budget holds: one clone, then the split of the row that dominates most.
    let full = run(&Event { budget: 6, ..event }, "");
    assert_eq!((full.ops.rows_after, full.split.as_slice()), (6, &[2][..]));
}

#[test]
fn the_schedule_is_the_published_one() {
    let scene = Event::new(1, 1, 1).scene;
    let steps = due_steps("mini-splatting", "", &scene);
    // Growth from 600 to 14,900, the sampling, the cut.
    assert_eq!((steps.len(), steps[0], &steps[143..]), (146, 600, &[14_900, 15_000, 20_000][..]));
    let policy = build("mini-splatting", "", &scene);
    let all: Vec<u32> =
        (0..=30_000).filter(|&step| policy.aux_views(step, 9, 9) == u32::MAX).collect();
    assert_eq!(all, [5000, 10_000, 15_000, 20_000]);
    let needs = policy.needs(&scene);
    assert_eq!(needs.rates.opacity, Some(Rate::constant(0.05)));
    assert!(needs.detailed_edits && needs.check() == Ok(()));
    // Steps scale by 7,000/30,000.
    let short = SceneInfo { iterations: 7000, ..scene.clone() };
    assert_eq!(due_steps("mini-splatting", "grow_every = 0", &short), [1167, 2333, 3500, 4667]);
    // No opacity resets.
    let white = SceneInfo { white_background: true, ..scene };
    assert_eq!(due_steps("mini-splatting", "grow_every = 0", &white), all);
}

#[test]
fn the_model_is_replaced_by_surface_points() {
    let point = |x: f32| Candidate {
        position: [x, 0.0, 0.0],
        colour: [0.5; 3],
        pixel_size: 0.1,
        error: 1.0,
    };
    let event = Event { budget: 10, ..event(5000, 4) };
    let seen = View { points: (0..9).map(|x| point(x as f32)).collect(), ..View::default() };
    let scene = SceneInfo { train_views: 2, budget: 10, ..event.scene.clone() };
    let event = Event { views: vec![seen.clone(), seen], scene, ..event }
        .with_all(Signal::ScreenGradient, 1.0);
    let done = run(&event, "");
    // 0.8 · 10 rows, four of each view; nothing grows.
    assert_eq!((done.ops.rows_after, done.ops.seeds.len()), (8, 8));
    assert!(done.ops.families.is_empty() && done.ops.cause == "reinit");
    assert!(done.ops.seeds.iter().all(|(_, seed)| seed.opacity == 0.1));
    assert_eq!(run(&event, "reinit_share = 0.4").ops.rows_after, 4);
    // Without points, and at other steps, the model is kept.
    assert!(run(&Event { views: Vec::new(), ..event.clone() }, "").ops.is_empty());
    assert!(!run(&Event { step: 5100, ..event }, "").cloned.is_empty());
}

#[test]
fn half_of_the_rows_with_an_importance_are_kept_and_restarted() {
    // Row 1 dominates nothing and row 4 has no weight: three have an importance, of which ⌊1.5⌋ = 1 is kept.
    let mut event = event(15_000, 5);
    event.views = vec![
        view(&[5.0, 9.0, 0.0, 0.0, 0.0], &[5.0; 5], &[1.0, 0.0, 0.0, 0.0, 0.0]),
        view(&[0.0, 9.0, 1e-9, 1e-9, 0.0], &[5.0; 5], &[0.0, 0.0, 1.0, 1.0, 1.0]),
    ];
    let done = run(&event, "");
    assert_eq!((done.pruned.as_slice(), done.ops.cause.as_str()), (&[1, 2, 3, 4][..], "sample"));
    // The only row that is kept has no neighbours; its size is 0.02 · the extent of 10.
    let restart = Update::restart(0.2, 0.1);
    assert_eq!(done.ops.updates, [(0, restart)]);
    assert_eq!((restart.opacity, restart.sh_degree), (OpacityRule::Set(0.1), Some(0)));
    // With a share of 1 all three rows are kept, at x = 0, 2 and 3. The size of row 0 is √((2² + 3²)/2).
    let all = run(&event, "sample_share = 1.0");
    assert_eq!(all.pruned, [1, 4]);
    let ScaleRule::Set(size) = all.ops.updates[0].1.scale else { panic!("{:?}", all.ops.updates) };
    assert!((size - 6.5_f32.sqrt()).abs() < 1e-6, "{size}");
    assert!(!all.ops.reset_signals.is_empty());
    // Without a view nothing is pruned.
    assert!(run(&Event { views: Vec::new(), ..event }, "").ops.is_empty());
}

#[test]
fn importance_may_be_averaged_over_pixels() {
    // The sums are 1e6 and 1; per pixel they are 1e-6 and 1.
    let mut event = event(15_000, 2);
    event.views = vec![view(&[1e6, 1.0], &[1e12, 1.0], &[1.0, 1.0])];
    assert_eq!(run(&event, "").pruned, [1]);
    assert_eq!(run(&event, "importance = \"density\"").pruned, [0]);
}

#[test]
fn the_cut_leaves_ninety_nine_percent_of_the_importance() {
    // The pruned rows may have 1 % of the importance, 1 of 100: 0.2 + 0.4 is less, 0.2 + 0.4 + 0.5 is more.
    let mut event = event(20_000, 5);
    event.views = vec![view(&[0.4, 90.0, 8.9, 0.5, 0.2], &[1.0; 5], &[1.0; 5])];
    let done = run(&event, "");
    assert_eq!((done.pruned.as_slice(), done.ops.cause.as_str()), (&[0, 4][..], "prune"));
    assert!(done.ops.updates.is_empty());
    assert_eq!(run(&event, "cut_mass = 0.9").pruned, [0, 2, 3, 4]);
    assert!(run(&event, "cut_mass = 1.0").pruned.is_empty());
}

#[test]
fn the_control_keeps_the_same_number_at_random() {
    // 300 of 1,000 have an importance.
    let weights: Vec<f32> = (0..1000).map(|row| if row < 300 { 1.0 } else { 0.0 }).collect();
    let mut event = event(15_000, 1000);
    event.views = vec![view(&weights, &[1.0; 1000], &[1.0; 1000])];
    let real = run(&event, "");
    assert_eq!((real.ops.rows_after, real.ops.updates.len()), (150, 150));
    assert!(real.ops.updates.iter().all(|(row, _)| *row < 300));
    let control = run(&event, "victims = \"random\"");
    assert_eq!(control.ops.rows_after, 150);
    // By chance, 0.3 · 150 of the kept rows have an importance: 45 ± 5·5.2 (hypergeometric).
    let important = control.ops.updates.iter().filter(|(row, _)| *row < 300).count();
    assert!(important.abs_diff(45) < 26, "{important}");
}

#[test]
fn other_parameter_values_conform() {
    assert_conforms(
        "mini-splatting",
        &[
            "first_reinit_at = 200\nsecond_reinit_at = 0\nsample_at = 300\ncut_at = 400",
            "importance = \"density\"\nsample_at = 100\ncut_mass = 0.5\ncut_at = 200",
            "victims = \"random\"\ndominant_share = 0.0\nsample_share = 0.0",
        ],
    );
}
