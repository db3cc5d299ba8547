//! Tests of camera paths: shapes, smoothness, files.

use std::f64::consts::{PI, TAU};

use super::file::parse;
use super::*;

const UP: DVec3 = DVec3::Z;

/// Cameras in a circle of radius 2 at height 1 around a point, looking at it or away from it.
fn circle(count: u32, around: DVec3, inward: bool) -> Vec<Camera> {
    let camera = |i: u32| {
        let angle = TAU * f64::from(i) / f64::from(count);
        let away = DVec3::new(angle.cos(), angle.sin(), 0.0);
        let centre = around + 2.0 * away + UP;
        let target = if inward { around } else { centre + away };
        Keyframe::looking_at(centre, target, UP, 1.0).camera((64, 48))
    };
    (0..count).map(camera).collect()
}

#[test]
fn a_keyframe_looks_at_its_target_with_the_world_upright() {
    let key =
        Keyframe::looking_at(DVec3::new(1.0, 2.0, 3.0), DVec3::new(1.0, 5.0, 3.0), UP, 0.5 * PI);
    let camera = key.camera((80, 60));
    let (pixel, depth) = camera.project(DVec3::new(1.0, 5.0, 3.0));
    assert!((depth - 3.0).abs() < 1e-12 && (pixel.x - 40.0).abs() < 1e-9, "{pixel} {depth}");
    // A point 45° above the axis is at the image's upper edge.
    let (pixel, _) = camera.project(DVec3::new(1.0, 5.0, 6.0));
    assert!((pixel.y - 0.0).abs() < 1e-9 && (pixel.x - 40.0).abs() < 1e-9, "{pixel}");
    let (pixel, _) = camera.project(DVec3::new(2.0, 5.0, 3.0));
    assert!(pixel.x > 40.0, "x goes to the right: {pixel}");
}

#[test]
fn an_orbit_circles_the_focus_of_the_cameras() {
    let around = DVec3::new(5.0, -3.0, 0.5);
    let path = orbit(&circle(12, around, true));
    assert!(path.is_loop);
    for frame in 0..90 {
        let key = path.frame(frame, 90);
        let offset = key.centre - around;
        let level = DVec3::new(offset.x, offset.y, 0.0).length();
        assert!((level - 2.0).abs() < 1e-3 && (offset.z - 1.0).abs() < 1e-6, "{offset}");
        let (pixel, depth) = key.camera((64, 48)).project(around);
        assert!(depth > 2.0 && pixel.distance(glam::DVec2::new(32.0, 24.0)) < 0.1, "{pixel}");
    }
    // Around cameras that look outward, the path looks outward.
    let path = orbit(&circle(12, around, false));
    for frame in 0..30 {
        let key = path.frame(frame, 30);
        let outward = key.centre - (around + UP);
        assert!(key.camera((9, 9)).forward().dot(outward.normalize()) > 0.99, "{outward}");
    }
}

#[test]
fn a_circle_of_cameras_on_their_side_still_gives_the_up_direction() {
    let around = DVec3::new(5.0, -3.0, 0.5);
    let mut cameras = circle(12, around, true);
    for camera in &mut cameras {
        // A quarter turn about the line of sight.
        let centre = camera.centre();
        camera.rotation = DMat3::from_rotation_z(0.5 * PI) * camera.rotation;
        camera.translation = -(camera.rotation * centre);
    }
    let path = orbit(&cameras);
    for frame in 0..24 {
        let key = path.frame(frame, 24);
        assert!((key.centre.z - around.z - 1.0).abs() < 1e-6, "{}", key.centre);
        let up = -key.camera((9, 9)).rotation.row(1);
        assert!(up.z > 0.8, "{up}");
    }
}

#[test]
fn a_spiral_stays_within_the_cameras_and_looks_ahead() {
    // A wall of cameras, all looking along y at a point 4 units away.
    let place = |i: u32| DVec3::new(f64::from(i % 5) - 2.0, 0.0, f64::from(i / 5) - 2.0);
    let target = DVec3::new(0.0, 4.0, 0.0);
    let cameras: Vec<Camera> =
        (0..25).map(|i| Keyframe::looking_at(place(i), target, UP, 0.8).camera((64, 48))).collect();
    let path = spiral(&cameras);
    let mut widest = 0.0_f64;
    for frame in 0..60 {
        let key = path.frame(frame, 60);
        assert!(key.centre.abs().max_element() < 2.1, "{}", key.centre);
        widest = widest.max(key.centre.x.abs());
        let (pixel, depth) = key.camera((64, 48)).project(target);
        assert!(depth > 0.0 && (pixel.x - 32.0).abs() < 3.0, "{pixel}");
    }
    assert!(widest > 1.5, "{widest}");
}

#[test]
fn a_single_camera_is_enough_for_a_path() {
    let one = circle(1, DVec3::ZERO, true);
    for path in [orbit(&one), spiral(&one)] {
        for frame in 0..5 {
            let key = path.frame(frame, 5);
            assert!(
                key.centre.is_finite() && key.world_from_camera.is_finite() && key.fov_y > 0.0,
                "{key:?}"
            );
        }
    }
}

