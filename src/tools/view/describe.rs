//! What the page is told when it opens: models, kinds of pictures, cameras, points, and where to begin.

use std::mem;
use std::sync::Arc;

use glam::DVec3;
use serde::Serialize;
use serde_json::{Value, json};

use super::asked::{MOST_PIXELS, MOST_SIDE};
use super::kinds::Kind;
use super::ramp;
use super::stage::Stage;
use crate::live::POINTS_TO_LOOK_AT;
use densify_core::camera::Camera;
use densify_core::camera_path;

/// Which way is up where no camera says so: as structure from motion has it, y points down.
const UP: DVec3 = DVec3::NEG_Y;

const NO_POINTS: &str = "it brings none; training of it begins from random points";

/// A camera as camera paths have it: axes right, up, backward; row after row.
fn pose(camera: &Camera) -> Value {
    let [right, down, forward] = [0, 1, 2].map(|axis| camera.rotation.row(axis));
    let (centre, up, back) = (camera.centre(), -down, -forward);
    let row = |i: usize| [right[i], up[i], back[i], centre[i]];
    let rows = [row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]];
    let fov = 2.0 * (0.5 * f64::from(camera.height) / camera.fy).atan().to_degrees();
    json!({ "camera_to_world": rows.as_flattened(), "fov": fov })
}

/// Focal lengths and principal point in parts of the image's width and height: fx, fy, cx, cy.
fn lens(camera: &Camera) -> Vec<f64> {
    let [width, height] = [camera.width, camera.height].map(f64::from);
    vec![camera.fx / width, camera.fy / height, camera.cx / width, camera.cy / height]
}

/// Most that a point takes of the description `[bytes]`.
pub(super) const POINT: usize = 128;

/// What is said of everything else, and the points. There are many: as [`Value`]s they would take a multiple.
#[derive(Serialize)]
struct Description {
    #[serde(flatten)]
    rest: Value,
    points: Points,
}

/// In the dataset's own coordinates, and their colours.
#[derive(Serialize)]
struct Points {
    positions: Vec<[f64; 3]>,
    colours: Vec<[u8; 3]>,
}

/// All of it, as JSON. The points go into it: nothing else needs them.
pub(super) fn describe(stage: &mut Stage) -> Arc<[u8]> {
    let points = mem::take(&mut stage.points).thinned(POINTS_TO_LOOK_AT);
    let positions =
        points.positions.iter().map(|&at| stage.normalisation.world_from_scene(at).to_array());
    let points = Points { positions: positions.collect(), colours: points.colours };
    let mut rest = all_but_points(stage);
    if points.positions.is_empty()
        && stage.views.iter().any(|views| !views.is_empty())
        && let Some(lacking) = rest["lacking"].as_array_mut()
    {
        lacking.push(json!({ "label": "The dataset’s points", "why": NO_POINTS }));
    }
    let description = Description { rest, points };
    serde_json::to_vec(&description).expect("numbers and text are JSON").into()
}

fn all_but_points(stage: &Stage) -> Value {
    let world = |camera: &Camera| stage.normalisation.world_from_scene_camera(camera);
    let point = |scene: DVec3| stage.normalisation.world_from_scene(scene).to_array();
    let views = stage.views.each_ref().map(|views| {
        let view = |view: &densify_data::dataset::View| {
            let mut said = pose(&world(&view.camera));
            said["name"] = view.name.clone().into();
            said["width"] = view.camera.width.into();
            said["height"] = view.camera.height.into();
            said["lens"] = lens(&view.camera).into();
            said
        };
        views.iter().map(view).collect::<Vec<Value>>()
    });
    let cameras: Vec<Camera> = stage.views.iter().rev().flatten().map(|view| view.camera).collect();
    let first = stage.views.iter().flatten().map(|view| view.camera).next().or(stage.start);
    let (up, pivot) = match cameras.is_empty() {
        true => (UP, DVec3::ZERO),
        false => {
            let camera_path::Orientation { up, focus, looks_inward } =
                camera_path::orientation(&cameras);
            let ahead = first.map_or(DVec3::ZERO, |camera| camera.centre() + camera.forward());
            (up, if looks_inward { focus } else { ahead })
        }
    };
    let models = stage
        .models
        .iter()
        .map(|model| json!({ "name": model.name, "rows": model.rows, "degree": model.sh_degree }));
    let lacks = |kind: Kind| stage.lacking.iter().find(|(lacking, _)| *lacking == kind);
    let kinds = Kind::ALL.into_iter().filter(|&kind| lacks(kind).is_none());
    let lacking =
        stage.lacking.iter().map(|(kind, why)| json!({ "label": kind.legend().label, "why": why }));
    json!({
        "title": stage.title,
        "live": stage.largest.is_some(),
        "models": models.collect::<Vec<Value>>(),
        "kinds": kinds.map(Kind::legend).collect::<Vec<_>>(),
        "lacking": lacking.collect::<Vec<Value>>(),
        "ramp": ramp::STOPS,
        "limits": { "side": MOST_SIDE, "pixels": MOST_PIXELS },
        "up": up.to_array(),
        "pivot": point(pivot),
        "radius": 1.0 / stage.normalisation.scale,
        "start": first.map(|camera| pose(&world(&camera))),
        "views": { "test": views[0], "train": views[1] },
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::open::stage_of_one_view;
    use densify_core::camera_path::Keyframe;

    #[test]
    fn points_take_no_more_than_they_may() {
        let (_folder, mut stage) = stage_of_one_view();
        let lacks_points = |said: &[u8]| String::from_utf8_lossy(said).contains(NO_POINTS);
        let said = describe(&mut stage);
        assert!(lacks_points(&said), "it is not said that there are no points");
        let without = said.len();
        // As many digits as numbers can have.
        let count = 2 * POINTS_TO_LOOK_AT;
        stage.points.positions = vec![DVec3::splat(-1.234_567_890_123_456_7e30); count];
        stage.points.colours = vec![[255; 3]; count];
        let said = describe(&mut stage);
        let points = said.len() - without;
        assert!(
            points <= POINTS_TO_LOOK_AT * POINT && points > POINTS_TO_LOOK_AT * POINT / 3,
            "{points}"
        );
        assert!(stage.points.is_empty() && !lacks_points(&said), "they are held twice, or missing");
        let said: Value = serde_json::from_slice(&said).expect("JSON");
        assert_eq!(
            said["points"]["positions"].as_array().expect("points").len(),
            POINTS_TO_LOOK_AT
        );
        assert_eq!(said["title"], stage.title);
    }

    #[test]
    fn a_camera_is_said_as_a_camera_path_has_it() {
        let key = Keyframe::looking_at(
            DVec3::new(1.0, 2.0, 3.0),
            DVec3::new(-4.0, 0.5, 9.0),
            DVec3::Z,
            0.8,
        );
        let said = pose(&key.camera((300, 200)));
        let numbers: Vec<f64> = serde_json::from_value(said["camera_to_world"].clone()).unwrap();
        let back = camera_path::parse_keyframe(&numbers, said["fov"].as_f64().unwrap()).unwrap();
        assert!((back.centre - key.centre).length() < 1e-9);
        assert!(back.world_from_camera.dot(key.world_from_camera).abs() > 1.0 - 1e-12);
        assert!((back.fov_y - key.fov_y).abs() < 1e-12);
    }
}
