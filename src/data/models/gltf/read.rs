//! Reads glTF 2.0 with splats; every node that shows splats is placed as the scene says.

use std::collections::BTreeMap;
use std::io::Read;
use std::path::Path;

use serde::Deserialize;
use serde::de::IgnoredAny;
use serde_json::Value;

use super::accessors::{Accessor, Buffers, View};
use super::layout::{LOG_SCALE, OPACITY_LOGIT, SPLATS, coefficient};
use super::nodes;
use crate::error::LoadError;
use crate::models::ply::activation::may_be_logarithms;
use crate::models::quantise::{log_of_scale, quantised_logit};
use crate::models::rows::{Row, Rows, SplatFile};
use crate::models::statement::stated_in_json;
use crate::models::unpack::read_exactly;
use crate::models::{siblings, spz};
use densify_core::files::{max_unpacked_bytes, one_line};
use densify_core::gaussians::{MAX_SH_DEGREE, sh_coefficients, sigmoid};

/// The extension for splats in SPZ.
pub(super) const SPZ: &str = "KHR_gaussian_splatting_compression_spz_2";
/// Extensions that a file may require: those that are applied to splats, and those without effect on them.
const KNOWN: [&str; 5] =
    [SPLATS, SPZ, nodes::VISIBILITY, "KHR_materials_unlit", "KHR_mesh_quantization"];

/// The values that are read of properties of [`SPLATS`]; the names with a dot are those of drafts.
const READ: [(&str, &[&str]); 3] = [
    ("kernel", &["ellipse"]),
    ("colorSpace", &["srgb_rec709_display", "BT.709-sRGB", "BT.709"]),
    ("projection", &["perspective"]),
];

/// The only value of `sortingMethod` in [`SPLATS`], and the default. Splats are sorted by their depth, as in the
/// original renderer, which differs little.
const SORTED: &str = "cameraDistance";

/// The kinds of primitives, by their `mode`. Splats are points.
const MODES: [&str; 7] = [
    "points",
    "lines",
    "a line loop",
    "a line strip",
    "triangles",
    "a triangle strip",
    "a triangle fan",
];

/// Largest accepted opacity: 1 plus rounding errors.
const MAX_OPACITY: f32 = 1.001;

/// The parts of a document that splats need.
#[derive(Default, Deserialize)]
#[serde(rename_all = "camelCase", default)]
struct Document {
    extensions_required: Vec<String>,
    extensions_used: Vec<String>,
    animations: Vec<IgnoredAny>,
    buffers: Vec<BufferSource>,
    buffer_views: Vec<View>,
    accessors: Vec<Accessor>,
    meshes: Vec<Mesh>,
    nodes: Vec<nodes::Node>,
    scenes: Vec<Scene>,
    scene: Option<usize>,
    /// Data of the program that wrote the file; densify states the antialiasing there.
    extras: Value,
}

#[derive(Deserialize)]
struct BufferSource {
    uri: Option<String>,
}

#[derive(Deserialize)]
struct Mesh {
    primitives: Vec<Primitive>,
}

#[derive(Deserialize)]
struct Primitive {
    attributes: BTreeMap<String, usize>,
    mode: Option<u64>,
    indices: Option<IgnoredAny>,
    #[serde(default)]
    extensions: BTreeMap<String, Value>,
}

#[derive(Deserialize)]
struct Scene {
    #[serde(default)]
    nodes: Vec<usize>,
}

/// Reads a `.glb` of `length` bytes.
///
/// # Errors
/// When the file is unreadable or contradicts itself, requires an unsupported extension, or holds no splats.
pub(super) fn read_binary(
    path: &Path,
    mut input: impl Read,
    length: u64,
) -> Result<SplatFile, LoadError> {
    let mut words = |field: &str, count: u64| {
        let bytes = read_exactly(path, field, &mut input, 4 * count)?;
        Ok::<Vec<u32>, LoadError>(
            bytes.as_chunks().0.iter().map(|&word| u32::from_le_bytes(word)).collect(),
        )
    };
    let header = words("header", 5)?;
    if header[1] != 2 || header[4] != u32::from_le_bytes(*b"JSON") {
        let problem = "it is not glTF 2.0 whose first chunk is JSON";
        return Err(LoadError::damaged(path, "header", problem));
    }
    let text = read_exactly(path, "JSON", &mut input, u64::from(header[3]))?;
    let text = String::from_utf8_lossy(&text).into_owned();
    let mut start = Vec::new();
    (&mut input).take(8).read_to_end(&mut start).map_err(LoadError::io(path))?;
    let binary_chunk = match start[..] {
        [a, b, c, d, b'B', b'I', b'N', 0] => {
            let bytes = u64::from(u32::from_le_bytes([a, b, c, d]));
            Some(read_exactly(path, "BIN", &mut input, bytes)?)
        }
        _ => None,
    };
    read(path, &text, binary_chunk, length)
}

