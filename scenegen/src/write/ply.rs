//! Initial points and the traced mesh as binary PLY.

use std::path::Path;

use super::write_file;
use crate::error::Error;
use crate::points::InitPoints;
use crate::scene::Scene;

/// Points with colours, and with the zero normals that the original 3DGS reader asks for.
pub(super) fn write_points(path: &Path, points: &InitPoints) -> Result<(), Error> {
    let mut header = format!(
        "ply\nformat binary_little_endian 1.0\nelement vertex {}\n",
        points.positions.len()
    );
    for name in ["x", "y", "z", "nx", "ny", "nz"] {
        header += &format!("property float {name}\n");
    }
    for name in ["red", "green", "blue"] {
        header += &format!("property uchar {name}\n");
    }
    let mut bytes = (header + "end_header\n").into_bytes();
    for (position, colour) in points.positions.iter().zip(&points.colours) {
        for value in position.as_vec3().to_array().into_iter().chain([0.0; 3]) {
            bytes.extend(value.to_le_bytes());
        }
        bytes.extend(colour);
    }
    write_file(path, &bytes)
}

/// The triangles as traced, in world coordinates, each with its own corners; f64, as a mesh far from
/// the origin needs it. With each triangle goes whether it is of a thin structure.
pub(super) fn write_mesh(path: &Path, scene: &Scene) -> Result<(), Error> {
    let triangles = scene.surface.triangles();
    let mut header =
        format!("ply\nformat binary_little_endian 1.0\nelement vertex {}\n", 3 * triangles.len());
    for name in ["x", "y", "z"] {
        header += &format!("property double {name}\n");
    }
    header += &format!("element face {}\n", triangles.len());
    header += "property list uchar uint vertex_indices\nproperty uchar thin\n";
    let mut bytes = (header + "end_header\n").into_bytes();
    for value in triangles.iter().flatten().flat_map(glam::DVec3::to_array) {
        bytes.extend(value.to_le_bytes());
    }
    for triangle in 0..triangles.len() as u32 {
        bytes.push(3);
        for corner in 0..3 {
            bytes.extend((3 * triangle + corner).to_le_bytes());
        }
        bytes.push(u8::from(scene.is_thin(triangle)));
    }
    write_file(path, &bytes)
}
