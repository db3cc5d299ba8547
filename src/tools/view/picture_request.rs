//! Validation of picture requests: nothing that a browser sends reaches the renderer unchecked.

use serde::Deserialize;

use super::http::Response;
use super::picture_kind::PictureKind;
use super::scene::Scene;
use densify_core::camera_path::{self, Keyframe};
use densify_train::evaluate::Split;

/// Longest side of a picture `[px]`.
pub(super) const MAX_SIDE: u32 = 4096;
/// Maximum number of pixels of a picture: its rendering takes 80 MiB, and its tiles as much again.
pub(super) const MAX_PIXELS: u64 = 1 << 22;
/// Maximum number of characters of a page's identifier.
const MAX_NAME: usize = 32;
/// Allowed fields of view `[°]`; beyond these nothing is recognisable.
const FIELDS_OF_VIEW: std::ops::RangeInclusive<f64> = 1.0..=170.0;
/// Largest distance of a camera from the scene's centre, in scene radii; far beyond, single precision cannot
/// distinguish Gaussians.
const FARTHEST: f64 = 1e4;

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct RequestBody {
    page: String,
    #[serde(default)]
    place: u8,
    kind: PictureKind,
    #[serde(default)]
    model: usize,
    width: u32,
    height: u32,
    #[serde(default)]
    moving: bool,
    camera: Option<CameraBody>,
    view: Option<ViewBody>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct CameraBody {
    camera_to_world: Vec<f64>,
    fov: f64,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct ViewBody {
    split: Split,
    number: usize,
}

/// A valid request for a picture.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct PictureRequest {
    /// The page and which of its two panes; a newer request of the same pane replaces an older one.
    pub(super) pane: (String, u8),
    pub(super) kind: PictureKind,
    /// Index of the model.
    pub(super) model: usize,
    /// Width and height into which the picture must fit `[px]`.
    pub(super) size: (u32, u32),
    /// True while the camera moves, so that the next request follows at once.
    pub(super) is_moving: bool,
    pub(super) camera: Viewpoint,
}

#[cfg(test)]
impl PictureRequest {
    /// A request for the picture of a training view.
    pub(super) fn of_view(page: &str, kind: PictureKind, size: (u32, u32), number: usize) -> Self {
        let (pane, camera) = ((page.to_owned(), 0), Viewpoint::View(Split::Train, number));
        Self { pane, kind, model: 0, size, is_moving: false, camera }
    }
}

/// The camera of a picture.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Viewpoint {
    /// Any camera, in the dataset's own coordinates.
    Free(Keyframe),
    /// The camera of a view.
    View(Split, usize),
}

/// Parses and validates the body of a picture request.
pub(super) fn parse(body: &[u8], scene: &Scene) -> Result<PictureRequest, Response> {
    let body: RequestBody = serde_json::from_slice(body).map_err(|error| {
        Response::error(400, format_args!("this is not a picture request: {error}"))
    })?;
    check(body, scene).map_err(|message| Response::error(400, message))
}

fn check(body: RequestBody, scene: &Scene) -> Result<PictureRequest, String> {
    let RequestBody { page, place, kind, model, width, height, moving, camera, view } = body;
    let is_plain = |c: char| c.is_ascii_alphanumeric() || c == '-';
    if page.is_empty() || page.len() > MAX_NAME || !page.chars().all(is_plain) {
        return Err(format!("page must be 1 to {MAX_NAME} letters and digits"));
    }
    if place > 1 {
        return Err("place must be 0 or 1: a page shows two pictures at most".into());
    }
    let is_sound = |side: u32| (1..=MAX_SIDE).contains(&side);
    if !is_sound(width) || !is_sound(height) || u64::from(width) * u64::from(height) > MAX_PIXELS {
        return Err(format!(
            "{width}x{height} px cannot be shown: sides must be 1 to {MAX_SIDE} px, with at most {MAX_PIXELS} \
            pixels; make the window smaller, or choose a lower resolution"
        ));
    }
    if model >= scene.models.len() {
        return Err(format!("model must be less than {}", scene.models.len()));
    }
    let camera = match (camera, view) {
        (Some(camera), None) => Viewpoint::Free(parse_camera(&camera, scene)?),
        (None, Some(ViewBody { split, number })) => {
            let views = scene.views[split as usize].len();
            if number >= views {
                return Err(format!("there are {views} such views; number must be less"));
            }
            Viewpoint::View(split, number)
        }
        _ => return Err("give either camera or view".into()),
    };
    if kind.needs_photograph() && matches!(camera, Viewpoint::Free(_)) {
        return Err("only the camera of a view has a photograph".into());
    }
    if let Some((_, why)) = scene.unavailable.iter().find(|(unavailable, _)| *unavailable == kind) {
        return Err(format!("this cannot be shown: {why}"));
    }
    let (size, is_moving) = ((width, height), moving);
    Ok(PictureRequest { pane: (page, place), kind, model, size, is_moving, camera })
}

