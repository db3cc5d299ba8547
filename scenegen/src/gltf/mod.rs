//! Loads glTF 2.0, as `.gltf` with files or data URIs and as `.glb`.
//!
//! The types of the `gltf` crate describe the JSON. Indices, offsets and counts are checked here, as the
//! crate's readers do not check them. Everything that places surfaces is applied or refused, except animations:
//! nodes stay where the file places them. Occlusion textures are ignored, as the tracer can compute occlusion.
//!
//! Errors that cannot change the result are ignored: those in alignments, in bounds of accessors, in targets of
//! buffer views, in names of attributes that are not read, in morph targets without weight, and in objects that the
//! scene does not use. `tests/malformed.tsv` lists the outcome for each test file of a validator.

mod accessors;
mod materials;
mod nodes;
mod primitives;

use std::collections::HashMap;
use std::fmt::Display;
use std::path::Path;

use gltf::json;
use serde_json::Value;

use crate::error::Error;
use crate::mesh::Model;
use crate::resource;
use accessors::Buffers;

/// Largest JSON part `[bytes]`. (serde_json limits the depth of its nesting to 128.)
const MAX_JSON: usize = 64 << 20;
/// Maximum number of nodes, meshes, accessors, buffers, images or materials.
const MAX_ITEMS: usize = 1_000_000;
/// The remedy for damaged files.
const REMEDY: &str = "correct the file or export it again";
/// Extensions that are applied.
const SUPPORTED: [&str; 7] = [
    nodes::INSTANCING,
    "KHR_lights_punctual",
    "KHR_materials_emissive_strength",
    "KHR_materials_unlit",
    "KHR_mesh_quantization",
    nodes::VISIBILITY,
    "KHR_texture_transform",
];

/// Unsupported extensions that place or add surfaces: refused even in files that use but do not require them.
/// (Compressed meshes are refused only if there is no uncompressed copy.)
const GEOMETRY: [&str; 4] =
    ["CESIUM_RTC", "CESIUM_z_up", "FRAUNHOFER_external_model", "NV_displacement_micromap"];

const DRACO: &str = "KHR_draco_mesh_compression";

/// Extensions that change the appearance of surfaces but not their geometry: files that require them are
/// rendered with their core materials, and a note lists them.
const APPEARANCE: [&str; 9] = [
    "KHR_materials_anisotropy",
    "KHR_materials_clearcoat",
    "KHR_materials_dispersion",
    "KHR_materials_ior",
    "KHR_materials_iridescence",
    "KHR_materials_sheen",
    "KHR_materials_specular",
    "KHR_materials_transmission",
    "KHR_materials_volume",
];

/// A file being read.
struct Reader<'a> {
    path: &'a Path,
    root: &'a json::Root,
    buffers: Buffers<'a>,
    /// The model's index of each of the file's materials; `None` is glTF's default material.
    materials: HashMap<Option<usize>, u32>,
    /// The model's textures, by image and colour space (true for sRGB).
    images: HashMap<(usize, bool), u32>,
    model: Model,
}

/// Loads the default scene of a file.
pub(crate) fn load(path: &Path) -> Result<Model, Error> {
    let bytes = resource::read(path)?;
    let (text, blob) = split(path, &bytes)?;
    let text = resource::without_bom(text).map_err(|problem| fault(path, "JSON", problem))?;
    if text.len() > MAX_JSON {
        return Err(fault(path, "JSON", "it is larger than 64 MiB"));
    }
    refuse_unsupported(path, text)?;
    let root = parse(path, text)?;
    for (kind, count) in [
        ("nodes", root.nodes.len()),
        ("meshes", root.meshes.len()),
        ("accessors", root.accessors.len()),
        ("buffers", root.buffers.len()),
        ("images", root.images.len()),
        ("materials", root.materials.len()),
    ] {
        if count > MAX_ITEMS {
            return Err(fault(path, kind, "there are more than a million"));
        }
    }
    let mut reader = Reader {
        path,
        root: &root,
        buffers: Buffers::new(path, &root, blob)?,
        materials: HashMap::new(),
        images: HashMap::new(),
        model: Model::default(),
    };
    reader.add_notes();
    reader.scene()?;
    reader.model.finish(path)
}

pub(super) fn fault(path: &Path, element: impl Display, problem: impl Display) -> Error {
    Error::malformed(path, element, problem, REMEDY)
}

/// Parses the JSON part. If the crate's types refuse it, it is rewritten in the form they expect, as glTF 2.0
/// allows integers written as 1.0 (2.7.1), `extras` of any type (3.2), and scenes without nodes (5.25).
fn parse(path: &Path, text: &[u8]) -> Result<json::Root, Error> {
    let error = match json::Root::from_slice(text) {
        Ok(root) => return Ok(root),
        Err(error) => fault(path, "JSON", error.to_string()),
    };
    let Ok(mut value) = serde_json::from_slice::<Value>(text) else {
        return Err(error);
    };
    normalise(&mut value);
    for scene in value.get_mut("scenes").and_then(Value::as_array_mut).into_iter().flatten() {
        if let Some(scene) = scene.as_object_mut() {
            scene.entry("nodes").or_insert_with(|| Value::Array(Vec::new()));
        }
    }
    // The value is written as text again, because a second deserialiser of the whole format would take long to compile.
    // The original error has the line and column.
    let rewritten = serde_json::to_vec(&value).unwrap_or_default();
    json::Root::from_slice(&rewritten).map_err(|_| error)
}

