//! What the page is told when it opens: models, kinds of pictures, cameras, points, and where to begin.

use glam::DVec3;
use serde_json::{Value, json};

use super::asked::{MOST_PIXELS, MOST_SIDE};
use super::kinds::Kind;
use super::ramp;
use super::stage::Stage;
use crate::camera::Camera;
use crate::flight;
use crate::run::POINTS_TO_LOOK_AT;

/// Which way is up where no camera says so: as structure from motion has it, y points down.
const UP: DVec3 = DVec3::NEG_Y;

/// A camera as camera paths have it: axes right, up, backward; row after row.
fn pose(camera: &Camera) -> Value {
    let [right, down, forward] = [0, 1, 2].map(|axis| camera.rotation.row(axis));
    let (centre, up, back) = (camera.centre(), -down, -forward);
    let row = |i: usize| [right[i], up[i], back[i], centre[i]];
    let rows = [row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]];
    let fov = 2.0 * (0.5 * f64::from(camera.height) / camera.fy).atan().to_degrees();
    json!({ "camera_to_world": rows.as_flattened(), "fov": fov })
}

/// All of it.
pub(super) fn describe(stage: &Stage) -> Value {
    let world = |camera: &Camera| stage.normalisation.world_from_scene_camera(camera);
    let point = |scene: DVec3| stage.normalisation.world_from_scene(scene).to_array();
    let views = stage.views.each_ref().map(|views| {
        let view = |view: &crate::dataset::View| {
            let mut said = pose(&world(&view.camera));
            said["name"] = view.name.clone().into();
            said["width"] = view.camera.width.into();
            said["height"] = view.camera.height.into();
            said
        };
        views.iter().map(view).collect::<Vec<Value>>()
    });
    let cameras: Vec<Camera> = stage.views.iter().rev().flatten().map(|view| view.camera).collect();
    let first = stage.views.iter().flatten().map(|view| view.camera).next().or(stage.start);
    let (up, pivot) = match cameras.is_empty() {
        true => (UP, DVec3::ZERO),
        false => {
            let flight::Bearings { up, focus, looks_inward } = flight::bearings(&cameras);
            let ahead = first.map_or(DVec3::ZERO, |camera| camera.centre() + camera.forward());
            (up, if looks_inward { focus } else { ahead })
        }
    };
    let points = stage.points.thinned(POINTS_TO_LOOK_AT);
    let positions = points.positions.iter().map(|&at| point(at));
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
        "points": {
            "positions": positions.collect::<Vec<_>>(),
            "colours": points.colours,
        },
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::flight::Key;

    #[test]
    fn a_camera_is_said_as_a_camera_path_has_it() {
        let key =
            Key::looking_at(DVec3::new(1.0, 2.0, 3.0), DVec3::new(-4.0, 0.5, 9.0), DVec3::Z, 0.8);
        let said = pose(&key.camera((300, 200)));
        let numbers: Vec<f64> = serde_json::from_value(said["camera_to_world"].clone()).unwrap();
        let back = flight::key(&numbers, said["fov"].as_f64().unwrap()).unwrap();
        assert!((back.centre - key.centre).length() < 1e-9);
        assert!(back.turn.dot(key.turn).abs() > 1.0 - 1e-12);
        assert!((back.fov_y - key.fov_y).abs() < 1e-12);
    }
}
