//! Tests with the meshes of the shared data: valid files render, files that need unsupported extensions are
//! refused by name, and each malformed file has the outcome listed here.
//!
//! Most files with a validator's report have no scene, so each is read twice: unchanged, and with a
//! scene of all its meshes (or, without any, of its accessors or buffer views as positions and
//! indices) and a buffer of zeros. Some files that the validator rejects load nevertheless: their
//! errors are in metadata that is not read, in alignments that this reader does not need, or in morph
//! targets, which are not rendered. Files that it accepts load, or have no triangle to render.

use std::fs;
use std::path::{Path, PathBuf};

use densify_scenegen::{Error, Options, Scene, Source};
use serde_json::{Value, json};

/// A folder of the shared meshes.
fn shared(folder: &str) -> PathBuf {
    let root = std::env::var_os("DENSIFY_SHARED")
        .map_or_else(|| Path::new(env!("CARGO_MANIFEST_DIR")).join("../../shared"), PathBuf::from);
    let path = root.join("data/meshes").join(folder);
    assert!(path.is_dir(), "there is no {}; set DENSIFY_SHARED", path.display());
    path
}

/// All mesh files in a folder, sorted.
fn files(folder: &Path) -> Vec<PathBuf> {
    let mut found = Vec::new();
    for path in fs::read_dir(folder).expect("folder").map(|entry| entry.expect("entry").path()) {
        let ending = path.extension().unwrap_or_default();
        if path.is_dir() {
            found.extend(files(&path));
        } else if ["gltf", "glb", "obj"].iter().any(|known| ending == *known) {
            found.push(path);
        }
    }
    found.sort();
    found
}

fn prepare(path: &Path) -> Result<Scene, Error> {
    let options =
        Options { size: Some((24, 24)), train: Some(2), test: Some(1), ..Default::default() };
    Scene::prepare(&Source::File(path.to_owned()), &options)
}

#[test]
#[ignore = "needs the shared meshes: set DENSIFY_SHARED"]
fn every_shared_mesh_renders() {
    for folder in ["gltf", "obj"] {
        let all = files(&shared(folder));
        assert!(all.len() > 10);
        for path in all {
            let scene = prepare(&path).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
            let covered = |i| scene.render(i).rgba.chunks_exact(4).filter(|p| p[3] > 0).count();
            // One-sided planes are invisible from behind.
            let seen: usize = (0..scene.views.len()).map(covered).sum();
            assert!(seen > 10, "{}: {seen} pixels", path.display());
        }
    }
}

#[test]
#[ignore = "needs the shared meshes: set DENSIFY_SHARED"]
fn shared_meshes_that_need_other_software_are_refused_by_name() {
    let all = files(&shared("refuse"));
    assert!(all.len() >= 7);
    for path in &all {
        let error = prepare(path).err().unwrap_or_else(|| panic!("{}", path.display()));
        assert!(error.to_string().contains("is not supported"), "{}: {error}", path.display());
        let name = path.to_string_lossy();
        let expected = [
            ("EXT_meshopt", ["EXT_meshopt_compression", "without meshopt"]),
            ("KHR_meshopt", ["KHR_meshopt_compression", "without meshopt"]),
            ("Draco", ["KHR_draco_mesh_compression", "without Draco"]),
            ("KTX2", ["KHR_texture_basisu", "PNG or JPEG"]),
            ("ACME", ["ACME_gizmo", "without it"]),
            ("BoxMeshopt", ["EXT_meshopt_compression", "without meshopt"]),
        ];
        let (_, words) = expected.iter().find(|(part, _)| name.contains(part)).expect("a row");
        for word in words {
            assert!(error.to_string().contains(word), "{name}: {error}");
        }
    }
}

// The outcome of a file: it loads, or gives an error that contains this text.
const LOADS: &str = "it loads";
const EMPTY: &str = "no triangle to render";

