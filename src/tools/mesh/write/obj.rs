//! Wavefront OBJ with the common extension for vertex colours, `v x y z r g b`.

use std::io::{self, Write};

use super::Mesh;

pub(super) fn write(mesh: &Mesh, out: &mut dyn Write) -> io::Result<()> {
    // A thousandth of a voxel.
    let digits = (3.0 - mesh.scale.log10()).ceil().clamp(0.0, 300.0) as usize;
    for (vertex, colour) in mesh.colours.iter().enumerate() {
        let place = mesh.place_of(vertex);
        let [r, g, b] = colour.map(|value| f64::from(value) / 255.0);
        let (x, y, z) = (place.x, place.y, place.z);
        writeln!(out, "v {x:.digits$} {y:.digits$} {z:.digits$} {r:.4} {g:.4} {b:.4}")?;
    }
    for [a, b, c] in &mesh.triangles {
        let (a, b, c) = (u64::from(*a) + 1, u64::from(*b) + 1, u64::from(*c) + 1);
        writeln!(out, "f {a} {b} {c}")?;
    }
    Ok(())
}
