//! Loads glTF 2.0, as `.gltf` with files or data URIs and as `.glb`.
//!
//! The types of the `gltf` crate describe the JSON. Indices, offsets and counts are checked here, as the
//! crate's readers do not check them. Skins, morph targets and animations are ignored: meshes are rendered in
//! their rest pose. Occlusion textures are ignored, as the tracer can compute occlusion.
//!
//! Errors that cannot change the result are ignored: alignments, bounds of accessors, targets of
//! buffer views, names of attributes that are not read, morph targets, and objects that the scene
//! does not use. `tests/malformed.tsv` lists the outcome for each test file of a validator.
//!
//! Over 400 lines, as mesh, camera and light of a node are read in the same traversal.

mod accessors;
mod materials;

use std::collections::HashMap;
use std::fmt::Display;
use std::path::Path;

use glam::{DAffine3, DMat3, DMat4, DQuat, DVec3, Vec2, Vec3, Vec4};
use gltf::json;
use json::extensions::scene::khr_lights_punctual::Type as LightType;
use json::mesh::{Mode, Primitive, Semantic};
use json::validation::Checked;
use serde_json::Value;

use crate::error::Error;
use crate::mesh::{FileCamera, Light, LightKind, Model, pad};
use crate::resource;
use accessors::Buffers;