/// Unchanged files with an unusual outcome; others of the validator have no scene, and all others load.
const UNCHANGED: &[(&str, &str)] = &[
    (
        "assimp/BoxWithInfinites-glTF-Binary/BoxWithInfinites.glb",
        "mesh 0 primitive 0: vertex 0 is not finite",
    ),
    (
        "assimp/IndexOutOfRange/AllIndicesOutOfRange.gltf",
        "mesh 0 primitive 0: index 65535 of 24 vertices",
    ),
    ("assimp/IndexOutOfRange/IndexOutOfRange.gltf", "mesh 0 primitive 0: index 255 of 24 vertices"),
    (
        "assimp/MissingBin/BoxTextured.gltf",
        "mesh 0 primitive 0, accessor 2, buffer view 1, buffer 0: there is no file BoxTextured0.bin",
    ),
    (
        "assimp/RecursiveNodes/RecursiveNodes.gltf",
        "node 0: it is its own ancestor or has two parents",
    ),
    ("assimp/TestNoRootNode/NoScene.gltf", "scene 0: there is no such scene"),
    ("assimp/TestNoRootNode/SceneWithoutNodes.gltf", EMPTY),
    ("assimp/empty.obj", EMPTY),
    ("assimp/malformed.obj", "line 23: vertex index 12 of 8"),
    ("gltf-validator/base/accessor/empty_object.gltf", "JSON: missing field `count`"),
    ("gltf-validator/base/buffer_view/empty_object.gltf", "JSON: missing field `buffer`"),
    ("gltf-validator/base/glb/bom.glb", "JSON: expected value"),
    (
        "gltf-validator/base/glb/chunk_too_big.glb",
        "GLB chunk: it reaches beyond the end of the file",
    ),
    ("gltf-validator/base/glb/empty_file.glb", "JSON: EOF while parsing a value"),
    ("gltf-validator/base/glb/empty_json_chunk.glb", "JSON: EOF while parsing a value"),
    ("gltf-validator/base/glb/empty_json_object.glb", "JSON: missing field `asset`"),
    ("gltf-validator/base/glb/invalid_json_chunk.glb", "JSON: key must be a string"),
    ("gltf-validator/base/glb/invalid_magic.glb", "JSON: expected value"),
    ("gltf-validator/base/glb/invalid_version.glb", "GLB header: version 0 is not 2"),
    (
        "gltf-validator/base/glb/length_mismatch.glb",
        "GLB header: it says 49 bytes, the file has 48",
    ),
    ("gltf-validator/base/glb/no_header.glb", "JSON: expected value"),
    ("gltf-validator/base/glb/only_bin_chunk.glb", "GLB chunk 0: it is not JSON"),
    ("gltf-validator/base/glb/only_header.glb", "GLB: there is no JSON chunk"),
    (
        "gltf-validator/base/glb/truncated_chunk_data.glb",
        "GLB header: it says 48 bytes, the file has 47",
    ),
    ("gltf-validator/base/glb/truncated_chunk_header.glb", "GLB header: the file ends within it"),
    ("gltf-validator/base/glb/two_bin_chunks.glb", "GLB chunk 0: it is not JSON"),
    ("gltf-validator/base/glb/two_empty_bin_chunks.glb", "GLB chunk 0: it is not JSON"),
    ("gltf-validator/base/glb/two_empty_json_chunks.glb", "JSON: EOF while parsing a value"),
    ("gltf-validator/base/glb/unknown_chunk.glb", "GLB chunk 0: it is not JSON"),
    ("gltf-validator/base/glb/zero_chunk_header.glb", "GLB chunk 0: it is not JSON"),
    ("gltf-validator/base/glb/zero_length.glb", "GLB header: it says 0 bytes, the file has 12"),
    ("gltf-validator/base/json/bom.gltf", "JSON: expected value"),
    ("gltf-validator/base/json/empty_file.gltf", "JSON: EOF while parsing a value"),
    (
        "gltf-validator/base/json/invalid_object.gltf",
        "JSON: invalid length 0, expected struct Head with 2 elements",
    ),
    ("gltf-validator/base/json/invalid_syntax.gltf", "JSON: key must be a string"),
    ("gltf-validator/base/mesh/empty_object.gltf", "JSON: missing field `primitives`"),
    ("tinyobjloader/catmark_torus_creases0.obj", "line 62: normal index 1 of 0"),
    (
        "tinyobjloader/colorspace-issue-184.obj",
        "colorspace-issue-184.mtl line 6: texture: there is no file diffuse.jpg",
    ),
    ("tinyobjloader/invalid-face-definition.obj", EMPTY),
    ("tinyobjloader/invalid-relative-texture-index.obj", "line 2: vertex index 1 of 0"),
    ("tinyobjloader/invalid-relative-vertex-index.obj", "line 1: vertex index -4 of 0"),
    ("tinyobjloader/issue-140-zero-face-idx.obj", "line 16: vertex index 0 of 4"),
    (
        "tinyobjloader/issue-248-texres-texopt.obj",
        "issue-248-texres-texopt.mtl line 5: texture: there is no file input.jpg",
    ),
    ("tinyobjloader/issue-356-leading-spaces-newmtl.obj", EMPTY),
    ("tinyobjloader/issue-92.obj", "issue-92.mtl line 5: texture: there is no file tmp.png"),
    ("tinyobjloader/line-prim.obj", EMPTY),
    (
        "tinyobjloader/mtllib-multiple-files-issue-112.obj",
        "mtllib-multiple-files-issue-112.mtl line 5: texture: there is no file tmp.png",
    ),
    (
        "tinyobjloader/norm-texopt.obj",
        "norm-texopt.mtl line 6: texture: there is no file normalmap.jpg",
    ),
    (
        "tinyobjloader/pbr-mat-ext.obj",
        "pbr-mat-ext.mtl line 17: texture: there is no file emissive.tex",
    ),
    ("tinyobjloader/points-prim.obj", EMPTY),
    ("tinyobjloader/smoothing-group-two-squares.obj", "line 21: normal index 1 of 0"),
    ("tinyobjloader/test-nan.obj", "line 12: vertex 1 is not finite"),
    (
        "tinyobjloader/texture-filename-with-whitespace.obj",
        "texture-filename-with-whitespace.mtl line 6: texture: there is no file texture 01.png",
    ),
    (
        "tinyobjloader/texture-options-issue-85.obj",
        "texture-options-issue-85.mtl line 7: texture: there is no file diffuse.jpg",
    ),
];

