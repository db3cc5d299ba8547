//! Tests of the removal of floaters.

use super::*;

#[test]
fn floaters_are_removed_before_the_policy_plans() {
    let case = Case { rows: 5, budget: 5, behaviour: Behaviour::Halve, ..CASE };
    let options = TrainOptions { removes_floaters: true, ..OPTIONS };
    let (mut trainer, log, _) = build(&case, 3, scene(&case, 3), options).unwrap();
    let events: Vec<EditEvent> = (0..4).flat_map(|_| trainer.step().unwrap().events).collect();
    let counts: Vec<_> = events.iter().map(|e| (e.step, &*e.cause, e.before, e.removed)).collect();
    let floaters = "in front of the surface";
    assert_eq!(
        counts,
        [(1, floaters, 5, 1), (2, floaters, 4, 1), (2, "scripted", 3, 1), (3, floaters, 2, 1),]
    );
    assert_eq!(trainer.state.extra_forwards, 3 * 3);
    assert_eq!(log.lock().unwrap().iter().filter(|call| call.starts_with("observe")).count(), 9);
}

#[test]
fn frozen_rows_are_no_floaters() {
    for (frozen, removed) in [(1, 1), (2, 0)] {
        let case = Case { rows: 4, every: 100, ..CASE };
        let options = TrainOptions { removes_floaters: true, frozen, ..OPTIONS };
        let scene = SceneInfo { initial_rows: 4 - frozen, budget: 10 - frozen, ..scene(&case, 3) };
        let (mut trainer, ..) = build(&case, 3, scene, options).unwrap();
        let events = trainer.step().unwrap().events;
        assert_eq!(events.iter().map(|event| event.removed).sum::<usize>(), removed, "{frozen}");
    }
}
