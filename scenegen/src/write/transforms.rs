//! Writes `transforms_train.json` and `transforms_test.json` for readers of NeRF-synthetic (paths without
//! extension), and `transforms.json` for nerfstudio (all views, full file names, depth).

use std::path::Path;

use serde_json::{Value, json};

use super::{mask_path, write_file};
use crate::camera::Camera;
use crate::error::Error;
use crate::lens::{Lens, LensKind};
use crate::scene::{Scene, Split, View};

const POINTS: &str = "points3d.ply";

pub(super) fn write(scene: &Scene, root: &Path) -> Result<(), Error> {
    let Some(first) = scene.views.first().map(|view| intrinsics(scene, &view.camera)) else {
        return Ok(());
    };
    for (name, value) in [
        ("transforms_train.json", synthetic(scene, &first, Split::Train)),
        ("transforms_test.json", synthetic(scene, &first, Split::Test)),
        ("transforms.json", nerfstudio(scene, &first)),
    ] {
        write_file(&root.join(name), format!("{value:#}").as_bytes())?;
    }
    Ok(())
}

/// The views of a split, with the intrinsics `first` at the top; each view lists only the intrinsics that differ.
fn synthetic(scene: &Scene, first: &Value, split: Split) -> Value {
    let frame = |(number, view): (usize, &View)| {
        let pose = scene.written_camera(number);
        let mut frame = frame_with_pose(&pose, format!("./images/{}", view.name));
        extend(&mut frame, &intrinsics(scene, &pose), |key, value| first[key] != *value);
        frame
    };
    let views = scene.views.iter().enumerate().filter(|(_, view)| view.split == split);
    let frames = views.map(frame);
    let mut top = json!({ "ply_file_path": POINTS, "frames": frames.collect::<Value>() });
    extend(&mut top, first, |_, _| true);
    top
}

/// All views. nerfstudio applies intrinsics at the top to all views, so they are written there only if all views
/// share them.
fn nerfstudio(scene: &Scene, first: &Value) -> Value {
    let shared =
        (0..scene.views.len()).all(|view| intrinsics(scene, &scene.written_camera(view)) == *first);
    let image = |view: &View| format!("images/{}.png", view.name);
    let frame = |(number, view): (usize, &View)| {
        let camera = scene.written_camera(number);
        let mut frame = frame_with_pose(&camera, image(view));
        frame["depth_file_path"] = json!(format!("depth/{}.npy", view.name));
        extend(&mut frame, &intrinsics(scene, &camera), |_, _| !shared);
        if scene.options.passers_by > 0.0 {
            frame["mask_path"] = json!(mask_path(&view.name));
        }
        frame
    };
    let mut top = json!({
        "camera_model": "OPENCV", "k1": 0.0, "k2": 0.0, "p1": 0.0, "p2": 0.0,
        "ply_file_path": POINTS,
        "frames": scene.views.iter().enumerate().map(frame).collect::<Value>(),
    });
    extend(&mut top, first, |_, _| shared);
    let files = |split: Split| -> Value {
        scene.views.iter().filter(|view| view.split == split).map(image).collect()
    };
    // Without these lists, nerfstudio chooses test views itself; an empty list would be an error.
    if scene.views.iter().any(|view| view.split == Split::Test) {
        for (key, split) in [("train", Split::Train), ("val", Split::Test), ("test", Split::Test)] {
            top[format!("{key}_filenames")] = files(split);
        }
    }
    top
}

fn frame_with_pose(pose: &Camera, file: String) -> Value {
    json!({ "file_path": file, "transform_matrix": world_from_opengl(pose) })
}

/// Copies the fields for which `wanted` is true.
fn extend(to: &mut Value, from: &Value, wanted: impl Fn(&str, &Value) -> bool) {
    for (key, value) in from.as_object().into_iter().flatten() {
        if wanted(key, value) {
            to[key] = value.clone();
        }
    }
}

/// The intrinsics of a camera, including lens parameters if any view has a lens, so that views without one do
/// not inherit them.
fn intrinsics(scene: &Scene, camera: &Camera) -> Value {
    let angle = |side: u32, focal: f64| 2.0 * (0.5 * f64::from(side) / focal).atan();
    let mut fields = json!({
        "camera_angle_x": angle(camera.width, camera.fx),
        "camera_angle_y": angle(camera.height, camera.fy),
        "w": camera.width,
        "h": camera.height,
        "fl_x": camera.fx,
        "fl_y": camera.fy,
        "cx": camera.cx,
        "cy": camera.cy,
    });
    if scene.options.lens.is_some() {
        let (model, k) = match camera.lens {
            Some(Lens { kind: LensKind::Fisheye, k }) => ("OPENCV_FISHEYE", k),
            Some(Lens { kind: LensKind::Radial, k }) => ("OPENCV", k),
            None => ("OPENCV", [0.0; 4]),
        };
        fields["camera_model"] = json!(model);
        for (name, k) in ["k1", "k2", "k3", "k4"].iter().zip(k) {
            fields[name] = json!(k);
        }
    }
    fields
}

/// The rows of the camera-to-world matrix with OpenGL axes: x right, y up, z backward.
fn world_from_opengl(camera: &Camera) -> [[f64; 4]; 4] {
    let m = camera.world_from_camera;
    let columns = [m.x_axis, -m.y_axis, -m.z_axis, camera.centre];
    let row = |i: usize| columns.map(|column| column[i]);
    [row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]]
}
