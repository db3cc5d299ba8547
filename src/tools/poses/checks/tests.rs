//! Tests of the checks on views whose poses are known.

use super::*;

/// Views on a ring, each pair of neighbours matched: `pairs` follow from the true poses.
fn ring(count: usize) -> (Vec<View>, Vec<Pair>) {
    let views: Vec<View> = (0..count)
        .map(|step| {
            let rotation =
                DQuat::from_rotation_y(step as f64 * std::f64::consts::TAU / count as f64);
            View { rotation, translation: DVec3::new(0.0, 0.0, 3.0), points: 100, focal_px: 500.0 }
        })
        .collect();
    let pairs = (0..count).flat_map(|first| (1..4).map(move |gap| [first, (first + gap) % count]));
    let pairs = pairs.map(|views_of| pair(&views, views_of, 60)).collect();
    (views, pairs)
}

/// What the true poses say about a pair.
fn pair(views: &[View], [first, second]: [usize; 2], inliers: u32) -> Pair {
    let rotation = views[second].rotation * views[first].rotation.inverse();
    let direction = views[second].translation - rotation * views[first].translation;
    Pair { views: [first, second], inliers, rotation, direction: Some(direction.normalize()) }
}

#[test]
fn right_poses_are_accepted() {
    let (views, pairs) = ring(12);
    let verdict = check(&views, &pairs);
    assert_eq!((verdict.accepted(), verdict.is_hopeless()), (12, false));
}

#[test]
fn a_view_whose_matches_contradict_it_is_rejected_and_no_other() {
    for turned in [DQuat::from_rotation_y(1.8), DQuat::from_rotation_x(0.12)] {
        let (mut views, pairs) = ring(12);
        views[5].rotation = turned * views[5].rotation;
        let verdict = check(&views, &pairs);
        assert!(verdict.reasons[5].is_some_and(Reason::is_contradiction), "{verdict:?}");
        assert_eq!(verdict.accepted(), 11, "{verdict:?}");
    }
}

#[test]
fn a_view_that_only_its_false_match_confirms_is_rejected() {
    let (mut views, mut pairs) = ring(12);
    views[5].rotation = DQuat::from_rotation_y(1.8) * views[5].rotation;
    // The false match has more inliers than all others, and agrees with the pose that it led to.
    pairs.push(pair(&views, [5, 0], 500));
    let verdict = check(&views, &pairs);
    assert_eq!(verdict.reasons[5], Some(Reason::Unconfirmed { pairs: 1 }));
    assert_eq!(verdict.accepted(), 11, "{verdict:?}");
}

#[test]
fn a_shifted_camera_is_rejected_by_the_directions_of_its_pairs() {
    let (mut views, pairs) = ring(12);
    views[5].translation += DVec3::new(0.0, 3.0, 0.0);
    let verdict = check(&views, &pairs);
    assert!(verdict.reasons[5].is_some() && verdict.accepted() == 11, "{verdict:?}");
}

#[test]
fn parts_without_a_common_pair_are_split_and_views_without_points_or_far_away_are_rejected() {
    let (mut views, pairs) = ring(12);
    let apart: Vec<Pair> = pairs
        .into_iter()
        .filter(|pair| pair.views.iter().all(|v| *v < 8) || pair.views.iter().all(|v| *v >= 8))
        .collect();
    let verdict = check(&views, &apart);
    assert_eq!(verdict.accepted(), 8);
    assert!(verdict.reasons[8..].contains(&Some(Reason::Apart)), "{verdict:?}");
    let (_, pairs) = ring(12);
    views[3].points = 12;
    assert_eq!(check(&views, &pairs).reasons[3], Some(Reason::FewPoints { points: 12 }));
    views[3].translation = DVec3::new(0.0, 0.0, 500.0);
    assert_eq!(check(&views, &pairs).reasons[3], Some(Reason::Far));
}

#[test]
fn a_model_in_which_many_views_are_contradicted_is_not_believed() {
    let (mut views, pairs) = ring(12);
    for view in &mut views[4..8] {
        view.rotation = DQuat::from_rotation_y(1.6) * view.rotation;
    }
    // The four agree with each other, but their ties to the others do not.
    let strong: Vec<Pair> = pairs
        .into_iter()
        .map(|pair| {
            let crosses = (4..8).contains(&pair.views[0]) != (4..8).contains(&pair.views[1]);
            Pair { inliers: if crosses { 200 } else { 60 }, ..pair }
        })
        .collect();
    assert!(check(&views, &strong).is_hopeless());
}

#[test]
fn short_focal_lengths_have_larger_limits() {
    let (mut views, pairs) = ring(12);
    views[5].rotation = DQuat::from_rotation_x(0.05) * views[5].rotation;
    assert!(check(&views, &pairs).reasons[5].is_some());
    views.iter_mut().for_each(|view| view.focal_px = 190.0);
    assert_eq!(check(&views, &pairs).accepted(), 12);
}
