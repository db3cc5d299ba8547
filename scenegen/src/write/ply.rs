//! Writes initial points and the traced mesh as binary PLY.

use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::Path;

use super::write_file;
use crate::error::Error;
use crate::points::InitPoints;
use crate::scene::Scene;

/// Writes points with colours, and with zero normals, which the original 3DGS reader needs.
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

/// The header of a mesh of `faces` triangles, with or without flags that mark thin ones.
pub(crate) fn mesh_header(faces: u32, has_flags: bool) -> String {
    let vertices = 3 * u64::from(faces);
    let thin = if has_flags { "property uchar thin\n" } else { "" };
    format!(
        "ply\nformat binary_little_endian 1.0\nelement vertex {vertices}\nproperty double x\n\
         property double y\nproperty double z\nelement face {faces}\n\
         property list uchar uint vertex_indices\n{thin}end_header\n"
    )
}

/// Writes the triangles as traced, in world coordinates, each with its own corners and a flag for thin
/// structures. Corners are f64, which meshes far from the origin need. The file is streamed, because it is larger
/// than the mesh in memory.
pub(super) fn write_mesh(path: &Path, scene: &Scene) -> Result<(), Error> {
    // Indices in the model and in the file have 32 bits.
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