#[test]
fn a_path_passes_its_keyframes_smoothly() {
    let key = |x: f64, angle: f64| Keyframe {
        centre: DVec3::new(x, x * x, 0.0),
        world_from_camera: DQuat::from_rotation_z(angle),
        fov_y: 1.0 + 0.1 * x,
    };
    // The third rotation is given by the other of its two quaternions, −q.
    let mut keys = vec![key(0.0, 0.0), key(1.0, 0.5), key(2.0, 1.5), key(3.0, 3.0)];
    keys[2].world_from_camera = -keys[2].world_from_camera;
    let path = CameraPath { keyframes: keys.clone(), is_loop: false };
    for (at, key) in keys.iter().enumerate() {
        let frame = path.frame(10 * at as u32, 31);
        assert!(frame.centre.distance(key.centre) < 1e-9, "{at}: {frame:?}");
        assert!(
            frame.world_from_camera.dot(key.world_from_camera).abs() > 1.0 - 1e-9,
            "{at}: {frame:?}"
        );
        assert!((frame.fov_y - key.fov_y).abs() < 1e-9, "{at}: {frame:?}");
    }
    // Consecutive steps between frames differ little: no stop and no jump at a keyframe.
    let frames: Vec<Keyframe> = (0..301).map(|frame| path.frame(frame, 301)).collect();
    let steps: Vec<DVec3> = frames.windows(2).map(|pair| pair[1].centre - pair[0].centre).collect();
    for pair in steps.windows(2) {
        assert!(pair[0].distance(pair[1]) < 0.1 * pair[0].length() + 1e-9, "{pair:?}");
    }
    let turns = frames
        .windows(2)
        .map(|pair| pair[0].world_from_camera.angle_between(pair[1].world_from_camera));
    assert!(turns.into_iter().all(|angle| angle < 0.05));
    // A loop returns to its first keyframe.
    let closed = CameraPath { keyframes: keys, is_loop: true };
    assert!(closed.frame(40, 40).centre.distance(closed.frame(0, 40).centre) < 1e-9);
    let single = CameraPath { keyframes: vec![key(1.0, 1.0)], is_loop: false };
    assert_eq!(single.frame(0, 1).centre, single.frame(7, 9).centre);
}

#[test]
fn nerfstudio_files_are_read() {
    let text = r#"{"camera_type": "perspective", "render_height": 4, "fps": 24, "is_cycle": true,
        "seconds": null, "camera_path": [{"fov": 90.0, "aspect": 1.5,
        "camera_to_world": [1, 0, 0, 7, 0, 0, -1, 8, 0, 1, 0, 9, 0, 0, 0, 1]}]}"#;
    let SavedCameraPath { path, frames, fps, size, note } = parse(text).unwrap();
    assert_eq!((path.is_loop, frames, fps, size, note), (true, 1, Some(24), None, None));
    // The viewer writes null unless the crop box is on.
    for (crop, is_noted) in [("null", false), (r#"{"crop_scale": [1, 1, 1]}"#, true)] {
        let text = text.replacen('{', &format!("{{\"crop\": {crop}, "), 1);
        let note = parse(&text).unwrap().note;
        assert_eq!(note.is_some_and(|note| note.contains("crop")), is_noted, "{crop}");
    }
    // The number of frames is the duration times the frame rate.
    let timed = text.replace(r#""seconds": null"#, r#""seconds": 2.02, "render_width": 6.0"#);
    let SavedCameraPath { frames, size, .. } = parse(&timed).unwrap();
    assert_eq!((frames, size), (48, Some((6, 4))));
    let key = path.keyframes[0];
    assert_eq!(key.centre, DVec3::new(7.0, 8.0, 9.0));
    let camera = key.camera((40, 40));
    // In the file, the camera's z axis, (0, −1, 0), points backward, and its y axis, (0, 0, 1), points up.
    assert!(camera.forward().distance(DVec3::Y) < 1e-9, "{}", camera.forward());
    assert!((-camera.rotation.row(1)).distance(DVec3::Z) < 1e-9);
    assert!((camera.fy - 20.0).abs() < 1e-9);
}

#[test]
fn invalid_files_are_refused_with_the_reason() {
    let pose = |numbers: &str, fov: &str| {
        format!(r#"{{"camera_path": [{{"camera_to_world": [{numbers}], "fov": {fov}}}]}}"#)
    };
    let unit = "1,0,0,0, 0,1,0,0, 0,0,1,0, 0,0,0,1";
    for (text, reason) in [
        ("{}".to_owned(), "not a nerfstudio camera path"),
        ("[1, 2".to_owned(), "not a nerfstudio camera path"),
        (r#"{"camera_path": []}"#.to_owned(), "0 cameras"),
        (pose("1, 2", "50"), "2 numbers"),
        (pose(unit, "0"), "fov is 0"),
        (pose(unit, "180"), "fov is 180"),
        (pose("1,0,0,0, 0,1,0,0, 0,0,-1,0, 0,0,0,1", "50"), "mirrors"),
        (pose("1,1,0,0, 0,1,0,0, 0,0,1,0, 0,0,0,1", "50"), "shears"),
        (pose("0,0,0,0, 0,0,0,0, 0,0,0,0, 0,0,0,1", "50"), "shears"),
        (r#"{"camera_type": "fisheye", "camera_path": []}"#.to_owned(), "fisheye"),
    ] {
        let error = parse(&text).unwrap_err();
        assert!(error.contains(reason), "{text}: {error}");
    }
    let valid = pose(unit, "50");
    assert!(parse(&valid).is_ok());
    for (field, reason) in [
        (r#""fps": 0"#, "fps is 0"),
        (r#""fps": 1001"#, "fps is 1001"),
        (r#""seconds": -1, "fps": 9"#, "seconds is -1"),
        (r#""seconds": 1e4, "fps": 60"#, "seconds times fps is 600000"),
        (r#""render_width": 20000"#, "render_width is 20000"),
    ] {
        let text = valid.replacen('{', &format!("{{{field}, "), 1);
        let error = parse(&text).unwrap_err();
        assert!(error.contains(reason), "{text}: {error}");
    }
}