/// Reads a `.gltf`.
///
/// # Errors
/// As [`read_binary`].
pub(super) fn read_text(path: &Path, text: &str) -> Result<SplatFile, LoadError> {
    read(path, text, None, text.len() as u64)
}

fn read(
    path: &Path,
    text: &str,
    mut binary_chunk: Option<Vec<u8>>,
    length: u64,
) -> Result<SplatFile, LoadError> {
    let document: Document =
        serde_json::from_str(text).map_err(|error| LoadError::damaged(path, "JSON", error))?;
    let is_unknown = |name: &&String| !KNOWN.contains(&name.as_str());
    if let Some(name) = document.extensions_required.iter().find(is_unknown) {
        let problem = format!("it requires {name}, which densify does not read");
        return Err(LoadError::damaged(path, "extensionsRequired", problem));
    }
    let mut total = length;
    let mut contents = Vec::new();
    for (index, BufferSource { uri }) in document.buffers.iter().enumerate() {
        let bytes = match uri {
            None => binary_chunk.take().filter(|_| index == 0).unwrap_or_default(),
            Some(uri) => buffer(path, uri)?,
        };
        total += bytes.len() as u64;
        contents.push(bytes);
    }
    let buffers = Buffers {
        path,
        accessors: &document.accessors,
        views: &document.buffer_views,
        buffers: contents,
    };
    let mut whole = SplatFile { notes: notes(&document), ..SplatFile::default() };
    let (mut primitives, mut is_any_hidden) = (0, false);
    let scene = document.scenes.get(document.scene.unwrap_or(0));
    if let (None, Some(number)) = (scene, document.scene) {
        return Err(LoadError::damaged(path, "scene", format!("there is no scene {number}")));
    }
    let roots = scene.map(|scene| scene.nodes.as_slice());
    for placed in nodes::placed_meshes(path, &document.nodes, roots)? {
        let no_mesh = || LoadError::damaged(path, "nodes", "there is no such mesh");
        for primitive in &document.meshes.get(placed.mesh).ok_or_else(no_mesh)?.primitives {
            let Some(extension) = primitive.extensions.get(SPLATS) else { continue };
            if placed.is_hidden {
                is_any_hidden = true;
                continue;
            }
            primitives += 1;
            let transform = placed.transform(path)?;
            let mut part = splats(&buffers, primitive, extension)?;
            transform.apply(&mut part.gaussians);
            join(path, &mut whole, part)?;
            // Many nodes may show the same data, which could exhaust the memory.
            let bytes =
                4 * (11 + whole.gaussians.sh.len() as u64 + 11 * whole.gaussians.len() as u64);
            if bytes > max_unpacked_bytes(total) {
                let problem = "they show more splats than a file of this size can hold";
                return Err(LoadError::damaged(path, "nodes", problem));
            }
        }
    }
    if primitives == 0 && is_any_hidden {
        let problem = format!("all splats are hidden ({})", nodes::VISIBILITY);
        let remedy = "show the nodes to be read, and export the file again";
        return Err(LoadError::malformed(path, "nodes", problem, remedy));
    }
    if primitives == 0 {
        return Err(LoadError::Data(format!(
            "{} holds no Gaussian splats ({SPLATS}); a mesh is rendered by `densify scenegen`",
            path.display()
        )));
    }
    if is_any_hidden {
        whole.notes.push(format!("hidden nodes ({}) are left out", nodes::VISIBILITY));
    }
    if let Some(stated) = stated_in_json(path, "extras", &document.extras)? {
        whole.gaussians.antialiasing = stated;
    }
    Ok(whole)
}

/// Notes on what the file has besides splats and is ignored.
fn notes(document: &Document) -> Vec<String> {
    let ignored = document.extensions_used.iter().filter(|name| !KNOWN.contains(&name.as_str()));
    let names: Vec<String> = ignored.take(10).map(|name| shortened(name)).collect();
    let mut notes = Vec::new();
    if !names.is_empty() {
        notes.push(format!("these extensions are ignored: {}", names.join(", ")));
    }
    if !document.animations.is_empty() {
        notes.push("animations are ignored: nodes are where the file places them".to_owned());
    }
    notes
}

/// Text of the file, shortened for a message.
fn shortened(text: &str) -> String {
    one_line(&text.chars().take(60).collect::<String>())
}

