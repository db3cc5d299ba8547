//! Writes `cameras.json` in the format of the original trainer and its viewers.

use serde::Serialize;

use densify_core::camera::Camera;

/// One camera, in the coordinates of the saved model.
#[derive(Debug, Serialize)]
struct CameraRecord<'a> {
    id: usize,
    img_name: &'a str,
    width: u32,
    height: u32,
    /// The camera's centre.
    position: [f64; 3],
    /// The rows of the matrix `world_from_camera`, whose columns are the camera's axes (x right, y down, z forward).
    rotation: [[f64; 3]; 3],
    fy: f64,
    fx: f64,
}

/// JSON of cameras with the names of their images, numbered in order. The cameras are in the coordinates of the saved
/// model.
pub fn cameras_json<'a>(
    cameras: impl IntoIterator<Item = (&'a str, Camera)>,
) -> serde_json::Result<String> {
    let records: Vec<_> = cameras
        .into_iter()
        .enumerate()
        .map(|(id, (img_name, camera))| {
            let world_from_camera = camera.rotation.transpose();
            CameraRecord {
                id,
                img_name,
                width: camera.width,
                height: camera.height,
                position: camera.centre().to_array(),
                rotation: [0, 1, 2].map(|i| world_from_camera.row(i).to_array()),
                fy: camera.fy,
                fx: camera.fx,
            }
        })
        .collect();
    serde_json::to_string(&records)
}

#[cfg(test)]
mod tests {
    use glam::{DMat3, DVec3};

    use super::*;

    #[test]
    fn rotation_is_world_from_camera_and_position_is_in_the_world() {
        // Turned by 90° about z: the camera's x axis is the world's −y.
        let rotation = DMat3::from_cols(DVec3::Y, DVec3::NEG_X, DVec3::Z);
        let centre = DVec3::new(1.0, 2.0, 3.0);
        let camera = Camera::centred((4, 3), (5.0, 6.0), rotation, centre);
        let json = cameras_json([("a/b.png", camera), ("c.png", camera)]);
        let json: serde_json::Value = serde_json::from_str(&json.unwrap()).unwrap();
        let first = &json[0];
        assert_eq!(first["position"], serde_json::json!([1.0, 2.0, 3.0]));
        let expected = serde_json::json!([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]);
        assert_eq!(first["rotation"], expected);
        assert_eq!(json[1]["id"], 1);
        assert_eq!(json[1]["img_name"], "c.png");
        assert_eq!((&first["fx"], &first["fy"]), (&5.0.into(), &6.0.into()));
    }
}
