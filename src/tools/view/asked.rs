//! What a page asks for, checked: nothing that a browser sends reaches the renderer otherwise.

use serde::Deserialize;

use super::http::Answer;
use super::kinds::Kind;
use super::stage::Extent;
use densify_core::camera_path;
use densify_core::camera_path::Keyframe;
use densify_train::evaluate::Split;

/// Longest side of a picture `[px]`.
pub(super) const MOST_SIDE: u32 = 4096;
/// Most pixels of a picture: a rendering of it takes 80 MiB, and the tiles it is made of as much again.
pub(super) const MOST_PIXELS: u64 = 1 << 22;
/// Most characters of a page's name for itself.
const MOST_NAME: usize = 32;
/// Fields of view `[°]`: beyond these nothing is recognised.
const FIELDS: std::ops::RangeInclusive<f64> = 1.0..=170.0;
/// Farthest from the middle of the scene, in its radii: far beyond, single precision no longer tells
/// Gaussians apart.
const FARTHEST: f64 = 1e4;

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Asked {
    page: String,
    #[serde(default)]
    place: u8,
    kind: Kind,
    #[serde(default)]
    model: usize,
    width: u32,
    height: u32,
    #[serde(default)]
    moving: bool,
    camera: Option<AskedCamera>,
    view: Option<AskedView>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct AskedCamera {
    camera_to_world: Vec<f64>,
    fov: f64,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct AskedView {
    split: Split,
    number: usize,
}

/// A picture that is wanted, and can be made.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Wanted {
    /// Whose it is, and which of its pictures: a newer wish takes the place of an older one.
    pub(super) owner: (String, u8),
    pub(super) kind: Kind,
    /// Which model.
    pub(super) model: usize,
    /// Width and height that it must fit into `[px]`.
    pub(super) size: (u32, u32),
    /// Whether the next one will follow at once.
    pub(super) is_moving: bool,
    pub(super) from: Viewpoint,
}

/// Where a picture is taken from.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Viewpoint {
    /// Anywhere, in the dataset's own coordinates.
    Free(Keyframe),
    /// The camera of a view.
    View(Split, usize),
}

/// Reads what was sent.
pub(super) fn read(body: &[u8], extent: &Extent) -> Result<Wanted, Answer> {
    let asked: Asked = serde_json::from_slice(body)
        .map_err(|error| Answer::refusal(400, format_args!("no picture is described: {error}")))?;
    check(asked, extent).map_err(|why| Answer::refusal(400, why))
}

fn check(asked: Asked, extent: &Extent) -> Result<Wanted, String> {
    let Asked { page, place, kind, model, width, height, moving, camera, view } = asked;
    let is_plain = |c: char| c.is_ascii_alphanumeric() || c == '-';
    if page.is_empty() || page.len() > MOST_NAME || !page.chars().all(is_plain) {
        return Err(format!("page must be 1 to {MOST_NAME} letters and digits"));
    }
    if place > 1 {
        return Err("place must be 0 or 1: a page shows two pictures at most".into());
    }
    let is_sound = |side: u32| (1..=MOST_SIDE).contains(&side);
    if !is_sound(width) || !is_sound(height) || u64::from(width) * u64::from(height) > MOST_PIXELS {
        return Err(format!(
            "{width}x{height} px cannot be shown: sides of 1 to {MOST_SIDE} px, and {MOST_PIXELS} pixels, are \
             the most; make the window smaller, or choose a lower resolution"
        ));
    }
    if model >= extent.models {
        return Err(format!("model must be below {}", extent.models));
    }
    let from = match (camera, view) {
        (Some(camera), None) => Viewpoint::Free(key(&camera, extent)?),
        (None, Some(AskedView { split, number })) => {
            let views = extent.views[split as usize];
            if number >= views {
                return Err(format!("there are {views} such views; number must be below that"));
            }
            Viewpoint::View(split, number)
        }
        _ => return Err("give either camera or view".into()),
    };
    if kind.needs_photograph() && matches!(from, Viewpoint::Free(_)) {
        return Err("there is a photograph only from the camera of a view".into());
    }
    if let Some((_, why)) = extent.lacking.iter().find(|(lacking, _)| *lacking == kind) {
        return Err(format!("this cannot be shown: {why}"));
    }
    let (size, is_moving) = ((width, height), moving);
    Ok(Wanted { owner: (page, place), kind, model, size, is_moving, from })
}

