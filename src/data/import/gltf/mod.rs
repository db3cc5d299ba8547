//! Reads glTF 2.0 with `KHR_gaussian_splatting` (Khronos, ratified): `.glb`, and `.gltf` with its buffers inside or
//! beside it.
//!
//! Every node that shows splats is placed as the scene says. glTF has y up; the other formats have what the dataset
//! has, mostly y down. As splat-transform does, a half turn about z leads from one to the other.

mod accessors;
mod nodes;

use std::collections::BTreeMap;
use std::io::Read;
use std::path::Path;

use serde::Deserialize;
use serde_json::Value;

use super::model::{Row, Rows, log_of_scale, malformed, quantised_logit};
use super::{SplatFile, beside, spz, unfold};
use crate::dataset::DatasetError;
pub(crate) use accessors::SHAPES;
use accessors::{Accessor, Buffers, View};
use base64::Engine as _;
use base64::alphabet::STANDARD;
use base64::engine::{DecodePaddingMode, GeneralPurpose, GeneralPurposeConfig};
use densify_core::files::most_unpacked;
use densify_core::gaussians::{Gaussians, MAX_SH_DEGREE, sh_coefficients, sigmoid};
pub(crate) use nodes::TURN;

/// Base64 (RFC 4648, section 4), with or without padding.
const BASE64: GeneralPurpose = GeneralPurpose::new(
    &STANDARD,
    GeneralPurposeConfig::new().with_decode_padding_mode(DecodePaddingMode::Indifferent),
);

/// Most bytes of a file that is text, with its buffers inside.
pub(super) const MAX_JSON: u64 = 1 << 30;
/// The extension.
pub(crate) const SPLATS: &str = "KHR_gaussian_splatting";
/// The same with the data as SPZ.
const SPZ: &str = "KHR_gaussian_splatting_compression_spz_2";
/// Extensions that a file may require: these, and those that do not matter to splats.
const KNOWN: [&str; 4] = [SPLATS, SPZ, "KHR_materials_unlit", "KHR_mesh_quantization"];
/// The parameters themselves, which ours have beside the standard's: scales and opacities cannot be inverted to
/// the last bit.
pub(crate) const LOG_SCALE: &str = "_LOG_SCALE";
/// As [`LOG_SCALE`].
pub(crate) const OPACITY_LOGIT: &str = "_OPACITY_LOGIT";

