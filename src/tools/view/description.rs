//! The JSON description of the scene that a page loads first: models, kinds of pictures, cameras, points, first camera.

use std::mem;
use std::sync::Arc;

use glam::DVec3;
use serde::Serialize;
use serde_json::{Value, json};

use super::colour_map;
use super::picture_kind::PictureKind;
use super::picture_request::{MAX_PIXELS, MAX_SIDE};
use super::scene::Scene;
use crate::live::MAX_POINTS;
use densify_core::camera::Camera;
use densify_core::camera_path;

/// The up direction of a scene without cameras: in structure from motion, y points down.
const UP: DVec3 = DVec3::NEG_Y;

const NO_POINTS: &str = "it has none; training starts from random points";

/// A camera in the format of camera paths: `camera_to_world` row by row, with axes right, up, backward.
fn pose(camera: &Camera) -> Value {
    let [right, down, forward] = [0, 1, 2].map(|axis| camera.rotation.row(axis));
    let (centre, up, back) = (camera.centre(), -down, -forward);
    let row = |i: usize| [right[i], up[i], back[i], centre[i]];
    let rows = [row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]];
    let fov = 2.0 * (0.5 * f64::from(camera.height) / camera.fy).atan().to_degrees();
    json!({ "camera_to_world": rows.as_flattened(), "fov": fov })
}

/// Focal lengths and principal point as fractions of the image's width and height: fx, fy, cx, cy.
fn lens(camera: &Camera) -> Vec<f64> {
    let [width, height] = [camera.width, camera.height].map(f64::from);
    vec![camera.fx / width, camera.fy / height, camera.cx / width, camera.cy / height]
}

/// Maximum number of bytes that a point takes in the description.
pub(super) const MAX_POINT_BYTES: usize = 128;

/// The description. Points are not part of the [`Value`], where they would take several times their memory.
#[derive(Serialize)]
struct Description {
    #[serde(flatten)]
    rest: Value,
    points: Points,
}

/// The points, in the dataset's own coordinates, with their colours.
#[derive(Serialize)]
struct Points {
    positions: Vec<[f64; 3]>,
    colours: Vec<[u8; 3]>,
}

/// Describes the scene as JSON. Takes the points out of the scene, as nothing else needs them.
pub(super) fn describe(scene: &mut Scene) -> Arc<[u8]> {
    let points = mem::take(&mut scene.points).thinned(MAX_POINTS);
    let positions =
        points.positions.iter().map(|&at| scene.normalisation.world_from_scene(at).to_array());
    let points = Points { positions: positions.collect(), colours: points.colours };
    let mut rest = describe_without_points(scene);
    if points.positions.is_empty()
        && scene.views.iter().any(|views| !views.is_empty())
        && let Some(lacking) = rest["lacking"].as_array_mut()
    {
        lacking.push(json!({ "label": "The dataset’s points", "why": NO_POINTS }));
    }
    let description = Description { rest, points };
    serde_json::to_vec(&description).expect("numbers and text are JSON").into()
}

fn describe_without_points(scene: &Scene) -> Value {
    let world = |camera: &Camera| scene.normalisation.world_from_scene_camera(camera);
    let point = |at: DVec3| scene.normalisation.world_from_scene(at).to_array();
    let views = scene.views.each_ref().map(|views| {
        let view = |view: &densify_data::dataset::View| {
            let mut described = pose(&world(&view.camera));
            described["name"] = view.name.clone().into();
            described["width"] = view.camera.width.into();
            described["height"] = view.camera.height.into();
            described["lens"] = lens(&view.camera).into();
            described
        };
        views.iter().map(view).collect::<Vec<Value>>()
    });
    let cameras: Vec<Camera> = scene.views.iter().rev().flatten().map(|view| view.camera).collect();
    let first = scene.views.iter().flatten().map(|view| view.camera).next().or(scene.start);
    let (up, pivot) = if cameras.is_empty() {
        (UP, DVec3::ZERO)
    } else {
        let camera_path::Orientation { up, focus, looks_inward } =
            camera_path::orientation(&cameras);
        let ahead = first.map_or(DVec3::ZERO, |camera| camera.centre() + camera.forward());
        (up, if looks_inward { focus } else { ahead })
    };
    let models = scene.models.iter();
    let models = models.map(|m| json!({ "name": m.name, "rows": m.rows, "degree": m.sh_degree }));
    let is_available = |kind: &PictureKind| scene.unavailable.iter().all(|(k, _)| k != kind);
    let kinds = PictureKind::ALL.into_iter().filter(is_available);
    let unavailable = scene.unavailable.iter();
    let unavailable =
        unavailable.map(|(kind, reason)| json!({ "label": kind.legend().label, "why": reason }));
    json!({
        "title": scene.title,
        "live": scene.largest.is_some(),
        "models": models.collect::<Vec<Value>>(),
        "kinds": kinds.map(PictureKind::legend).collect::<Vec<_>>(),
        "lacking": unavailable.collect::<Vec<Value>>(),
        "ramp": colour_map::STOPS,
        "limits": { "side": MAX_SIDE, "pixels": MAX_PIXELS },
        "up": up.to_array(),
        "pivot": point(pivot),
        "radius": 1.0 / scene.normalisation.scale,
        "start": first.map(|camera| pose(&world(&camera))),
        "views": { "test": views[0], "train": views[1] },
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::open::scene_of_one_view;
    use densify_core::camera_path::Keyframe;

    #[test]
    fn points_take_no_more_memory_than_planned() {
        let (_folder, mut scene) = scene_of_one_view();
        let lacks_points = |json: &[u8]| String::from_utf8_lossy(json).contains(NO_POINTS);
        let described = describe(&mut scene);
        assert!(lacks_points(&described), "the lack of points is not reported");
        let without = described.len();
        // Numbers with as many digits as possible.
        let count = 2 * MAX_POINTS;
        scene.points.positions = vec![DVec3::splat(-1.234_567_890_123_456_7e30); count];
        scene.points.colours = vec![[255; 3]; count];
        let described = describe(&mut scene);
        let points = described.len() - without;
        let most = MAX_POINTS * MAX_POINT_BYTES;
        assert!(points <= most && points > most / 3, "{points}");
        assert!(scene.points.is_empty(), "points are kept twice");
        assert!(!lacks_points(&described), "points are missing");
        let described: Value = serde_json::from_slice(&described).expect("JSON");
        assert_eq!(described["points"]["positions"].as_array().expect("points").len(), MAX_POINTS);
        assert_eq!(described["title"], scene.title);
    }

    #[test]
    fn cameras_have_the_format_of_camera_paths() {
        let (centre, target) = (DVec3::new(1.0, 2.0, 3.0), DVec3::new(-4.0, 0.5, 9.0));
        let key = Keyframe::looking_at(centre, target, DVec3::Z, 0.8);
        let described = pose(&key.camera((300, 200)));
        let numbers: Vec<f64> =
            serde_json::from_value(described["camera_to_world"].clone()).unwrap();
        let back =
            camera_path::parse_keyframe(&numbers, described["fov"].as_f64().unwrap()).unwrap();
        assert!((back.centre - key.centre).length() < 1e-9);
        assert!(back.world_from_camera.dot(key.world_from_camera).abs() > 1.0 - 1e-12);
        assert!((back.fov_y - key.fov_y).abs() < 1e-12);
    }
}