/// Files of the validator that do not load with a scene made of their contents.
const WITH_A_SCENE: &[(&str, &str)] = &[
    (
        "gltf-validator/base/accessor/alignment.gltf",
        "mesh 0 primitive 2, accessor 2: its elements lie beyond its buffer view",
    ),
    ("gltf-validator/base/accessor/custom_property.gltf", EMPTY),
    ("gltf-validator/base/accessor/empty_array.gltf", EMPTY),
    ("gltf-validator/base/accessor/empty_object.gltf", "JSON: missing field `count`"),
    (
        "gltf-validator/base/accessor/float_normalized.gltf",
        "mesh 0 primitive 0 indices, accessor 0: indices must be unsigned scalars",
    ),
    (
        "gltf-validator/base/accessor/invalid_sparse_count_and_stride.gltf",
        "mesh 0 primitive 0 indices, accessor 0: indices must be unsigned scalars",
    ),
    (
        "gltf-validator/base/accessor/matrix_alignment.gltf",
        "mesh 0 primitive 0, accessor 0: matrices are not vertex attributes",
    ),
    (
        "gltf-validator/base/accessor/small_stride.gltf",
        "mesh 0 primitive 0, accessor 0: it has 4 components, not 3",
    ),
    (
        "gltf-validator/base/accessor/unknown_type.gltf",
        "mesh 0 primitive 0, accessor 0: its type or componentType is unknown",
    ),
    (
        "gltf-validator/base/accessor/unresolved_bufferviews.gltf",
        "mesh 0 primitive 0, accessor 0, buffer view 0: there is no such buffer view",
    ),
    ("gltf-validator/base/buffer_view/custom_property.gltf", EMPTY),
    ("gltf-validator/base/buffer_view/empty_array.gltf", EMPTY),
    ("gltf-validator/base/buffer_view/empty_object.gltf", "JSON: missing field `buffer`"),
    (
        "gltf-validator/base/buffer_view/invalid_length.gltf",
        "mesh 0 primitive 0 indices, accessor 0, buffer view 0: bytes 0 to 0 + 5 lie beyond its buffer",
    ),
    ("gltf-validator/base/buffer_view/invalid_stride_multiple.gltf", EMPTY),
    ("gltf-validator/base/buffer_view/invalid_stride_too_big.gltf", EMPTY),
    ("gltf-validator/base/buffer_view/invalid_stride_wrong_target.gltf", EMPTY),
    (
        "gltf-validator/base/buffer_view/unresolved_buffer.gltf",
        "mesh 0 primitive 0 indices, accessor 0, buffer view 0, buffer 1: there is no such buffer",
    ),
    ("gltf-validator/base/buffer_view/valid.gltf", EMPTY),
    (
        "gltf-validator/base/buffer_view/zero_bytelength.gltf",
        "mesh 0 primitive 0 indices, accessor 0: its elements lie beyond its buffer view",
    ),
    (
        "gltf-validator/base/mesh/accessor_unequal_count.gltf",
        "mesh 0 primitive 0 Colors(0): accessor 1 has 4 elements, POSITION 3",
    ),
    ("gltf-validator/base/mesh/empty_array.gltf", EMPTY),
    ("gltf-validator/base/mesh/empty_object.gltf", "JSON: missing field `primitives`"),
    (
        "gltf-validator/base/mesh/indices_invalid_format.gltf",
        "mesh 0 primitive 0 indices, accessor 1: indices must be unsigned scalars",
    ),
    ("gltf-validator/base/mesh/invalid_tangent.gltf", EMPTY),
    (
        "gltf-validator/base/mesh/position_accessor_invalid_format.gltf",
        "mesh 0 primitive 0, accessor 0: it has 4 components, not 3",
    ),
    ("gltf-validator/base/mesh/primitive_no_position.gltf", EMPTY),
    (
        "gltf-validator/base/mesh/unresolved_indices.gltf",
        "mesh 0 primitive 0 indices, accessor 1: there is no such accessor",
    ),
    ("gltf-validator/base/mesh/unresolved_material.gltf", "material 0: there is no such material"),
    (
        "gltf-validator/base/mesh/unresolved_positions.gltf",
        "mesh 0 primitive 0, accessor 0: there is no such accessor",
    ),
];