/// A document; what splats do not need is ignored.
#[derive(Deserialize)]
#[serde(rename_all = "camelCase", default)]
#[derive(Default)]
struct Document {
    extensions_required: Vec<String>,
    buffers: Vec<BufferSource>,
    buffer_views: Vec<View>,
    accessors: Vec<Accessor>,
    meshes: Vec<Mesh>,
    nodes: Vec<nodes::Node>,
    scenes: Vec<Scene>,
    scene: usize,
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
/// When the file is unreadable or contradicts itself, requires what is not supported, or holds no splats.
pub(super) fn read_binary(
    path: &Path,
    mut input: impl Read,
    length: u64,
) -> Result<SplatFile, DatasetError> {
    let mut words = |field: &str, count: u64| {
        let bytes = unfold::exactly(path, field, &mut input, 4 * count)?;
        Ok::<Vec<u32>, DatasetError>(
            bytes.as_chunks().0.iter().map(|&word| u32::from_le_bytes(word)).collect(),
        )
    };
    let header = words("header", 5)?;
    if header[1] != 2 || header[4] != u32::from_le_bytes(*b"JSON") {
        return Err(malformed(path, "header", "it is no glTF 2.0 that begins with its JSON"));
    }
    let text = unfold::exactly(path, "JSON", &mut input, u64::from(header[3]))?;
    let text = String::from_utf8_lossy(&text).into_owned();
    let mut start = Vec::new();
    (&mut input).take(8).read_to_end(&mut start).map_err(DatasetError::io(path))?;
    let inside = match start[..] {
        [a, b, c, d, b'B', b'I', b'N', 0] => {
            let bytes = u64::from(u32::from_le_bytes([a, b, c, d]));
            Some(unfold::exactly(path, "BIN", &mut input, bytes)?)
        }
        _ => None,
    };
    read(path, &text, inside, length)
}

/// Reads a `.gltf`.
///
/// # Errors
/// As [`read_binary`].
pub(super) fn read_text(path: &Path, text: &str) -> Result<SplatFile, DatasetError> {
    read(path, text, None, text.len() as u64)
}

fn read(
    path: &Path,
    text: &str,
    mut inside: Option<Vec<u8>>,
    length: u64,
) -> Result<SplatFile, DatasetError> {
    let document: Document =
        serde_json::from_str(text).map_err(|error| malformed(path, "JSON", error))?;
    let known = |name: &&String| !KNOWN.contains(&name.as_str());
    if let Some(name) = document.extensions_required.iter().find(known) {
        let problem = format!("it requires {name}, which densify does not read");
        return Err(malformed(path, "extensionsRequired", problem));
    }
    let mut all = length;
    let mut contents = Vec::new();
    for (index, BufferSource { uri }) in document.buffers.iter().enumerate() {
        let bytes = match uri {
            None => inside.take().filter(|_| index == 0).unwrap_or_default(),
            Some(uri) => buffer(path, uri)?,
        };
        all += bytes.len() as u64;
        contents.push(bytes);
    }
    let buffers = Buffers {
        path,
        accessors: &document.accessors,
        views: &document.buffer_views,
        buffers: contents,
    };
    let mut found = SplatFile { gaussians: Gaussians::default(), dropped: 0, repaired: 0 };
    let mut primitives = 0;
    let roots = document.scenes.get(document.scene).map(|scene| scene.nodes.as_slice());
    for (mesh, motion) in nodes::placed(path, &document.nodes, roots)? {
        let mesh = document.meshes.get(mesh);
        for primitive in
            &mesh.ok_or_else(|| malformed(path, "nodes", "there is no such mesh"))?.primitives
        {
            let Some(extension) = primitive.extensions.get(SPLATS) else { continue };
            primitives += 1;
            let mut part = splats(&buffers, primitive, extension)?;
            motion.apply(&mut part.gaussians);
            join(&mut found, part);
            // Nodes may show the same data any number of times.
            let bytes =
                4 * (11 + found.gaussians.sh.len() as u64 + 11 * found.gaussians.len() as u64);
            if bytes > most_unpacked(all) {
                return Err(malformed(
                    path,
                    "nodes",
                    "they show more splats than a file of its size can hold",
                ));
            }
        }
    }
    match primitives {
        0 => Err(DatasetError(format!(
            "{} holds no Gaussian splats ({SPLATS}); a mesh is rendered by `densify scenegen`",
            path.display()
        ))),
        _ => Ok(found),
    }
}

/// The bytes of a buffer that is not the file's own.
fn buffer(path: &Path, uri: &str) -> Result<Vec<u8>, DatasetError> {
    if let Some(data) = uri.strip_prefix("data:") {
        let bytes = data.split_once(";base64,").and_then(|(_, text)| BASE64.decode(text).ok());
        return bytes.ok_or_else(|| malformed(path, "buffers", "data that is not base64"));
    }
    let mut bytes = Vec::new();
    let mut file = beside::open(path, "buffers", uri)?;
    file.read_to_end(&mut bytes).map_err(DatasetError::io(path))?;
    Ok(bytes)
}

/// The rows of a primitive, where its node does not move them.
fn splats(
    buffers: &Buffers<'_>,
    primitive: &Primitive,
    extension: &Value,
) -> Result<SplatFile, DatasetError> {
    let path = buffers.path;
    if let Some(view) = extension.pointer(&format!("/extensions/{SPZ}/bufferView")) {
        let view = view.as_u64().and_then(|view| usize::try_from(view).ok());
        let bytes = buffers.view(view.unwrap_or(usize::MAX))?;
        return spz::read(path, bytes, bytes.len() as u64);
    }
    let said = |key: &str| extension.get(key).and_then(Value::as_str).unwrap_or_default();
    if !matches!(said("kernel"), "ellipse" | "") || said("colorSpace") == "lin_rec709_display" {
        let problem = format!(
            "the kernel {:?} with colours in {:?}; only ellipses with sRGB colours are read",
            said("kernel"),
            said("colorSpace")
        );
        return Err(malformed(path, SPLATS, problem));
    }
    let attribute = |name: &str, width: usize| match primitive.attributes.get(name) {
        None => Ok(None),
        Some(&accessor) => buffers.numbers(name, accessor, width).map(Some),
    };
    let needed = |name: &str, width: usize| {
        let name = if name == "POSITION" { name.to_owned() } else { format!("{SPLATS}:{name}") };
        let missing = || malformed(path, "attributes", format!("there is no {name}"));
        attribute(&name, width)?.ok_or_else(missing)
    };
    let (means, quats) = (needed("POSITION", 3)?, needed("ROTATION", 4)?);
    let (scales, opacities) = (needed("SCALE", 3)?, needed("OPACITY", 1)?);
    let (log_scales, logits) = (attribute(LOG_SCALE, 3)?, attribute(OPACITY_LOGIT, 1)?);
    let has = |degree: &u8| primitive.attributes.contains_key(&coefficient(*degree, 0));
    let sh_degree = (0..=MAX_SH_DEGREE).take_while(|degree| *degree == 0 || has(degree)).last();
    let sh_degree = sh_degree.unwrap_or(0);
    let mut bands = Vec::new();
    for degree in 0..=sh_degree {
        for n in 0..=2 * degree {
            let name = coefficient(degree, n);
            let found = attribute(&name, 3)?;
            bands.push(
                found
                    .ok_or_else(|| malformed(path, "attributes", format!("there is no {name}")))?,
            );
        }
    }
    let count = opacities.len();
    let others = [&means, &scales].into_iter().chain(&bands).chain(&log_scales);
    if quats.len() != 4 * count
        || logits.as_ref().is_some_and(|logits| logits.len() != count)
        || others.into_iter().any(|values| values.len() != 3 * count)
    {
        return Err(malformed(path, "attributes", "they have different counts"));
    }
    let mut rows = Rows::new(sh_degree);
    let mut sh = Vec::with_capacity(3 * sh_coefficients(sh_degree));
    for row in 0..count {
        let three = |values: &[f32]| [values[3 * row], values[3 * row + 1], values[3 * row + 2]];
        sh.clear();
        sh.extend(bands.iter().flat_map(|band| three(band)));
        let (scale, opacity) = (three(&scales), opacities[row]);
        // What other programs changed holds, not what they left.
        let log_scale = log_scales.as_ref().map(|logs| three(logs));
        let logit = logits.as_ref().map(|logits| logits[row]);
        let fits = |log: &[f32; 3]| log.map(|x| x.exp().to_bits()) == scale.map(f32::to_bits);
        rows.push(Row {
            mean: three(&means),
            log_scale: log_scale.filter(fits).unwrap_or_else(|| scale.map(log_of_scale)),
            quat: [quats[4 * row + 3], quats[4 * row], quats[4 * row + 1], quats[4 * row + 2]],
            opacity_logit: match logit
                .filter(|&logit| sigmoid(logit).to_bits() == opacity.to_bits())
            {
                Some(logit) => logit,
                None => quantised_logit(opacity),
            },
            sh: &sh,
        });
    }
    rows.finish(path)
}

/// Name of a coefficient's attribute.
pub(crate) fn coefficient(degree: u8, n: u8) -> String {
    format!("{SPLATS}:SH_DEGREE_{degree}_COEF_{n}")
}

/// Appends a part; the model has the higher of the degrees.
fn join(whole: &mut SplatFile, part: SplatFile) {
    let degree = whole.gaussians.sh_degree.max(part.gaussians.sh_degree);
    let more = part.gaussians.with_degree(degree);
    let all = std::mem::take(&mut whole.gaussians).with_degree(degree);
    whole.gaussians = all;
    whole.gaussians.append(more);
    whole.dropped += part.dropped;
    whole.repaired += part.repaired;
}
