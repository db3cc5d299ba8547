//! Tests of the rules of `compact-3dgs`, each worked out by hand.

use super::*;
use crate::event::{Event, Outcome, assert_conforms, build, due_steps};
use crate::registry::find;

fn run(event: &Event, set: &str) -> Outcome {
    event.run("compact-3dgs", set)
}

/// Rows of opacity 0.5 with these masks; the growth rules neither densify nor prune them.
fn event(step: u32, masks: &[f32]) -> Event {
    Event::small_rows(step, masks.len(), masks.len()).with(Signal::Mask, masks)
}

#[test]
fn rows_whose_mask_has_fallen_are_pruned() {
    let masks = [0.01, 0.0101, 0.5, 0.0, f32::NAN];
    // At a growth step, at a multiple of 1,000 after growth, and at the end.
    for step in [600, 17_000, 30_000] {
        let done = run(&event(step, &masks), "");
        assert_eq!(done.pruned, [0, 3], "step {step}");
        assert!(done.ops.cause.ends_with("prune"), "{}", done.ops.cause);
    }
    assert_eq!(run(&event(17_000, &masks), "min_mask = 0.4").pruned, [0, 1, 3]);
    // One row is always kept: that with the largest mask.
    assert_eq!(run(&event(17_000, &[0.001, 0.003, 0.002]), "").pruned, [0, 2]);
}

#[test]
fn pruning_by_mask_is_due_at_growth_steps_and_every_thousand_steps() {
    let due = |set: &str, iterations| {
        let scene = SceneInfo { iterations, ..Event::new(1, 1, 1).scene };
        due_steps("compact-3dgs", &format!("reset_every = 0\n{set}"), &scene)
    };
    let steps = due("", 30_000);
    // 144 growth steps from 600 to 14,900, then every thousandth step from 15,000 to the end of the run.
    let late: Vec<u32> = (15..=30).map(|thousand| 1000 * thousand).collect();
    assert_eq!((steps[0], &steps[144..]), (600, &late[..]));
    // In a run of 7,000 the interval is 1,000 · 7/30 = 233.3 steps; the last step is due although it is no multiple.
    let short = due("grow_every = 0", 7000);
    assert_eq!((short[0], short.len(), short.last()), (233, 31, Some(&7000)));
    assert_eq!(due("grow_every = 0\nmask_every = 0", 7000), [7000]);
    assert_eq!(due("grow_every = 0\nrandom_keep = 5", 30_000), [15_000]);
}

#[test]
fn the_mask_has_the_published_constants_and_the_control_has_no_mask() {
    let scene = Event::new(1, 1, 1).scene;
    let needs = build("compact-3dgs", "", &scene).needs(&scene);
    let mask = MaskTerm { start: 1.0, rate: 0.01, weight: 5e-4, threshold: 0.01 };
    assert_eq!((needs.mask, needs.check()), (Some(mask), Ok(())));
    assert!(needs.signals.contains(Signal::Mask));
    let control = build("compact-3dgs", "random_keep = 9", &scene).needs(&scene);
    assert_eq!(control, build("vanilla", "", &scene).needs(&scene));
}

#[test]
fn growth_is_that_of_vanilla() {
    let event = Event { budget: 9, ..event(600, &[0.5; 4]) }
        .with(Signal::ScreenGradient, &[8.01e-4, 7.99e-4, 4e-3, 1.0])
        .with(Signal::ScaleMax, &[0.05, 0.05, 0.2, 0.05])
        .with(Signal::Opacity, &[0.5, 0.5, 0.5, 0.001]);
    for set in ["", "tau = 0.0005", "small = 0.03", "governor = true", "min_opacity = 0.6"] {
        let (ours, theirs) = (run(&event, set), event.run("vanilla", set));
        assert_eq!((ours.cloned, ours.split), (theirs.cloned, theirs.split), "{set}");
        assert_eq!(ours.pruned, theirs.pruned, "{set}");
    }
    let (ours, theirs) = (find("compact-3dgs").unwrap(), find("vanilla").unwrap());
    assert!(theirs.parameters().iter().all(|p| ours.parameters().contains(p)));
    assert!(ours.step_parameters().starts_with(theirs.step_parameters()));
}

#[test]
fn the_control_prunes_at_random_down_to_the_given_number() {
    assert_eq!(run(&event(15_000, &[1.0; 100]), "random_keep = 1").ops.rows_after, 1);
    let event = event(15_000, &[0.0; 100]);
    let done = run(&event, "random_keep = 40");
    assert_eq!(done.ops.rows_after, 40);
    // Pruned rows lie on both sides of the middle, so they are not simply the first sixty.
    assert!(done.pruned.iter().any(|&row| row >= 50) && done.pruned.iter().any(|&row| row < 50));
    assert_eq!(run(&event, "random_keep = 200").ops.rows_after, 100);
}

#[test]
fn other_parameter_values_conform() {
    assert_conforms(
        "compact-3dgs",
        &["min_mask = 0.9\nmask_every = 100", "random_keep = 5", "governor = true"],
    );
}