/// The bytes of a buffer outside the binary chunk.
fn buffer(path: &Path, uri: &str) -> Result<Vec<u8>, LoadError> {
    if uri.starts_with("data:") {
        return densify_scenegen::data_uri(uri)
            .ok_or_else(|| LoadError::damaged(path, "buffers", "data that is not base64"));
    }
    let mut bytes = Vec::new();
    let mut file = siblings::open(path, "buffers", uri)?;
    file.read_to_end(&mut bytes).map_err(LoadError::io(path))?;
    Ok(bytes)
}

/// The splats of a primitive, before the transform of its node.
fn splats(
    buffers: &Buffers<'_>,
    primitive: &Primitive,
    extension: &Value,
) -> Result<SplatFile, LoadError> {
    let path = buffers.path;
    for (key, known) in READ {
        if let Some(stated) = extension.get(key)
            && !stated.as_str().is_some_and(|stated| known.contains(&stated))
        {
            let stated = shortened(&stated.to_string());
            let problem = format!("{stated} is not supported, only {}", known.join(", "));
            return Err(LoadError::damaged(path, format!("{SPLATS}: {key}"), problem));
        }
    }
    check_points(path, primitive)?;
    let other_order = extension.get("sortingMethod").filter(|stated| *stated != SORTED);
    let other_order = other_order.map(|stated| {
        let stated = shortened(&stated.to_string());
        format!("sortingMethod {stated} is ignored: splats are sorted by their depth")
    });
    if let Some(view) = extension.pointer(&format!("/extensions/{SPZ}/bufferView")) {
        let view = view.as_u64().and_then(|view| usize::try_from(view).ok());
        let bytes = buffers.view(view.unwrap_or(usize::MAX))?;
        let (mut file, axes) = spz::read::read_as_stored(path, bytes, bytes.len() as u64)?;
        let ignored =
            axes.map(|axes| format!("its SPZ states the axes {axes}, which glTF overrides"));
        file.notes.extend(ignored.into_iter().chain(other_order));
        return Ok(file);
    }
    let attribute = |name: &str, width: usize| match primitive.attributes.get(name) {
        None => Ok(None),
        Some(&accessor) => buffers.numbers(name, accessor, width).map(Some),
    };
    let missing =
        |name: &str| LoadError::damaged(path, "attributes", format!("there is no {name}"));
    let needed = |name: &str, width: usize| {
        let name = if name == "POSITION" { name.to_owned() } else { format!("{SPLATS}:{name}") };
        attribute(&name, width)?.ok_or_else(|| missing(&name))
    };
    let (means, quats) = (needed("POSITION", 3)?, needed("ROTATION", 4)?);
    let (scales, opacities) = (needed("SCALE", 3)?, needed("OPACITY", 1)?);
    let (log_scales, logits) = (attribute(LOG_SCALE, 3)?, attribute(OPACITY_LOGIT, 1)?);
    let has = |degree: &u8| primitive.attributes.contains_key(&coefficient(*degree, 0));
    let sh_degree = (0..=MAX_SH_DEGREE).take_while(|degree| *degree == 0 || has(degree)).last();
    let sh_degree = sh_degree.unwrap_or(0);
    check_colours(path, primitive, sh_degree)?;
    let mut bands = Vec::new();
    for degree in 0..=sh_degree {
        for n in 0..=2 * degree {
            let name = coefficient(degree, n);
            bands.push(attribute(&name, 3)?.ok_or_else(|| missing(&name))?);
        }
    }
    let count = opacities.len();
    let others = [&means, &scales].into_iter().chain(&bands).chain(&log_scales);
    if quats.len() != 4 * count
        || logits.as_ref().is_some_and(|logits| logits.len() != count)
        || others.into_iter().any(|values| values.len() != 3 * count)
    {
        return Err(LoadError::damaged(path, "attributes", "they have different counts"));
    }
    // Many exporters copy the numbers of a splat PLY.
    for (name, values, max, cause) in [
        ("SCALE", &scales, f32::INFINITY, "a logarithm; glTF stores scales"),
        ("OPACITY", &opacities, MAX_OPACITY, "a logit; glTF stores opacities"),
    ] {
        if let Some(value) = values.iter().find(|value| **value < 0.0 || **value > max) {
            let problem = format!("{value} looks like {cause} as they are");
            return Err(LoadError::damaged(path, format!("{SPLATS}:{name}"), problem));
        }
    }
    let mut rows = Rows::new(sh_degree);
    let mut sh = Vec::with_capacity(3 * sh_coefficients(sh_degree));
    for row in 0..count {
        let three = |values: &[f32]| [values[3 * row], values[3 * row + 1], values[3 * row + 2]];
        sh.clear();
        sh.extend(bands.iter().flat_map(|band| three(band)));
        let (scale, opacity) = (three(&scales), opacities[row]);
        // If another program has changed the standard's attributes, densify's own attributes are stale.
        let log_scale = log_scales.as_ref().map(|logs| three(logs));
        let logit = logits.as_ref().map(|logits| logits[row]);
        let logit = logit.filter(|&logit| sigmoid(logit).to_bits() == opacity.to_bits());
        let fits = |log: &[f32; 3]| log.map(|x| x.exp().to_bits()) == scale.map(f32::to_bits);
        rows.push(Row {
            mean: three(&means),
            log_scale: log_scale.filter(fits).unwrap_or_else(|| scale.map(log_of_scale)),
            quat: [quats[4 * row + 3], quats[4 * row], quats[4 * row + 1], quats[4 * row + 2]],
            opacity_logit: logit.unwrap_or_else(|| quantised_logit(opacity)),
            sh: &sh,
        });
    }
    let mut file = rows.finish(path)?;
    file.notes.extend(other_order);
    if log_scales.is_none() && may_be_logarithms(&file.gaussians, scales.as_chunks().0) {
        file.notes.push(
            "its scales may be logarithms, although glTF stores scales as they are: if all Gaussians are too large or too \
             small, export the file again"
                .to_owned(),
        );
    }
    Ok(file)
}

