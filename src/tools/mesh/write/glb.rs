//! Binary glTF 2.0. Vertex colours are linear there, and the material is unlit, so that a viewer shows the colours of
//! the views. Positions are relative to the node's translation where f32 is too coarse for the dataset's coordinates.

use std::io::{self, Write};

use densify_scenegen::texture::linear_from_srgb;
use glam::DVec3;
use serde_json::json;

use super::{Mesh, needs_doubles, write_words};

pub(super) fn write(mesh: &Mesh, out: &mut dyn Write) -> io::Result<()> {
    let (vertices, triangles) = (mesh.positions.len(), mesh.triangles.len());
    let [positions, colours, indices] = [12 * vertices, 8 * vertices, 12 * triangles];
    let data = positions + colours + indices;
    if data as u64 > u64::from(u32::MAX - (1 << 16)) {
        return Err(io::Error::other("a GLB has at most 4 GiB; choose PLY or larger voxels"));
    }
    let offset = if needs_doubles(mesh) { mesh.origin.round() } else { DVec3::ZERO };
    let place = |vertex: usize| (mesh.place_of(vertex) - offset).as_vec3();
    let bound = |choose: fn(f32, f32) -> f32, start: f32| {
        (0..vertices)
            .map(place)
            .fold([start; 3], |found, at| std::array::from_fn(|axis| choose(found[axis], at[axis])))
    };
    let mut node = json!({"mesh": 0});
    if offset != DVec3::ZERO {
        node["translation"] = json!(offset.to_array());
    }
    let document = json!({
        "asset": {"version": "2.0", "generator": format!("densify {}", env!("CARGO_PKG_VERSION"))},
        "extensionsUsed": ["KHR_materials_unlit"],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [node],
        "meshes": [{"primitives": [{
            "attributes": {"POSITION": 0, "COLOR_0": 1}, "indices": 2, "material": 0,
        }]}],
        "materials": [{"doubleSided": true, "extensions": {"KHR_materials_unlit": {}}}],
        "buffers": [{"byteLength": data}],
        "bufferViews": [
            {"buffer": 0, "byteOffset": 0, "byteLength": positions, "target": 34_962},
            {"buffer": 0, "byteOffset": positions, "byteLength": colours, "byteStride": 8, "target": 34_962},
            {"buffer": 0, "byteOffset": positions + colours, "byteLength": indices, "target": 34_963},
        ],
        "accessors": [
            {
                "bufferView": 0, "componentType": 5126, "count": vertices, "type": "VEC3",
                "min": bound(f32::min, f32::INFINITY), "max": bound(f32::max, f32::NEG_INFINITY),
            },
            {
                "bufferView": 1, "componentType": 5123, "normalized": true, "count": vertices, "type": "VEC4",
            },
            {"bufferView": 2, "componentType": 5125, "count": 3 * triangles, "type": "SCALAR"},
        ],
    });
    let mut text = document.to_string().into_bytes();
    text.resize(text.len().next_multiple_of(4), b' ');
    let word = |number: usize| (number as u32).to_le_bytes();
    out.write_all(b"glTF")?;
    out.write_all(&[word(2), word(12 + 8 + text.len() + 8 + data)].concat())?;
    out.write_all(&[word(text.len()), *b"JSON"].concat())?;
    out.write_all(&text)?;
    out.write_all(&[word(data), *b"BIN\0"].concat())?;
    for vertex in 0..vertices {
        write_words(out, place(vertex).to_array().map(f32::to_le_bytes))?;
    }
    for &[r, g, b] in &mesh.colours {
        let linear =
            |value: u8| (linear_from_srgb(f64::from(value) / 255.0) * 65535.0).round() as u16;
        write_words(out, [linear(r), linear(g), linear(b), u16::MAX].map(u16::to_le_bytes))?;
    }
    write_words(out, mesh.triangles.as_flattened().iter().map(|index| index.to_le_bytes()))
}