fn key(camera: &AskedCamera, extent: &Extent) -> Result<Keyframe, String> {
    let key = camera_path::parse_keyframe(&camera.camera_to_world, camera.fov)?;
    if !FIELDS.contains(&camera.fov) {
        let (least, most) = (FIELDS.start(), FIELDS.end());
        return Err(format!("fov is {}; {least} to {most} degrees can be shown", camera.fov));
    }
    let away = extent.normalisation.scene_from_world(key.centre).length();
    // What is not finite is not near either.
    if away <= FARTHEST { Ok(key) } else { Err("the camera is too far from the scene".into()) }
}

#[cfg(test)]
mod tests {
    use serde_json::{Value, json};

    use super::*;
    use densify_data::dataset::normalise::Normalisation;

    fn extent() -> Extent {
        let normalisation = Normalisation { centre: glam::DVec3::ZERO, scale: 0.5 };
        let lacking =
            vec![(Kind::Count, "on a GPU".to_owned()), (Kind::RowAge, "trains".to_owned())];
        Extent { models: 2, views: [3, 0], normalisation, lacking }
    }

    fn asked(changes: Value) -> Result<Wanted, String> {
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
        read(body.to_string().as_bytes(), &extent())
            .map_err(|no| format!("{} {}", no.status(), String::from_utf8_lossy(no.body())))
    }

    #[test]
    fn what_can_be_made_is_understood() {
        let wanted = asked(json!({ "moving": true, "model": 1, "place": 1 })).unwrap();
        assert_eq!((wanted.size, wanted.model, wanted.is_moving), ((640, 480), 1, true));
        assert_eq!(wanted.owner, ("a-1".to_owned(), 1));
        let Viewpoint::Free(key) = wanted.from else { panic!("{wanted:?}") };
        assert!((key.fov_y.to_degrees() - 50.0).abs() < 1e-9);
        let at_view = json!({ "camera": null, "view": { "split": "test", "number": 2 }, "kind": "difference" });
        let wanted = asked(at_view).unwrap();
        assert_eq!((wanted.from, wanted.kind), (Viewpoint::View(Split::Test, 2), Kind::Difference));
    }

    #[test]
    fn what_cannot_be_made_is_refused_with_the_reason() {
        let pose = |at: usize, value: f64| {
            let mut pose =
                [1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0];
            pose[at] = value;
            json!({ "camera": { "camera_to_world": pose, "fov": 50 } })
        };
        let view = |split: &str, number: i64| json!({ "camera": null, "view": { "split": split, "number": number } });
        for (changes, reason) in [
            (json!({ "width": 100_000 }), "100000x480 px"),
            (json!({ "width": 4096, "height": 4096 }), "4194304 pixels"),
            (json!({ "width": 0 }), "0x480 px"),
            (json!({ "width": -1 }), "no picture"),
            (json!({ "height": 1e300 }), "no picture"),
            (json!({ "page": "" }), "page"),
            (json!({ "page": "../../etc" }), "page"),
            (json!({ "page": "a".repeat(33) }), "page"),
            (json!({ "place": 2 }), "place"),
            (json!({ "model": 2 }), "model"),
            (json!({ "kind": "shadow" }), "no picture"),
            (json!({ "kind": "count" }), "GPU"),
            (json!({ "kind": "row_age" }), "trains"),
            (json!({ "path": "/etc/passwd" }), "unknown field"),
            (json!({ "camera": null }), "either"),
            (json!({ "view": { "split": "test", "number": 0 } }), "either"),
            (json!({ "kind": "photograph" }), "photograph"),
            (view("test", 3), "3 such views"),
            (view("train", 0), "0 such views"),
            (view("test", -1), "no picture"),
            (view("../test", 0), "no picture"),
            (pose(0, -1.0), "mirrors"),
            (pose(3, 1e30), "too far"),
            (pose(3, 1e308), "too far"),
            (json!({ "camera": { "camera_to_world": [1, 2], "fov": 50 } }), "2 numbers"),
            (json!({ "camera": { "camera_to_world": vec![1; 17], "fov": 50 } }), "17 numbers"),
            (json!({ "camera": { "camera_to_world": [1, "a"], "fov": 50 } }), "no picture"),
        ] {
            let refused = asked(changes.clone()).expect_err(&changes.to_string());
            assert!(
                refused.starts_with("400 ") && refused.contains(reason),
                "{changes}: {refused}"
            );
        }
        for fov in [0.0, 0.5, 171.0, 180.0, -1.0] {
            let mut changes = pose(0, 1.0);
            changes["camera"]["fov"] = fov.into();
            assert!(asked(changes).unwrap_err().contains("fov"), "{fov}");
        }
        for body in [&b""[..], b"{", b"[]", b"\xff", b"{\"width\": 1e999}", &[b'['; 4096]] {
            assert_eq!(read(body, &extent()).unwrap_err().status(), 400);
        }
    }
}
