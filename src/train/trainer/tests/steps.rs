//! Tests of steps: the order of views, prefetching, cadence, options, and errors.

use super::*;
use crate::exposure::ExposureModel;
use crate::poses::ExpectedErrors;

#[test]
fn every_epoch_shows_every_view_once_and_prefetches() {
    let (mut trainer, log, prefetched) = trainer(&Case { every: 100, ..CASE });
    let shown: Vec<usize> = (0..9).map(|_| trainer.step().unwrap().view).collect();
    for (epoch, views) in shown.chunks(3).enumerate() {
        assert_eq!(views, schedule::view_order(3, 7, epoch as u32));
    }
    let log = log.lock().unwrap();
    let epochs: Vec<usize> = (0..log.len()).filter(|&i| log[i] == "epoch").collect();
    assert_eq!(epochs, [0, 4, 8]);
    // The backend received the right images.
    let steps: Vec<String> =
        shown.iter().enumerate().map(|(i, view)| format!("step {} view {view}", i + 1)).collect();
    assert_eq!(log.iter().filter(|d| *d != "epoch").cloned().collect::<Vec<_>>(), steps);
    // The next two views are prefetched, but none beyond the end of the run.
    for (i, views) in prefetched.lock().unwrap().iter().enumerate() {
        assert_eq!(*views, format!("{:?}", &shown[i + 1..(i + 3).min(9)]));
    }
}

/// Each view has its own exposure, which is learned in the steps of this view and is saved in checkpoints.
#[test]
fn exposures_belong_to_views() {
    let gains = [[1.0, 0.5, 1.0], [1.0; 3], [1.0, 1.5, 1.0]];
    let initial = || Exposures::new(ExposureModel::Channels, &gains);
    let case = Case { every: 100, ..CASE };
    let (new, log, _) = trainer(&case);
    let mut new = new.with_exposures(Some(initial()));
    let shown: Vec<usize> = (0..6).map(|_| new.step().unwrap().view).collect();
    let log = log.lock().unwrap().clone();
    let noted: Vec<f32> = log
        .iter()
        .filter_map(|line| line.strip_prefix("exposure "))
        .map(|gain| gain.parse().unwrap())
        .collect();
    for (gain, view) in noted.iter().zip(&shown) {
        assert!((gain - gains[*view][1]).abs() < 0.05, "view {view}: {gain}");
    }
    // A step reduces the view's factor; the mean is constant, so the factors of the other views increase.
    assert!(noted[1..3].iter().zip(&shown[1..]).all(|(gain, view)| *gain > gains[*view][1]));
    let state = new.state().unwrap();
    assert_eq!(state.exposures, new.progress().exposures);
    let (resumed, ..) = trainer(&case);
    let mut resumed = resumed.with_exposures(Some(initial()));
    resumed.resume(state.clone()).unwrap();
    assert_eq!(resumed.progress().exposures, new.progress().exposures);
    let (mut without, ..) = trainer(&case);
    let refused = without.resume(state).unwrap_err().to_string();
    assert!(refused.contains("exposures"), "{refused}");
}

/// Each view has its own pose, which moves in the steps of this view, is what later steps see, and is saved in checkpoints.
#[test]
fn poses_belong_to_views() {
    let case = Case { every: 100, ..CASE };
    let (new, log, _) = trainer(&case);
    let given: Vec<Camera> = (0..3).map(|view| *new.views().camera(view)).collect();
    let initial = || Some(Poses::new(&given, &given, 9, 1.1, ExpectedErrors::default()));
    let mut new = new.with_poses(initial());
    (0..8).for_each(|_| _ = new.step().unwrap());
    let log = log.lock().unwrap().clone();
    let seen: Vec<f64> = log
        .iter()
        .filter_map(|line| line.strip_prefix("camera at "))
        .map(|y| y.parse().unwrap())
        .collect();
    // Poses rest in the first quarter of the run, two steps.
    assert_eq!(seen[..3], [given[0].translation.y; 3]);
    assert!(seen[6..].iter().any(|y| (y - given[0].translation.y).abs() > 1e-5), "{seen:?}");
    let state = new.state().unwrap();
    let (resumed, ..) = trainer(&case);
    let mut resumed = resumed.with_poses(initial());
    resumed.resume(state.clone()).unwrap();
    assert_eq!(resumed.progress().poses, new.progress().poses);
    assert_eq!(resumed.camera(1), new.camera(1));
    let (mut without, ..) = trainer(&case);
    let refused = without.resume(state).unwrap_err().to_string();
    assert!(refused.contains("poses"), "{refused}");
}

