//! Tests of the policy's edits: reports, the budget, the peak, errors and panics.

use super::*;

#[test]
fn edits_are_reported_and_the_budget_holds() {
    let (mut trainer, ..) = trainer(&CASE);
    let events: Vec<EditEvent> = (0..9).flat_map(|_| trainer.step().unwrap().events).collect();
    let counts: Vec<_> =
        events.iter().map(|e| (e.step, e.before, e.added, e.denied, e.after)).collect();
    assert_eq!(counts, [(2, 3, 3, 0, 6), (4, 6, 4, 2, 10), (6, 10, 0, 10, 10), (8, 10, 0, 10, 10)]);
    assert_eq!((events[0].updated, events[0].removed, &*events[0].cause), (3, 0, "scripted"));
    assert_eq!(trainer.state.events, events);
    assert_eq!((trainer.progress().peak_rows, trainer.rows(), trainer.steps_done()), (10, 10, 9));
}

#[test]
fn frozen_rows_count_towards_the_budget_and_are_hidden_from_policies() {
    let case = Case { rows: 5, aux_views: 1, ..CASE };
    let info = SceneInfo { budget: 7, initial_rows: 2, ..scene(&case, 3) };
    let options = TrainOptions { frozen: 3, ..OPTIONS };
    let refused = build(&case, 3, scene(&case, 3), options);
    assert!(matches!(refused, Err(TrainError::BadOption(why)) if why.contains("(3 frozen)")));
    let (mut trainer, log, _) = build(&case, 3, info, options).unwrap();
    let events: Vec<EditEvent> = (0..9).flat_map(|_| trainer.step().unwrap().events).collect();
    let counts: Vec<_> =
        events.iter().map(|e| (e.step, e.before, e.added, e.denied, e.after)).collect();
    assert_eq!(counts, [(2, 5, 2, 0, 7), (4, 7, 3, 1, 10), (6, 10, 0, 7, 10), (8, 10, 0, 7, 10)]);
    assert!(log.lock().unwrap().iter().any(|call| call.starts_with("observe")));
    // A frozen row with non-finite values ends the run.
    let case = Case { unsound: 1, behaviour: Behaviour::Nothing, ..case };
    let info = SceneInfo { budget: 7, initial_rows: 2, ..scene(&case, 3) };
    let (mut trainer, ..) = build(&case, 3, info, options).unwrap();
    let error = (0..9).find_map(|_| trainer.step().err()).expect("the run ends");
    assert!(matches!(error, TrainError::NonFinite { .. }), "{error}");
}

#[test]
fn a_plan_that_changes_nothing_is_not_an_event() {
    let (mut trainer, log, _) = trainer(&Case { behaviour: Behaviour::Nothing, ..CASE });
    assert!((0..9).all(|_| trainer.step().unwrap().events.is_empty()));
    assert!(trainer.state.events.is_empty());
    // Such a plan is executed nevertheless, because it may reset statistics.
    assert!(log.lock().unwrap().contains(&"apply 2".to_owned()));
}

#[test]
fn the_peak_number_of_rows_is_kept_after_pruning() {
    let (mut trainer, ..) = trainer(&Case { rows: 8, behaviour: Behaviour::Halve, ..CASE });
    for _ in 0..4 {
        trainer.step().unwrap();
    }
    assert_eq!((trainer.rows(), trainer.progress().peak_rows), (2, 8));
}

#[test]
fn a_policy_error_ends_the_run_before_the_edit() {
    let (message, rows, calls) = failure(&Case { behaviour: Behaviour::Fail, ..CASE });
    assert_eq!(message, "step 2: policy `scripted`: out of ideas");
    assert_eq!(rows, 3);
    assert!(!calls.iter().any(|d| d.starts_with("apply")), "{calls:?}");
    let (message, rows, calls) = failure(&Case { behaviour: Behaviour::Panic, ..CASE });
    assert!(message.contains("`scripted`: it panicked: no row 3;"), "{message}");
    assert_eq!(rows, 3);
    assert!(!calls.iter().any(|d| d.starts_with("apply")), "{calls:?}");
    let (message, ..) = failure(&Case { behaviour: Behaviour::ReadUndeclared, ..CASE });
    assert!(message.contains("Age") && message.contains("not declared"), "{message}");
}