fn parse_camera(camera: &CameraBody, scene: &Scene) -> Result<Keyframe, String> {
    let key = camera_path::parse_keyframe(&camera.camera_to_world, camera.fov)?;
    if !FIELDS_OF_VIEW.contains(&camera.fov) {
        let (least, most) = (FIELDS_OF_VIEW.start(), FIELDS_OF_VIEW.end());
        return Err(format!("fov is {}; it must be {least} to {most} degrees", camera.fov));
    }
    let distance = scene.normalisation.scene_from_world(key.centre).length();
    // The comparison is also false for NaN.
    if distance <= FARTHEST { Ok(key) } else { Err("the camera is too far from the scene".into()) }
}

#[cfg(test)]
mod tests {
    use serde_json::{Value, json};

    use super::*;
    use crate::open::scene_of_one_view;
    use crate::scene::ModelInfo;

    /// A scene with two models, one training view and no test views.
    fn scene() -> Scene {
        let (_folder, mut scene) = scene_of_one_view();
        scene.mark_unavailable(&[PictureKind::Count], "on a GPU");
        scene.mark_unavailable(&[PictureKind::RowAge], "trains");
        scene.models = vec![ModelInfo::sample(1), ModelInfo::sample(1)];
        scene
    }

    fn parse_changed(scene: &Scene, changes: Value) -> Result<PictureRequest, String> {
        let pose = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1];
        let mut body = json!({
            "page": "a-1", "kind": "render", "width": 640, "height": 480,
            "camera": { "camera_to_world": pose, "fov": 50 },
        });
        for (name, value) in changes.as_object().unwrap() {
            match value {
                Value::Null => _ = body.as_object_mut().unwrap().remove(name),
                value => body[name] = value.clone(),
            }
        }
        parse(body.to_string().as_bytes(), scene).map_err(|response| {
            format!("{} {}", response.status, String::from_utf8_lossy(&response.body))
        })
    }

    #[test]
    fn valid_requests_are_parsed() {
        let scene = scene();
        let request =
            parse_changed(&scene, json!({ "moving": true, "model": 1, "place": 1 })).unwrap();
        assert_eq!((request.size, request.model, request.is_moving), ((640, 480), 1, true));
        assert_eq!(request.pane, ("a-1".to_owned(), 1));
        let Viewpoint::Free(key) = request.camera else { panic!("{request:?}") };
        assert!((key.fov_y.to_degrees() - 50.0).abs() < 1e-9);
        let at_view = json!({ "camera": null, "view": { "split": "train", "number": 0 }, "kind": "difference" });
        let request = parse_changed(&scene, at_view).unwrap();
        assert_eq!(request.camera, Viewpoint::View(Split::Train, 0));
        assert_eq!(request.kind, PictureKind::Difference);
    }

    #[test]
    fn invalid_requests_are_refused_with_the_reason() {
        let scene = scene();
        let pose = |at: usize, value: f64| {
            let mut pose = glam::DMat4::IDENTITY.to_cols_array();
            pose[at] = value;
            json!({ "camera": { "camera_to_world": pose, "fov": 50 } })
        };
        let view = |split: &str, number: i64| json!({ "camera": null, "view": { "split": split, "number": number } });
        for (changes, reason) in [
            (json!({ "width": 100_000 }), "100000x480 px"),
            (json!({ "width": 4096, "height": 4096 }), "4194304 pixels"),
            (json!({ "width": 0 }), "0x480 px"),
            (json!({ "width": -1 }), "not a picture"),
            (json!({ "height": 1e300 }), "not a picture"),
            (json!({ "page": "" }), "page"),
            (json!({ "page": "../../etc" }), "page"),
            (json!({ "page": "a".repeat(33) }), "page"),
            (json!({ "place": 2 }), "place"),
            (json!({ "model": 2 }), "model"),
            (json!({ "kind": "shadow" }), "not a picture"),
            (json!({ "kind": "count" }), "GPU"),
            (json!({ "kind": "row_age" }), "trains"),
            (json!({ "path": "/etc/passwd" }), "unknown field"),
            (json!({ "camera": null }), "either"),
            (json!({ "view": { "split": "test", "number": 0 } }), "either"),
            (json!({ "kind": "photograph" }), "photograph"),
            (view("train", 1), "1 such views"),
            (view("test", 0), "0 such views"),
            (view("test", -1), "not a picture"),
            (view("../test", 0), "not a picture"),
            (pose(0, -1.0), "mirrors"),
            (pose(3, 1e30), "too far"),
            (pose(3, 1e308), "too far"),
            (json!({ "camera": { "camera_to_world": [1, 2], "fov": 50 } }), "2 numbers"),
            (json!({ "camera": { "camera_to_world": vec![1; 17], "fov": 50 } }), "17 numbers"),
            (json!({ "camera": { "camera_to_world": [1, "a"], "fov": 50 } }), "not a picture"),
        ] {
            let error = parse_changed(&scene, changes.clone()).expect_err(&changes.to_string());
            assert!(error.starts_with("400 ") && error.contains(reason), "{changes}: {error}");
        }
        for fov in [0.0, 0.5, 171.0, 180.0, -1.0] {
            let mut changes = pose(0, 1.0);
            changes["camera"]["fov"] = fov.into();
            assert!(parse_changed(&scene, changes).unwrap_err().contains("fov"), "{fov}");
        }
        for body in [&b""[..], b"{", b"[]", b"\xff", b"{\"width\": 1e999}", &[b'['; 4096]] {
            assert_eq!(parse(body, &scene).unwrap_err().status, 400);
        }
    }
}