/// Largest JSON part `[bytes]`. (serde_json limits its depth to 128.)
const MAX_JSON: usize = 64 << 20;
/// Maximum number of nodes, meshes, accessors, buffers, images or materials.
const MAX_ITEMS: usize = 1_000_000;
/// Maximum depth of the node hierarchy.
const MAX_DEPTH: usize = 256;
/// Maximum number of triangles of a scene, including instances.
const MAX_TRIANGLES: usize = 1 << 26;
const REMEDY: &str = "correct the file or export it again";
/// Extensions that files may require.
const SUPPORTED: [&str; 5] = [
    "KHR_lights_punctual",
    "KHR_materials_emissive_strength",
    "KHR_materials_unlit",
    "KHR_mesh_quantization",
    "KHR_texture_transform",
];

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
    if text.len() > MAX_JSON {
        return Err(fault(path, "JSON", "it is larger than 64 MiB"));
    }
    refuse_required(path, text)?;
    let root = parse(path, text)?;
    for (what, count) in [
        ("nodes", root.nodes.len()),
        ("meshes", root.meshes.len()),
        ("accessors", root.accessors.len()),
        ("buffers", root.buffers.len()),
        ("images", root.images.len()),
        ("materials", root.materials.len()),
    ] {
        if count > MAX_ITEMS {
            return Err(fault(path, what, "there are more than a million"));
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
    reader.notes();
    reader.scene()?;
    reader.model.finish(path)
}

pub(super) fn fault(path: &Path, element: impl Display, problem: impl Display) -> Error {
    Error::malformed(path, element, problem, REMEDY)
}

/// Parses the JSON part. If the crate's types refuse it, it is rewritten in the form they expect, as glTF 2.0
/// allows integers written as 1.0 (2.7.1), `extras` of any type (3.2), and scenes without nodes (5.25).
fn parse(path: &Path, text: &[u8]) -> Result<json::Root, Error> {
    let error = match json::deserialize::from_slice(text) {
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
    json::deserialize::from_slice(&rewritten).map_err(|_| error)
}

/// Removes `extras`, and writes integers without a fraction.
fn normalise(value: &mut Value) {
    match value {
        Value::Array(list) => list.iter_mut().for_each(normalise),
        Value::Object(map) => {
            map.remove("extras");
            map.values_mut().for_each(normalise);
        }
        Value::Number(number) => {
            // Beyond 2^53 not every integer is a float.
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

/// Refuses unsupported versions and required extensions. This comes first, as the changes they make may look
/// like errors.
fn refuse_required(path: &Path, text: &[u8]) -> Result<(), Error> {
    #[derive(serde::Deserialize)]
    #[serde(rename_all = "camelCase")]
    struct Head {
        asset: Asset,
        #[serde(default)]
        extensions_required: Vec<String>,
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
    if let Some(name) = head.extensions_required.iter().find(|name| !known(name)) {
        let remedy = match name.as_str() {
            "KHR_draco_mesh_compression" => "export the mesh without Draco compression",
            "EXT_meshopt_compression" | "KHR_meshopt_compression" => {
                "export the mesh without meshopt compression"
            }
            "KHR_texture_basisu" => "store its textures as PNG or JPEG",
            "EXT_texture_webp" | "EXT_texture_avif" => "store its textures as PNG or JPEG",
            _ => "export the file without it",
        };
        let name: String = name.chars().take(80).collect();
        let feature = format!("the extension {name}, which the file requires,");
        return Err(Error::unsupported(path, &feature, remedy));
    }
    Ok(())
}

impl Reader<'_> {
    fn fault(&self, element: impl Display, problem: impl Display) -> Error {
        fault(self.path, element, problem)
    }

    fn notes(&mut self) {
        let ignored = self.root.extensions_used.iter();
        let ignored: Vec<_> = ignored.filter(|name| !SUPPORTED.contains(&name.as_str())).collect();
        let notes = &mut self.model.notes;
        if !ignored.is_empty() {
            let names = ignored.iter().map(|name| name.chars().take(40).collect::<String>());
            let names = names.take(10).collect::<Vec<_>>().join(", ");
            notes.push(format!("these extensions are ignored: {names}"));
        }
        if !self.root.animations.is_empty() || !self.root.skins.is_empty() {
            notes
                .push("skins and animations are ignored: meshes are in their rest pose".to_owned());
        }
    }

    /// Visits the nodes of the default scene.
    fn scene(&mut self) -> Result<(), Error> {
        let root = self.root;
        let number = root.scene.map_or(0, |index| index.value());
        let roots: Vec<usize> = match root.scenes.get(number) {
            Some(scene) => scene.nodes.iter().map(json::Index::value).collect(),
            None if root.scene.is_some() => {
                return Err(self.fault(format!("scene {number}"), "there is no such scene"));
            }
            None => {
                // Without scenes, all nodes that have no parent.
                let mut is_child = vec![false; root.nodes.len()];
                for child in root.nodes.iter().flat_map(|node| node.children.iter().flatten()) {
                    if let Some(mark) = is_child.get_mut(child.value()) {
                        *mark = true;
                    }
                }
                (0..root.nodes.len()).filter(|&i| !is_child[i]).collect()
            }
        };
        let mut visited = vec![false; root.nodes.len()];
        let mut open: Vec<(usize, DAffine3, usize)> =
            roots.iter().rev().map(|&node| (node, DAffine3::IDENTITY, 0)).collect();
        while let Some((index, parent, depth)) = open.pop() {
            let name = format!("node {index}");
            let Some(node) = root.nodes.get(index) else {
                return Err(self.fault(name, "there is no such node"));
            };
            if std::mem::replace(&mut visited[index], true) {
                return Err(self.fault(name, "it is its own ancestor or has two parents"));
            }
            if depth > MAX_DEPTH {
                return Err(self.fault(name, format!("it is more than {MAX_DEPTH} levels deep")));
            }
            let world = parent * local(node);
            if !world.is_finite() {
                return Err(self.fault(name, "its transform is not finite"));
            }
            self.node(node, &name, &world)?;
            let children = node.children.iter().flatten().rev();
            open.extend(children.map(|child| (child.value(), world, depth + 1)));
        }
        Ok(())
    }

    fn node(&mut self, node: &json::Node, name: &str, world: &DAffine3) -> Result<(), Error> {
        if let Some(index) = node.mesh {
            let Some(mesh) = self.root.meshes.get(index.value()) else {
                return Err(self.fault(name, format!("there is no mesh {}", index.value())));
            };
            for (number, primitive) in mesh.primitives.iter().enumerate() {
                let element = format!("mesh {} primitive {number}", index.value());
                self.primitive(primitive, &element, world)?;
            }
        }
        if let Some(index) = node.camera {
            self.camera(index.value(), name, world)?;
        }
        let extensions = node.extensions.as_ref();
        if let Some(light) = extensions.and_then(|e| e.khr_lights_punctual.as_ref()) {
            self.light(light.light.value(), name, world)?;
        }
        Ok(())
    }

    fn primitive(
        &mut self,
        primitive: &Primitive,
        element: &str,
        world: &DAffine3,
    ) -> Result<(), Error> {
        let Checked::Valid(mode) = primitive.mode else {
            return Err(self.fault(element, "its mode is not in 0 to 6"));
        };
        if !matches!(mode, Mode::Triangles | Mode::TriangleStrip | Mode::TriangleFan) {
            let note = "points and lines are not rendered".to_owned();
            if !self.model.notes.contains(&note) {
                self.model.notes.push(note);
            }
            return Ok(());
        }
        let attribute = |semantic| primitive.attributes.get(&Checked::Valid(semantic));
        let Some(positions) = attribute(Semantic::Positions) else {
            // Valid (glTF 2.0, 3.7.2.1), as an extension may define positions.
            let note = format!("{element} has no positions and is not rendered");
            self.model.notes.push(note);
            return Ok(());
        };
        let positions = self.buffers.floats(positions.value(), &[3], element)?;
        let count = positions.count();
        let read = |buffers: &mut Buffers<'_>, semantic: Semantic, sizes: &[usize]| {
            let Some(index) = attribute(semantic.clone()) else {
                return Ok(None);
            };
            let values = buffers.floats(index.value(), sizes, element)?;
            if values.count() != count {
                let (index, found) = (index.value(), values.count());
                let problem = format!("accessor {index} has {found} elements, POSITION {count}");
                return Err(fault(self.path, format!("{element} {semantic:?}"), problem));
            }
            Ok(Some(values))
        };
        let normals = read(&mut self.buffers, Semantic::Normals, &[3])?;
        let tangents = read(&mut self.buffers, Semantic::Tangents, &[4])?;
        let uvs = [
            read(&mut self.buffers, Semantic::TexCoords(0), &[2])?,
            read(&mut self.buffers, Semantic::TexCoords(1), &[2])?,
        ];
        let colours = read(&mut self.buffers, Semantic::Colors(0), &[3, 4])?;
        let indices = match primitive.indices {
            Some(index) => self.buffers.indices(index.value(), element)?,
            None => (0..u32::try_from(count).unwrap_or(u32::MAX)).collect(),
        };
        if let Some(&index) = indices.iter().find(|&&i| i as usize >= count) {
            return Err(self.fault(element, format!("index {index} of {count} vertices")));
        }
        let mirrored = world.matrix3.determinant() < 0.0;
        let triangles = triangles(mode, &indices, mirrored);
        if self.model.triangles.len() + triangles.len() > MAX_TRIANGLES
            || self.model.positions.len() + count > u32::MAX as usize
        {
            return Err(self.fault(element, "the scene has more than 2^26 triangles"));
        }
        let material = self.material(primitive.material.map(|index| index.value()))?;

        let first = self.model.positions.len();
        for vertex in 0..count {
            let p = Vec3::from(positions.get::<3>(vertex)).as_dvec3();
            let p = world.transform_point3(p);
            if !p.is_finite() {
                return Err(self.fault(element, format!("vertex {vertex} is not finite")));
            }
            self.model.positions.push(p);
        }
        let model = &mut self.model;
        let normal_matrix = world.matrix3.inverse().transpose();
        let normal =
            |v: [f32; 3]| (normal_matrix * Vec3::from(v).as_dvec3()).as_vec3().normalize_or_zero();
        let side = if mirrored { -1.0 } else { 1.0 };
        let tangent = |v: [f32; 4]| {
            let [x, y, z, w] = v;
            let t = (world.matrix3 * DVec3::new(x.into(), y.into(), z.into())).as_vec3();
            t.normalize_or_zero().extend(w * side)
        };
        let colour = |v: [f32; 4]| Vec4::from(v).clamp(Vec4::ZERO, Vec4::splat(1e4));
        let place = (first, count);
        pad(&mut model.normals, converted(normals.as_ref(), normal), place, Vec3::ZERO);
        pad(&mut model.tangents, converted(tangents.as_ref(), tangent), place, Vec4::ZERO);
        for (list, values) in model.uvs.iter_mut().zip(&uvs) {
            pad(list, converted(values.as_ref(), Vec2::from), place, Vec2::ZERO);
        }
        pad(&mut model.colours, converted(colours.as_ref(), colour), place, Vec4::ONE);
        let first = first as u32;
        model.triangles.extend(triangles.iter().map(|t| t.map(|i| i + first)));
        model.triangle_materials.resize(model.triangles.len(), material);
        Ok(())
    }

    fn camera(&mut self, index: usize, name: &str, world: &DAffine3) -> Result<(), Error> {
        let Some(camera) = self.root.cameras.get(index) else {
            return Err(self.fault(name, format!("there is no camera {index}")));
        };
        let Some(perspective) = &camera.perspective else {
            self.model.notes.push(format!("camera {index} is ignored: it is orthographic"));
            return Ok(());
        };
        let yfov = f64::from(perspective.yfov);
        let m = world.matrix3;
        let right = m.x_axis.normalize_or_zero();
        let forward = (-m.z_axis).normalize_or_zero();
        let down = forward.cross(right).normalize_or_zero();
        let right = down.cross(forward);
        if !(yfov > 0.0 && yfov < std::f64::consts::PI) || right.length_squared() < 0.5 {
            let problem = "its field of view or its node's axes are invalid";
            return Err(self.fault(format!("camera {index}"), problem));
        }
        self.model.cameras.push(FileCamera {
            name: camera.name.clone().unwrap_or_else(|| format!("camera {index}")),
            world_from_camera: DMat3::from_cols(right, down, forward),
            centre: world.translation,
            yfov,
        });
        Ok(())
    }

    fn light(&mut self, index: usize, name: &str, world: &DAffine3) -> Result<(), Error> {
        let lights = self.root.extensions.as_ref().and_then(|e| e.khr_lights_punctual.as_ref());
        let Some(light) = lights.and_then(|lights| lights.lights.get(index)) else {
            return Err(self.fault(name, format!("there is no light {index}")));
        };
        let intensity = Vec3::from(light.color) * light.intensity;
        let element = format!("light {index}");
        if !(intensity.is_finite() && intensity.min_element() >= 0.0) {
            return Err(self.fault(element, "its intensity is negative or not finite"));
        }
        let direction = (-world.matrix3.z_axis).normalize_or(DVec3::NEG_Z);
        let position = world.translation;
        let kind = match light.type_ {
            Checked::Valid(LightType::Directional) => LightKind::Directional { direction },
            Checked::Valid(LightType::Point) => LightKind::Point { position },
            Checked::Valid(LightType::Spot) => {
                let (inner, outer) =
                    light.spot.as_ref().map_or((0.0, std::f32::consts::FRAC_PI_4), |s| {
                        (s.inner_cone_angle, s.outer_cone_angle)
                    });
                let (cos_inner, cos_outer) = (inner.cos(), outer.cos());
                LightKind::Spot { position, direction, cos_inner, cos_outer }
            }
            Checked::Invalid => return Err(self.fault(element, "its type is unknown")),
        };
        let range = light.range.map_or(f64::INFINITY, f64::from);
        let range = if range > 0.0 { range } else { f64::INFINITY };
        self.model.lights.push(Light { kind, intensity, range });
        Ok(())
    }
}

/// The converted values of an attribute; none if the primitive lacks it.
fn converted<T, const N: usize>(
    values: Option<&accessors::Floats>,
    convert: impl Fn([f32; N]) -> T,
) -> impl Iterator<Item = T> {
    let finite = |v: [f32; N]| v.map(|x| if x.is_finite() { x } else { 0.0 });
    let count = values.map_or(0, accessors::Floats::count);
    (0..count).filter_map(move |i| Some(convert(finite(values?.get(i)))))
}

/// A node's own transform.
fn local(node: &json::Node) -> DAffine3 {
    if let Some(matrix) = node.matrix {
        return DAffine3::from_mat4(DMat4::from_cols_array(&matrix.map(f64::from)));
    }
    let vector =
        |v: Option<[f32; 3]>, default| v.map_or(default, |v| DVec3::from(v.map(f64::from)));
    let rotation = node.rotation.map_or(DQuat::IDENTITY, |q| {
        let q = DQuat::from_array(q.0.map(f64::from));
        if q.length_squared() > 0.0 { q.normalize() } else { DQuat::IDENTITY }
    });
    let scale = vector(node.scale, DVec3::ONE);
    let translation = vector(node.translation, DVec3::ZERO);
    DAffine3::from_scale_rotation_translation(scale, rotation, translation)
}

/// Triangles of a list, strip or fan, counter-clockwise; the order is reversed if the node mirrors them.
fn triangles(mode: Mode, indices: &[u32], mirrored: bool) -> Vec<[u32; 3]> {
    let mut triangles: Vec<[u32; 3]> = match mode {
        Mode::TriangleStrip => indices
            .windows(3)
            .enumerate()
            .map(|(i, t)| if i % 2 == 0 { [t[0], t[1], t[2]] } else { [t[1], t[0], t[2]] })
            .collect(),
        Mode::TriangleFan => indices.windows(2).skip(1).map(|t| [t[0], t[1], indices[0]]).collect(),
        // An incomplete triangle at the end is ignored.
        _ => indices.chunks_exact(3).map(|t| [t[0], t[1], t[2]]).collect(),
    };
    if mirrored {
        for triangle in &mut triangles {
            triangle.swap(1, 2);
        }
    }
    triangles
}

#[cfg(test)]
#[allow(clippy::float_cmp, clippy::print_stderr, reason = "exact values; tests say why they skip")]
mod tests;
