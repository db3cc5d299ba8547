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

/// The header of a mesh of `faces` triangles; `knows_thin` is whether each says if it is thin.
pub(crate) fn mesh_header(faces: u32, knows_thin: bool) -> String {
    let vertices = 3 * u64::from(faces);
    let thin = if knows_thin { "property uchar thin\n" } else { "" };
    format!(
        "ply\nformat binary_little_endian 1.0\nelement vertex {vertices}\nproperty double x\n\
         property double y\nproperty double z\nelement face {faces}\n\
         property list uchar uint vertex_indices\n{thin}end_header\n"
    )
}

/// The triangles as traced, in world coordinates, each with its own corners; f64, as a mesh far from
/// the origin needs it. With each triangle goes whether it is of a thin structure. Written as it is
/// made: the file is larger than the mesh.
pub(super) fn write_mesh(path: &Path, scene: &Scene) -> Result<(), Error> {
    // Numbers of corners are 32 bits wide.
    let count = scene.model.triangles.len() as u32;
    let write = || -> std::io::Result<()> {
        let mut out = BufWriter::new(File::create(path)?);
        out.write_all(mesh_header(count, true).as_bytes())?;
        for &triangle in &scene.model.triangles {
            for corner in triangle {
                let traced = scene.surface.traced(scene.model.positions[corner as usize]);
                for value in traced.to_array() {
                    out.write_all(&value.to_le_bytes())?;
                }
            }
        }
        for triangle in 0..count {
            out.write_all(&[3])?;
            for corner in 0..3 {
                out.write_all(&(3 * triangle + corner).to_le_bytes())?;
            }
            out.write_all(&[u8::from(scene.model.is_thin(triangle))])?;
        }
        out.flush()
    };
    write().map_err(Error::write(path))
}