/// Removes `extras`, and writes whole numbers as integers.
fn normalise(value: &mut Value) {
    match value {
        Value::Array(list) => list.iter_mut().for_each(normalise),
        Value::Object(map) => {
            map.remove("extras");
            map.values_mut().for_each(normalise);
        }
        Value::Number(number) => {
            // Floats above 2^53 cannot represent every integer.
            let float = number.as_f64().filter(|v| v.fract() == 0.0 && (0.0..9e15).contains(v));
            if let Some(float) = float {
                *value = Value::from(float as u64);
            }
        }
        _ => {}
    }
}

/// The JSON and the binary chunk of a file; a plain JSON file has no binary chunk.
fn split<'a>(path: &Path, bytes: &'a [u8]) -> Result<(&'a [u8], Option<&'a [u8]>), Error> {
    if !bytes.starts_with(b"glTF") {
        return Ok((bytes, None));
    }
    let word = |at: usize| {
        let word = bytes.get(at..at + 4).and_then(|b| b.try_into().ok()).map(u32::from_le_bytes);
        word.ok_or_else(|| fault(path, "GLB header", "the file ends within it"))
    };
    if word(4)? != 2 {
        return Err(fault(path, "GLB header", format!("version {} is not 2", word(4)?)));
    }
    let length = word(8)? as usize;
    let Some(body) = bytes.get(12..length) else {
        let problem = format!("it says {length} bytes, the file has {}", bytes.len());
        return Err(fault(path, "GLB header", problem));
    };
    let (mut json, mut blob, mut at) = (None, None, 0);
    let mut first = true;
    while at < body.len() {
        let (size, kind) = (word(12 + at)? as usize, word(16 + at)?.to_le_bytes());
        let Some(data) = body.get(at + 8..).and_then(|rest| rest.get(..size)) else {
            return Err(fault(path, "GLB chunk", "it reaches beyond the end of the file"));
        };
        match &kind {
            b"JSON" if first => json = Some(data),
            b"BIN\0" if json.is_some() && blob.is_none() => blob = Some(data),
            _ if first => return Err(fault(path, "GLB chunk 0", "it is not JSON")),
            // The specification says to skip other chunks.
            _ => {}
        }
        first = false;
        at += 8 + size;
    }
    match json {
        Some(json) => Ok((json, blob)),
        None => Err(fault(path, "GLB", "there is no JSON chunk")),
    }
}

/// Refuses unsupported versions, unsupported extensions that the file requires, and any use of [`GEOMETRY`]. This
/// check comes first, because an unsupported feature may make a valid file look malformed.
fn refuse_unsupported(path: &Path, text: &[u8]) -> Result<(), Error> {
    #[derive(serde::Deserialize)]
    #[serde(rename_all = "camelCase")]
    struct Head {
        asset: Asset,
        #[serde(default)]
        extensions_required: Vec<String>,
        #[serde(default)]
        extensions_used: Vec<String>,
    }
    #[derive(serde::Deserialize)]
    struct Asset {
        version: String,
    }
    let head: Head =
        serde_json::from_slice(text).map_err(|e| fault(path, "JSON", e.to_string()))?;
    if head.asset.version.split('.').next() != Some("2") {
        let version: String = head.asset.version.chars().take(20).collect();
        let feature = format!("glTF version {version}");
        return Err(Error::unsupported(path, &feature, "export it as glTF 2.0"));
    }
    let known = |name: &str| SUPPORTED.contains(&name) || APPEARANCE.contains(&name);
    let unknown = head.extensions_required.iter().find(|name| !known(name));
    let mut used = head.extensions_used.iter();
    if let Some(name) = unknown.or_else(|| used.find(|name| GEOMETRY.contains(&name.as_str()))) {
        let shown = resource::shortened(name);
        let feature =
            format!("the extension {shown}, which the file requires or uses for its geometry,");
        return Err(Error::unsupported(path, &feature, remedy(name)));
    }
    Ok(())
}

/// The remedy for a file that needs an unsupported extension.
fn remedy(extension: &str) -> &'static str {
    match extension {
        DRACO => "export the mesh without Draco compression",
        "EXT_meshopt_compression" | "KHR_meshopt_compression" => {
            "export the mesh without meshopt compression"
        }
        "KHR_texture_basisu" | "EXT_texture_webp" | "EXT_texture_avif" => {
            "store its textures as PNG or JPEG"
        }
        _ => "export the file without it",
    }
}

impl Reader<'_> {
    fn fault(&self, element: impl Display, problem: impl Display) -> Error {
        fault(self.path, element, problem)
    }

    /// Notes the contents of the file that are ignored.
    fn add_notes(&mut self) {
        let ignored = self.root.extensions_used.iter();
        let ignored: Vec<_> = ignored.filter(|name| !SUPPORTED.contains(&name.as_str())).collect();
        let notes = &mut self.model.notes;
        if !ignored.is_empty() {
            let names = ignored.iter().map(|name| name.chars().take(40).collect::<String>());
            let names = names.take(10).collect::<Vec<_>>().join(", ");
            notes.push(format!("these extensions are ignored: {names}"));
        }
        if !self.root.animations.is_empty() {
            notes.push("animations are ignored: nodes are where the file places them".to_owned());
        }
    }
}

#[cfg(test)]
#[allow(clippy::float_cmp, clippy::print_stderr, reason = "exact values; tests say why they skip")]
mod tests;
