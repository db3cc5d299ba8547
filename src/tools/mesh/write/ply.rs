//! Binary little-endian PLY with coordinates in f32, or in f64 where f32 is too coarse.

use std::io::{self, Write};

use super::{Mesh, needs_doubles, write_words};

pub(super) fn write(mesh: &Mesh, out: &mut dyn Write) -> io::Result<()> {
    let is_double = needs_doubles(mesh);
    let kind = if is_double { "double" } else { "float" };
    write!(
        out,
        "ply\nformat binary_little_endian 1.0\nelement vertex {}\nproperty {kind} x\nproperty {kind} y\n\
         property {kind} z\nproperty uchar red\nproperty uchar green\nproperty uchar blue\nelement face {}\n\
         property list uchar uint vertex_indices\nend_header\n",
        mesh.positions.len(),
        mesh.triangles.len()
    )?;
    for (vertex, colour) in mesh.colours.iter().enumerate() {
        let place = mesh.place_of(vertex);
        match is_double {
            true => write_words(out, place.to_array().map(f64::to_le_bytes))?,
            false => write_words(out, place.as_vec3().to_array().map(f32::to_le_bytes))?,
        }
        out.write_all(colour)?;
    }
    for triangle in &mesh.triangles {
        out.write_all(&[3])?;
        write_words(out, triangle.map(u32::to_le_bytes))?;
    }
    Ok(())
}
