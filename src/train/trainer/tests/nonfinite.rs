//! Tests of the removal of rows with non-finite values.

use super::*;

#[test]
fn nonfinite_rows_are_removed_before_the_policy_plans() {
    let case = Case { rows: 2000, budget: 2000, unsound: 2, behaviour: Behaviour::Halve, ..CASE };
    let (mut trainer, log, _) = trainer(&case);
    assert!(trainer.step().unwrap().events.is_empty());
    let events = trainer.step().unwrap().events;
    let counts: Vec<_> = events.iter().map(|e| (&*e.cause, e.before, e.removed)).collect();
    assert_eq!(counts, [("not finite", 2000, 2), ("scripted", 1998, 999)]);
    assert_eq!(log.lock().unwrap().iter().filter(|d| *d == "apply 2").count(), 2);
    assert_eq!(trainer.state.events, events);
}

#[test]
fn nonfinite_rows_are_removed_at_the_end() {
    let (mut trainer, ..) = trainer(&Case { unsound: 1, every: 100, ..CASE });
    let events: Vec<EditEvent> = (0..9).flat_map(|_| trainer.step().unwrap().events).collect();
    assert_eq!((events.len(), events[0].step, events[0].after), (1, 9, 2));
}

#[test]
fn many_nonfinite_rows_end_the_run() {
    // One in a thousand rows may be removed, and a single row always, unless it is the only one.
    for (rows, unsound, ends) in
        [(3, 1, false), (3, 2, true), (3000, 3, false), (3000, 4, true), (1, 1, true)]
    {
        let case = Case { rows, budget: 3000, unsound, every: 100, ..CASE };
        let (mut trainer, ..) = trainer(&case);
        let error = (0..9).find_map(|_| trainer.step().err());
        assert_eq!(error.is_some(), ends, "{unsound} of {rows}");
        if let Some(error) = error {
            let message = error.to_string();
            let count = format!("step 9: {unsound} of {rows} Gaussians");
            assert!(
                message.starts_with(&count) && message.contains("opacity of row 0"),
                "{message}"
            );
            assert_eq!((trainer.rows(), trainer.steps_done()), (rows, 9));
        }
    }
    let case = Case { rows: 2000, budget: 2000, unsound: 1, ..CASE };
    let options = TrainOptions { on_nan: OnNan::Stop, ..OPTIONS };
    let (mut trainer, ..) = build(&case, 3, scene(&case, 3), options).unwrap();
    assert!(trainer.step().is_ok() && trainer.step().is_err());
}
