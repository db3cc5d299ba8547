//! Tests of the views rendered for a policy: fresh signals, near-duplicates, auxiliary views.

use super::*;

#[test]
fn fresh_views_are_measured_where_they_are_wanted() {
    let run = |fresh_views: u32, seed: u64| {
        let case = Case { fresh_views, ..CASE };
        let options = TrainOptions { seed, ..OPTIONS };
        let (mut trainer, log, _) = build(&case, 3, scene(&case, 3), options).unwrap();
        for _ in 0..9 {
            trainer.step().unwrap();
        }
        let log = log.lock().unwrap().clone();
        let is_edit = |d: &String| d.starts_with("measure") || d.starts_with("apply");
        (log.into_iter().filter(is_edit).collect::<Vec<_>>(), trainer.extra_forwards())
    };
    // 3 rows of 10 at step 2, where none is wanted, then 6, 10, 10.
    let expected = |count: usize, seed: u64| -> Vec<String> {
        let event = |step: u32| {
            let count = if step == 2 { 0 } else { count };
            let degree = schedule::sh_degree(step, 9, 3);
            let views = schedule::fresh_views(3, count, seed, step).into_iter();
            let measured = views.map(move |view| format!("measure {view} at degree {degree}"));
            measured.chain([format!("apply {step}")])
        };
        [2, 4, 6, 8].into_iter().flat_map(event).collect()
    };
    assert_eq!(run(2, 7), (expected(2, 7), 6));
    assert_eq!(run(2, 7), run(2, 7));
    assert_eq!(run(2, 8), (expected(2, 8), 6));
    assert_ne!(run(2, 7), run(2, 8));
    // There are no more than three.
    assert_eq!(run(100, 7), (expected(3, 7), 9));
    assert_eq!(run(0, 7), (expected(0, 7), 0));
}

#[test]
fn fresh_signals_can_be_read_only_where_they_are_wanted() {
    let case = Case { behaviour: Behaviour::ReadFresh, fresh_views: 2, ..CASE };
    let (message, ..) = failure(&case);
    assert!(message.contains("FreshWeightMax was read but not declared"), "{message}");
    assert!(message.starts_with("step 2") && message.contains("`wants_fresh`"), "{message}");
    let (mut trainer, ..) = trainer(&Case { rows: 6, ..case });
    assert!((0..9).all(|_| trainer.step().is_ok()));
}

#[test]
fn the_first_of_near_duplicates_is_kept() {
    let camera = |x: f64, degrees: f64, fx: f64| {
        let rotation = DMat3::from_rotation_y(degrees.to_radians());
        Camera::centred((64, 48), (fx, 50.0), rotation, DVec3::new(x, 0.0, 0.0))
    };
    // Extent 10: within 0.1 and one degree of an earlier view that is kept.
    let cameras = vec![
        camera(0.0, 0.0, 50.0),
        camera(0.09, 0.9, 50.0),
        camera(0.15, 0.0, 50.0),
        camera(0.0, 1.1, 50.0),
        camera(0.0, 0.0, 60.0),
        camera(0.16, 0.1, 50.0),
    ];
    let views = FakeViews { cameras, unreadable: None, prefetched: CallLog::default() };
    assert_eq!(distinct_views(&views, 10.0), [0, 2, 3, 4]);
    assert_eq!(distinct_views(&views, 1e-3), [0, 1, 2, 3, 4, 5]);
}

#[test]
fn near_duplicates_are_not_scored() {
    // Cameras one apart: with an extent of 150, the second is the first, and the third is not.
    let case = Case { fresh_views: 100, ..CASE };
    let info = SceneInfo { extent: 150.0, ..scene(&case, 3) };
    let (trainer, log, _) = build(&case, 3, info, OPTIONS).unwrap();
    let mut trainer =
        trainer.requiring(AutoChoices { scored_views: true, ..AutoChoices::default() });
    for _ in 0..9 {
        trainer.step().unwrap();
    }
    let log = log.lock().unwrap().clone();
    let measured: Vec<&str> =
        log.iter().filter(|d| d.starts_with("measure")).map(|d| &d[..9]).collect();
    assert!(measured.contains(&"measure 0") && measured.contains(&"measure 2"), "{log:?}");
    assert!(!measured.contains(&"measure 1"), "{log:?}");
    assert_eq!(trainer.unscored_views(), 1);
    // All are trained on.
    assert!((0..3).all(|view| log.iter().any(|d| d.contains(&format!("view {view}")))), "{log:?}");
}

#[test]
fn auxiliary_views_are_shown_before_the_plan() {
    let case = Case { aux_views: 2, ..CASE };
    let (mut trainer, log, _) = trainer(&case);
    let events: Vec<EditEvent> = (0..9).flat_map(|_| trainer.step().unwrap().events).collect();
    let views = schedule::fresh_views(3, 2, 7, 4);
    let degree = schedule::sh_degree(4, 9, 3);
    let shown = |view: &usize| format!("observe {view}, pixel {view}, degree {degree}");
    let log = log.lock().unwrap();
    let first = log.iter().position(|d| d.starts_with("observe")).unwrap();
    let expected: Vec<String> = views.iter().map(shown).chain(["apply 4".to_owned()]).collect();
    assert_eq!(log[first..first + 3], expected);
    assert_eq!(log.iter().filter(|d| d.starts_with("observe")).count(), 2);
    assert_eq!(trainer.extra_forwards(), 2);
    let saw: Vec<f32> = views.iter().map(|&view| view as f32).collect();
    assert_eq!(events[1].cause, format!("saw {saw:?}+scripted"));
    assert_eq!(events[2].cause, "scripted");
    // All of them, where more are wanted than there are.
    let (mut trainer, ..) = self::trainer(&Case { aux_views: u32::MAX, ..CASE });
    (0..9).for_each(|_| drop(trainer.step().unwrap()));
    assert_eq!(trainer.extra_forwards(), 3);
}

#[test]
fn an_undeclared_column_ends_the_run() {
    let case = Case { aux_views: 1, behaviour: Behaviour::ReadUndeclared, every: 4, ..CASE };
    let (message, rows, calls) = failure(&case);
    assert!(message.contains("step 4: policy `scripted`: column Radius"), "{message}");
    assert!(rows == 3 && calls.iter().all(|d| !d.starts_with("apply")));
}
