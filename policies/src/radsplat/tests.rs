//! Tests of the rules of `radsplat`, each worked out by hand.

use super::*;
use crate::event::{
    Event, Outcome, View, assert_conforms, assert_grows_like_vanilla, build, due_steps,
};
use crate::policy::Signal;

fn run(event: &Event, set: &str) -> Outcome {
    event.run("radsplat", set)
}

/// Rows of opacity 0.5 with these largest blend weights in each view; the growth rules neither densify nor
/// prune them.
fn event(step: u32, views: &[&[f32]]) -> Event {
    let rows = views[0].len();
    let mut event = Event::small_rows(step, rows, rows);
    let view = |weights: &&[f32]| View {
        columns: vec![(AuxColumn::WeightMax, weights.to_vec())],
        ..View::default()
    };
    event.views = views.iter().map(view).collect();
    event
}

#[test]
fn rows_below_min_weight_in_every_view_are_pruned() {
    // Maxima: 0.0099, 0.01, 0.5, 0, 0.02. The sum of row 0 is larger than that of row 1.
    let views: [&[f32]; 2] = [&[0.0099, 0.01, 0.0, 0.0, 0.02], &[0.0099, 0.0, 0.5, f32::NAN, 0.0]];
    for step in [16_000, 24_000] {
        let done = run(&event(step, &views), "");
        assert_eq!((done.pruned.as_slice(), done.ops.cause.as_str()), (&[0, 3][..], "prune"));
        assert!(done.ops.clamp_opacity.is_none() && done.cloned.is_empty());
    }
    // The light variant keeps only row 2.
    assert_eq!(run(&event(16_000, &views), "min_weight = 0.25").pruned, [0, 1, 3, 4]);
    assert!(run(&event(16_000, &views), "min_weight = 0.0").pruned.is_empty());
    // One row is always kept: that with the largest weight.
    assert_eq!(run(&event(16_000, &views), "min_weight = 1.0").pruned, [0, 1, 3, 4]);
}

#[test]
fn prunes_come_after_growth_and_scale_with_the_run() {
    let due = |set: &str, iterations| {
        let scene = SceneInfo { iterations, ..Event::new(1, 1, 1).scene };
        due_steps("radsplat", &format!("grow_every = 0\nreset_every = 0\n{set}"), &scene)
    };
    assert_eq!(due("", 30_000), [16_000, 24_000]);
    // Steps scale by 7,000/30,000: to 3733.3 and 5600.
    assert_eq!(due("", 7000), [3733, 5600]);
    assert_eq!(due("first_at = 0", 30_000), [24_000]);
    assert_eq!(due("second_at = 0", 30_000), [16_000]);
    let scene = Event::new(1, 1, 1).scene;
    let growth = due_steps("radsplat", "", &scene);
    assert_eq!((growth.len(), growth[143]), (146, 14_900));
    let policy = build("radsplat", "", &scene);
    let views = [14_900, 16_000, 24_000].map(|step| policy.aux_views(step, 9, 9));
    assert_eq!(views, [0, u32::MAX, u32::MAX]);
    assert_eq!(policy.needs(&scene).aux.unwrap().columns, [AuxColumn::WeightMax]);
}

#[test]
fn growth_is_that_of_vanilla() {
    assert_grows_like_vanilla("radsplat", event(600, &[&[0.0; 4]]), "");
}

#[test]
fn rows_that_grow_in_an_event_are_not_pruned_in_it() {
    // Rows 0 and 1 are below `min_weight`, and row 0 is cloned.
    let event = Event { budget: 9, ..event(600, &[&[0.0, 0.0, 0.5]]) }
        .with(Signal::ScreenGradient, &[1.0, 0.0, 0.0]);
    let done = run(&event, "first_at = 600");
    assert_eq!((done.cloned.as_slice(), done.pruned.as_slice()), (&[0][..], &[1][..]));
    assert_eq!((done.ops.cause.as_str(), done.ops.counts.denied), ("densify+prune", 0));
}

#[test]
fn the_control_prunes_the_same_number_at_random() {
    // 300 of 1,000 are below `min_weight`.
    let weights: Vec<f32> = (0..1000).map(|row| if row < 300 { 0.001 } else { 0.5 }).collect();
    let event = event(16_000, &[&weights]);
    assert!(run(&event, "").pruned.iter().all(|row| *row < 300));
    let random = run(&event, "victims = \"random\"");
    assert_eq!(random.ops.rows_after, 700);
    // 30 % of the pruned rows should be below `min_weight`: 90 ± 5·√44.1 (hypergeometric).
    let low = random.pruned.iter().filter(|row| **row < 300).count();
    assert!(low.abs_diff(90) < 34, "{low}");
}

#[test]
fn the_second_prune_of_the_control_may_keep_a_given_number() {
    let scene = Event::new(1, 1, 1).scene;
    let set = "victims = \"random\"\nrandom_keep = 3";
    let event = event(24_000, &[&[0.0, 0.5, 0.5, 0.5, 0.5]]);
    assert_eq!(run(&event, set).ops.rows_after, 3);
    // `random_keep` applies neither to the first prune nor without the control; a smaller model is not pruned.
    assert_eq!(run(&Event { step: 16_000, ..event.clone() }, set).ops.rows_after, 4);
    assert_eq!(run(&event, "random_keep = 3").ops.rows_after, 4);
    assert_eq!(run(&event, "victims = \"random\"\nrandom_keep = 1").ops.rows_after, 1);
    assert_eq!(run(&event, "victims = \"random\"\nrandom_keep = 9").ops.rows_after, 5);
    let views = |step| build("radsplat", set, &scene).aux_views(step, 9, 9);
    assert_eq!([16_000, 24_000].map(views), [u32::MAX, 0]);
}

#[test]
fn without_a_view_nothing_is_pruned() {
    let event = Event { views: Vec::new(), ..event(16_000, &[&[0.0; 10]]) };
    assert!(run(&event, "").pruned.is_empty());
}

#[test]
fn other_parameter_values_conform() {
    assert_conforms(
        "radsplat",
        &[
            "min_weight = 0.25\ngovernor = true",
            "victims = \"random\"",
            "victims = \"random\"\nrandom_keep = 5",
            "first_at = 200\nsecond_at = 300\nmin_weight = 1.0",
        ],
    );
}