/// Refuses a primitive that is not points, and one that shows only some of its vertices.
fn check_points(path: &Path, primitive: &Primitive) -> Result<(), LoadError> {
    let fail = |field: &str, problem: String| {
        Err(LoadError::damaged(path, format!("meshes: primitives: {field}"), problem))
    };
    if let Some(mode) = primitive.mode.filter(|&mode| mode != 0) {
        let kind = usize::try_from(mode).ok().and_then(|mode| MODES.get(mode));
        let kind = kind.unwrap_or(&"unknown");
        return fail("mode", format!("{mode} is {kind}, but splats ({SPLATS}) are points, mode 0"));
    }
    if primitive.indices.is_some() {
        return fail("indices", "densify reads splats in the order of their attributes".to_owned());
    }
    Ok(())
}

/// Refuses coefficients of spherical harmonics beyond `sh_degree`, the degree that is read.
fn check_colours(path: &Path, primitive: &Primitive, sh_degree: u8) -> Result<(), LoadError> {
    let start = format!("{SPLATS}:SH_DEGREE_");
    let read: Vec<String> = (0..=sh_degree)
        .flat_map(|degree| (0..=2 * degree).map(move |n| coefficient(degree, n)))
        .collect();
    let is_unread = |name: &&String| name.starts_with(&start) && !read.contains(name);
    let Some(name) = primitive.attributes.keys().find(is_unread) else { return Ok(()) };
    let degree = name[start.len()..].split('_').next().and_then(|text| text.parse::<u64>().ok());
    let problem = match degree {
        Some(degree) if degree > u64::from(MAX_SH_DEGREE) => {
            format!("colours have degree {degree}, but densify reads 0 to {MAX_SH_DEGREE}")
        }
        _ => {
            "it is no coefficient, or others of its degree or of a lower one are missing".to_owned()
        }
    };
    Err(LoadError::damaged(path, shortened(name), problem))
}

/// Appends a part; the result has the higher of the two degrees.
///
/// # Errors
/// When the parts state different antialiasing, as SPZ inside glTF may.
fn join(path: &Path, whole: &mut SplatFile, part: SplatFile) -> Result<(), LoadError> {
    let is_first = whole.gaussians.is_empty();
    if is_first {
        whole.gaussians.antialiasing = part.gaussians.antialiasing;
    }
    if whole.gaussians.antialiasing != part.gaussians.antialiasing {
        let problem = "only some of them were trained with antialiasing";
        return Err(LoadError::damaged(path, "meshes", problem));
    }
    let degree = whole.gaussians.sh_degree.max(part.gaussians.sh_degree);
    let more = part.gaussians.with_degree(degree);
    whole.gaussians = std::mem::take(&mut whole.gaussians).with_degree(degree);
    whole.gaussians.append(more);
    whole.dropped += part.dropped;
    whole.repaired += part.repaired;
    // Many parts may have the same note.
    let is_new = |note: &String| !whole.notes.contains(note);
    let notes: Vec<String> = part.notes.into_iter().filter(is_new).collect();
    whole.notes.extend(notes);
    Ok(())
}
