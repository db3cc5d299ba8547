use densify_core::pose::Twist;
use glam::{DMat3, DVec2, DVec3};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::*;

const VIEWS: usize = 14;
const POINTS: usize = 700;

/// A ring of cameras about a cloud of points.
struct Scene {
    truth: Vec<Camera>,
    tracks: Tracks,
}

/// `noise` is the standard deviation of the directions `[px]`.
fn scene(noise: f64) -> Scene {
    let mut rng = ChaCha8Rng::seed_from_u64(3);
    let camera = |view: usize| {
        let angle = view as f64 / VIEWS as f64 * std::f64::consts::TAU;
        let rotation = DMat3::from_rotation_y(angle);
        let translation = DVec3::new(0.0, 0.0, 1.0);
        Camera { translation, ..Camera::centred((200, 150), (180.0, 180.0), rotation, DVec3::ZERO) }
    };
    let truth: Vec<Camera> = (0..VIEWS).map(camera).collect();
    let mut tracks = Tracks::default();
    for _ in 0..POINTS {
        let mut along = || rng.random_range(-0.4..0.4);
        let point = DVec3::new(along(), along(), along());
        let mut seen = (Vec::new(), Vec::new());
        for (view, camera) in (0..).zip(&truth) {
            if rng.random_bool(0.4) {
                continue;
            }
            let mut off = || noise * 1.7 * rng.random_range(-1.0..1.0);
            let (pixel, _) = camera.project(point);
            let at = camera.unproject(pixel + DVec2::new(off(), off()), 1.0);
            seen.0.push(view);
            seen.1.push((at - camera.centre()).normalize().as_vec3().to_array());
        }
        tracks.positions.push(point);
        tracks.colours.push([0; 3]);
        tracks.views.push(seen.0);
        tracks.directions.push(seen.1);
    }
    Scene { truth, tracks }
}

/// The scene with poses of which each is off by a twist; tracks know only the directions in the wrong poses' axes.
fn disturbed(noise: f64, by: f64) -> (Scene, Vec<Camera>) {
    let mut rng = ChaCha8Rng::seed_from_u64(5);
    let mut scene = scene(noise);
    let given: Vec<Camera> = scene
        .truth
        .iter()
        .map(|camera| {
            let values =
                std::array::from_fn(|i| if i < 6 { by * rng.random_range(-1.0..1.0) } else { 0.0 });
            camera.moved(&Twist::from_array(values))
        })
        .collect();
    let Tracks { views, directions, .. } = &mut scene.tracks;
    for (view, direction) in views.iter().flatten().zip(directions.iter_mut().flatten()) {
        let (truth, given) = (&scene.truth[*view as usize], &given[*view as usize]);
        let world = DVec3::from(direction.map(f64::from));
        *direction = (given.rotation.transpose() * (truth.rotation * world)).as_vec3().to_array();
    }
    (scene, given)
}

/// Largest distance between centres `[scene units]`.
fn off(a: &[Camera], b: &[Camera]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a.centre().distance(b.centre())).fold(0.0, f64::max)
}

#[test]
fn wrong_poses_return_to_the_truth() {
    let (scene, given) = disturbed(0.0, 0.01);
    let found = adjust(&scene.tracks, &given, false).expect("enough tracks");
    assert!(found.errors.are_off() && found.errors.motion > 1.0, "{:?}", found.errors);
    assert!(found.errors.after < 0.02 && found.errors.before > 0.5, "{:?}", found.errors);
    let [before, after] = [&given, &found.cameras].map(|cameras| off(cameras, &scene.truth));
    assert!(after < 0.02 * before, "{before} {after}");
}

#[test]
fn good_poses_stay_and_noise_of_tracks_is_no_evidence() {
    let (scene, given) = disturbed(0.5, 0.0);
    let found = adjust(&scene.tracks, &given, false).expect("enough tracks");
    assert!(!found.errors.are_off(), "{:?}", found.errors);
    assert!((found.errors.before - 0.55).abs() < 0.15, "{:?}", found.errors);
    assert!(off(&given, &found.cameras) < 5e-3);
}

#[test]
fn focal_lengths_of_a_lens_return_too() {
    let (scene, mut given) = disturbed(0.0, 0.005);
    for camera in &mut given {
        (camera.fx, camera.fy) = (1.01 * camera.fx, 1.01 * camera.fy);
    }
    let mut tracks = scene.tracks;
    // Directions by the wrong focal lengths.
    for (view, direction) in
        tracks.views.iter().flatten().zip(tracks.directions.iter_mut().flatten())
    {
        let given = &given[*view as usize];
        let local = given.rotation * DVec3::from(direction.map(f64::from));
        let local = DVec3::new(local.x / 1.01, local.y / 1.01, local.z).normalize();
        *direction = (given.rotation.transpose() * local).as_vec3().to_array();
    }
    let found = adjust(&tracks, &given, true).expect("enough tracks");
    let zoom = found.cameras[3].fx / scene.truth[3].fx;
    assert!((zoom - 1.0).abs() < 1e-3, "{zoom}");
    assert!(off(&found.cameras, &scene.truth) < 0.2 * off(&given, &scene.truth));
}

/// Points that were placed badly are no reason to move poses.
#[test]
fn wrong_points_do_not_move_right_poses() {
    let (mut scene, given) = disturbed(0.0, 0.0);
    let mut rng = ChaCha8Rng::seed_from_u64(9);
    for position in &mut scene.tracks.positions {
        *position += 0.05 * DVec3::new(rng.random(), rng.random(), rng.random());
    }
    let found = adjust(&scene.tracks, &given, false).expect("enough tracks");
    assert!(!found.errors.are_off() && found.errors.before > 1.0, "{:?}", found.errors);
}

/// A tenth of the points are seen somewhere else in a view.
#[test]
fn wrong_tracks_do_not_move_poses() {
    let (mut scene, given) = disturbed(0.1, 0.01);
    for directions in scene.tracks.directions.iter_mut().step_by(10) {
        if let Some(first) = directions.first_mut() {
            first[1] += 0.2;
        }
    }
    let found = adjust(&scene.tracks, &given, false).expect("enough tracks");
    let [before, after] = [&given, &found.cameras].map(|cameras| off(cameras, &scene.truth));
    assert!(after < 0.1 * before, "{before} {after}");
}

#[test]
fn few_or_unknown_directions_are_no_evidence() {
    let Scene { truth, mut tracks } = scene(0.0);
    for directions in &mut tracks.directions {
        directions.fill([f32::NAN; 3]);
    }
    assert_eq!(adjust(&tracks, &truth, false), None);
    assert_eq!(adjust(&Tracks::default(), &truth, false), None);
}