#[test]
fn terms_and_noise_change_with_the_step() {
    let noted = |opacity: f32, strength: f32| {
        let noise = NoiseTerm { strength, sharpness: 1.0, opacity: 0.5 };
        let terms = (LossTerms { opacity, scale: 0.0 }, Some(noise));
        let (mut trainer, log, _) = trainer(&Case { terms, every: 100, ..CASE });
        for _ in 0..8 {
            trainer.step()?;
        }
        let log = log.lock().unwrap().clone();
        Ok(log.into_iter().filter(|d| d.starts_with("terms")).collect::<Vec<_>>())
    };
    let terms: Result<_, TrainError> = noted(0.25, 2.0);
    assert_eq!(terms.unwrap(), ["terms (0.25, Some(2.0))"; 2]);
    for (opacity, strength, part) in [(f32::NAN, 2.0, "opacity"), (0.5, -1.0, "noise.strength")] {
        let error = noted(opacity, strength).unwrap_err().to_string();
        assert!(error.starts_with("step 7: policy `scripted`: "), "{error}");
        assert!(error.contains(part), "{error}");
    }
}

#[test]
fn the_policy_sets_the_cadence() {
    let noted = |all: u32, sh_rest: u32| {
        let case = Case { cadence: Cadence { all, sh_rest }, every: 100, ..CASE };
        let (mut trainer, log, _) = build(&case, 3, scene(&case, 3), OPTIONS)?;
        for _ in 0..9 {
            trainer.step()?;
        }
        let log = log.lock().unwrap().clone();
        Ok::<_, TrainError>(
            log.into_iter().filter(|d| d.starts_with("cadence")).collect::<Vec<_>>(),
        )
    };
    assert_eq!(noted(1, 1).unwrap(), [""; 0]);
    assert_eq!(noted(4, 1).unwrap(), ["cadence 4 1"; 4]);
    for sh_rest in [9, 0] {
        let undeclared = noted(1, sh_rest).unwrap_err().to_string();
        assert!(undeclared.starts_with("step 6: policy `scripted`: it wants"), "{undeclared}");
    }
}

#[test]
fn views_are_shrunk_with_their_cameras() {
    let noted = |resolution: f64| {
        let case = Case { resolution, every: 100, ..CASE };
        let (mut trainer, log, _) = trainer(&case);
        for _ in 0..3 {
            trainer.step()?;
        }
        let log = log.lock().unwrap().clone();
        Ok::<_, TrainError>(log.into_iter().filter(|d| d.starts_with("size")).collect::<Vec<_>>())
    };
    assert_eq!(noted(0.5).unwrap(), ["size 32x32, cx 16, fy 0.5"; 2]);
    assert_eq!(noted(1.0).unwrap(), [""; 0]);
    for scale in [0.2, 1.5, f64::NAN] {
        let error = noted(scale).unwrap_err().to_string();
        assert!(error.starts_with("step 1: policy `scripted`: the resolution is"), "{error}");
    }
}

#[test]
fn errors_name_the_view() {
    let (message, _, calls) = failure(&Case { nan_loss_at: 4, every: 4, ..CASE });
    let view = ["a.png", "b.png", "c.png"][schedule::view_order(3, 7, 1)[0]];
    assert!(message.starts_with(&format!("step 4: the loss of view `{view}` is NaN")), "{message}");
    assert!(!calls.contains(&"apply 4".to_owned()), "{calls:?}");
    let (message, ..) = failure(&Case { unreadable: Some(1), ..CASE });
    assert!(message.contains("view `b.png`: file is gone"), "{message}");
    // The backend's state is still that of the previous step, even at the start of an epoch.
    let first = schedule::view_order(3, 7, 0)[0];
    let (_, _, calls) = failure(&Case { unreadable: Some(first), ..CASE });
    assert_eq!(calls, [""; 0]);
}

#[test]
fn contradictory_options_are_refused() {
    let refused = |views, change: fn(&mut SceneInfo, &mut TrainOptions)| {
        let (mut scene, mut options) = (scene(&CASE, 3), OPTIONS);
        change(&mut scene, &mut options);
        build(&CASE, views, scene, options).err().expect("refused").to_string()
    };
    assert!(refused(0, |_, _| ()).contains("no training view"));
    assert!(refused(2, |_, _| ()).contains("2 views"));
    assert!(refused(3, |_, o| o.iterations = 8).contains("8 iterations"));
    assert!(refused(3, |s, _| s.extent = f32::NAN).contains("extent"));
    assert!(refused(3, |s, _| s.budget = 11).contains("budget 10 (scene's: 11)"));
    assert!(refused(3, |_, o| o.rates.quat = -1.0).contains("quat must"));
    assert!(build(&CASE, 3, scene(&CASE, 3), OPTIONS).is_ok());
}
