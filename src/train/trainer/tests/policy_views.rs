//! Tests of views rendered for a policy, and of near-duplicates.

use super::*;

#[test]
fn the_first_of_several_near_duplicates_is_kept() {
    let camera = |x: f64, degrees: f64, fx: f64| {
        let rotation = DMat3::from_rotation_y(degrees.to_radians());
        Camera::centred((64, 48), (fx, 50.0), rotation, DVec3::new(x, 0.0, 0.0))
    };
    // At extent 10, near-duplicates are within 0.1 and one degree of an earlier view that is kept.
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
    // Cameras are 1 apart: at extent 150 the second is a near-duplicate of the first, and the third is not.
    let case = Case { aux_views: 100, ..CASE };
    let info = SceneInfo { extent: 150.0, ..scene(&case, 3) };
    let (trainer, log, _) = build(&case, 3, info, OPTIONS).unwrap();
    let mut trainer =
        trainer.with_auto_choices(AutoChoices { scored_views: true, ..AutoChoices::default() });
    for _ in 0..9 {
        trainer.step().unwrap();
    }
    let log = log.lock().unwrap().clone();
    let observed = |view| log.iter().any(|d| d.starts_with(&format!("observe {view},")));
    assert_eq!([0, 1, 2].map(observed), [true, false, true], "{log:?}");
    assert_eq!(trainer.unscored_views(), 1);
    // All views are trained on.
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
    assert_eq!(trainer.progress().extra_forwards, 2);
    let saw: Vec<f32> = views.iter().map(|&view| view as f32).collect();
    assert_eq!(events[1].cause, format!("saw {saw:?}+scripted"));
    assert_eq!(events[2].cause, "scripted");
    // If more views are requested than exist, all are rendered.
    let (mut trainer, ..) = self::trainer(&Case { aux_views: u32::MAX, ..CASE });
    (0..9).for_each(|_| drop(trainer.step().unwrap()));
    assert_eq!(trainer.progress().extra_forwards, 3);
}

#[test]
fn an_undeclared_column_ends_the_run() {
    let case = Case { aux_views: 1, behaviour: Behaviour::ReadUndeclared, every: 4, ..CASE };
    let (message, rows, calls) = failure(&case);
    assert!(message.contains("step 4: policy `scripted`: column Radius"), "{message}");
    assert!(rows == 3 && calls.iter().all(|d| !d.starts_with("apply")));
}
