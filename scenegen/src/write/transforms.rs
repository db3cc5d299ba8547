//! Writes `transforms_train.json` and `transforms_test.json`: the fields of NeRF-synthetic
//! (`camera_angle_x`, paths without ending) and those of nerfstudio (`fl_x` … `ply_file_path`).

use std::path::Path;

use serde_json::{Value, json};

use super::write_file;
use crate::camera::Camera;
use crate::error::Error;
use crate::scene::{Scene, Split};

pub(super) fn write(scene: &Scene, root: &Path, split: Split) -> Result<(), Error> {
    let name = match split {
        Split::Train => "transforms_train.json",
        Split::Test => "transforms_test.json",
    };
    let views: Vec<_> = scene.views.iter().filter(|view| view.split == split).collect();
    let Some(first) = views.first().or(scene.views.first().as_ref()).map(|view| view.camera) else {
        return Ok(());
    };
    let mut top = intrinsics(&first);
    top["camera_model"] = json!("OPENCV");
    for term in ["k1", "k2", "p1", "p2"] {
        top[term] = json!(0.0);
    }
    top["ply_file_path"] = json!("points3d.ply");
    let frames = views.iter().map(|view| {
        let mut frame = json!({
            "file_path": format!("./images/{}", view.name),
            "transform_matrix": world_from_opengl(&view.camera),
        });
        // File cameras differ in their field of view.
        if (view.camera.fx - first.fx).abs() > 0.0 {
            for (key, value) in intrinsics(&view.camera).as_object().into_iter().flatten() {
                frame[key] = value.clone();
            }
        }
        frame
    });
    top["frames"] = frames.collect();
    write_file(&root.join(name), format!("{top:#}").as_bytes())
}

fn intrinsics(camera: &Camera) -> Value {
    let angle = |side: u32, focal: f64| 2.0 * (0.5 * f64::from(side) / focal).atan();
    json!({
        "camera_angle_x": angle(camera.width, camera.fx),
        "camera_angle_y": angle(camera.height, camera.fy),
        "w": camera.width,
        "h": camera.height,
        "fl_x": camera.fx,
        "fl_y": camera.fy,
        "cx": camera.cx,
        "cy": camera.cy,
    })
}

/// Camera to world with OpenGL axes: x right, y up, z backward. Rows.
fn world_from_opengl(camera: &Camera) -> [[f64; 4]; 4] {
    let m = camera.world_from_camera;
    let columns = [m.x_axis, -m.y_axis, -m.z_axis, camera.centre];
    let row = |i: usize| columns.map(|column| column[i]);
    [row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]]
}