/// A `.glb` of a file's JSON with a scene of all its contents and a buffer of zeros. `None` if the JSON is
/// malformed or incomplete.
fn with_a_scene(path: &Path) -> Option<Vec<u8>> {
    let mut root: Value = serde_json::from_slice(&fs::read(path).ok()?).ok()?;
    let count = |root: &Value, what| root.get(what).and_then(Value::as_array).map_or(0, Vec::len);
    if count(&root, "accessors") == 0 {
        let all: Vec<Value> = (0..count(&root, "bufferViews"))
            .map(
                |i| json!({ "bufferView": i, "type": "SCALAR", "componentType": 5121, "count": 1 }),
            )
            .collect();
        root.as_object_mut()?.insert("accessors".into(), json!(all));
    }
    let accessors = count(&root, "accessors");
    if root.get("meshes").and_then(Value::as_array).is_none_or(Vec::is_empty) {
        // Scalars cannot be positions, so they are used as indices.
        let used = |i: usize| match root["accessors"][i]["type"].as_str() {
            Some("SCALAR") => json!({ "attributes": { "POSITION": accessors }, "indices": i }),
            _ => json!({ "attributes": { "POSITION": i } }),
        };
        let all: Vec<Value> = (0..accessors).map(used).collect();
        let triangle = json!({ "type": "VEC3", "componentType": 5126, "count": 3 });
        root["accessors"].as_array_mut()?.push(triangle);
        root.as_object_mut()?.insert("meshes".into(), json!([{ "primitives": all }]));
    }
    let meshes = root["meshes"].as_array().map_or(0, Vec::len);
    let nodes: Vec<Value> = (0..meshes).map(|i| json!({ "mesh": i })).collect();
    let roots: Vec<usize> = (0..meshes).collect();
    root["nodes"] = json!(nodes);
    root["scenes"] = json!([{ "nodes": roots }]);
    root.as_object_mut()?.remove("scene");
    let mut text = root.to_string().into_bytes();
    text.resize(text.len().next_multiple_of(4), b' ');
    let zeros = vec![0; 4096];
    let mut bytes = b"glTF\x02\0\0\0\0\0\0\0".to_vec();
    for (kind, data) in [(b"JSON", &text), (b"BIN\0", &zeros)] {
        bytes.extend((data.len() as u32).to_le_bytes());
        bytes.extend(kind);
        bytes.extend(data);
    }
    let length = (bytes.len() as u32).to_le_bytes();
    bytes[8..12].copy_from_slice(&length);
    Some(bytes)
}

/// Adds a complaint if the outcome is not that of the file's row, or `others` if it has none. Each row is used
/// once.
fn check_outcome(
    rows: &mut Vec<(&str, &str)>,
    others: &str,
    name: &str,
    found: Result<Scene, Error>,
    complaints: &mut Vec<String>,
) {
    let row = rows.iter().position(|(row, _)| *row == name);
    let expected = row.map_or(others, |row| rows.swap_remove(row).1);
    let found = found.map_or_else(|error| error.to_string(), |_| LOADS.to_owned());
    // With a buffer of zeros all corners coincide, so such an error counts as loading.
    let found = if found.contains("no triangle has an area") { LOADS } else { &found };
    if !found.contains(expected) {
        complaints.push(format!("{name}: {found}, expected: {expected}"));
    }
}

#[test]
#[ignore = "needs the shared meshes: set DENSIFY_SHARED"]
fn every_malformed_shared_file_has_the_listed_outcome() {
    let root = shared("malformed");
    let folder = tempfile::tempdir().expect("folder");
    let mut complaints = Vec::new();
    let (mut unchanged, mut with_scene) = (UNCHANGED.to_vec(), WITH_A_SCENE.to_vec());
    for path in files(&root) {
        let name = path.strip_prefix(&root).expect("inside").to_string_lossy().replace('\\', "/");
        let others = if name.starts_with("gltf-validator") { EMPTY } else { LOADS };
        check_outcome(&mut unchanged, others, &name, prepare(&path), &mut complaints);
        let report = PathBuf::from(format!("{}.report.json", path.display()));
        if report.is_file()
            && !name.contains("/glb/")
            && let Some(bytes) = with_a_scene(&path)
        {
            let file = folder.path().join("with_a_scene.glb");
            fs::write(&file, bytes).expect("write");
            check_outcome(&mut with_scene, LOADS, &name, prepare(&file), &mut complaints);
        }
    }
    let unused = unchanged
        .iter()
        .chain(&with_scene)
        .map(|(name, _)| format!("{name}: there is no such file"));
    complaints.extend(unused);
    assert!(complaints.is_empty(), "{}", complaints.join("\n"));
}
