//! Writes initial points and the traced mesh as binary PLY.

use std::fs::File;
use std::io::{BufWriter, Write};
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
/// the origin needs it. With each triangle goes whether it is of a thin structure. Written as it is
/// made: the file is larger than the mesh.
pub(super) fn write_mesh(path: &Path, scene: &Scene) -> Result<(), Error> {
    let count = scene.surface.len();
    let mut header =
        format!("ply\nformat binary_little_endian 1.0\nelement vertex {}\n", 3 * count);
    for name in ["x", "y", "z"] {
        header += &format!("property double {name}\n");
    }
    header += &format!("element face {count}\n");
    header += "property list uchar uint vertex_indices\nproperty uchar thin\nend_header\n";
    let write = || -> std::io::Result<()> {
        let mut out = BufWriter::new(File::create(path)?);
        out.write_all(header.as_bytes())?;
        for &triangle in &scene.model.triangles {
            for corner in triangle {
                let traced = scene.surface.traced(scene.model.positions[corner as usize]);
                for value in traced.to_array() {
                    out.write_all(&value.to_le_bytes())?;
                }
            }
        }
        for triangle in 0..count as u32 {
            out.write_all(&[3])?;
            for corner in 0..3 {
                out.write_all(&(3 * triangle + corner).to_le_bytes())?;
            }
            out.write_all(&[u8::from(scene.is_thin(triangle))])?;
        }
        out.flush()
    };
    write().map_err(Error::write(path))
}
