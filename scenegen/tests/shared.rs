//! Tests with the meshes of the shared data: valid files render, files that need unsupported extensions are
//! refused with a message that names them, and each malformed file has the outcome listed in `malformed.tsv`.
//!
//! Most files that come with a report of the glTF validator have no scene. Each file with a report is therefore
//! read twice: unchanged, and with a buffer of zeros and a scene of all its meshes (if it has none, of meshes made from
//! its accessors or buffer views). Some files that the validator rejects load nevertheless: their errors are in
//! metadata that is not read, in alignments that this reader does not need, or in morph targets without weight.
//! Files that the validator accepts load, or have no triangle to render.

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

/// All files in a list must give the same images.
#[test]
#[ignore = "needs the shared cases: set DENSIFY_SHARED"]
fn shared_cases_of_equal_meaning_give_the_same_images() {
    let root = shared("..").join("../cases");
    let views = |file: &str| {
        let scene = prepare(&root.join(file)).unwrap_or_else(|e| panic!("{file}: {e}"));
        (0..scene.views.len()).map(|i| scene.render(i).rgba).collect::<Vec<_>>()
    };
    let file = |name: &&str| {
        if name.contains('.') { (*name).to_owned() } else { format!("obj/{name}/m.obj") }
    };
    for [first, others @ ..] in [
        ["ok", "meshlab_tr", "maya_kd0"],
        ["tex128", "vc128", "tex128"],
        ["gltf/plain.gltf", "gltf/skin.gltf", "gltf/morph.gltf"],
    ] {
        let expected = views(&file(&first));
        for other in &others {
            let found = views(&file(other));
            let pixels = expected.concat().into_iter().zip(found.concat());
            let differ = pixels.filter(|(a, b)| a.abs_diff(*b) > 1).count();
            assert_eq!(differ, 0, "{first} and {other}");
        }
    }
}

// The outcome of a file: it loads, or gives an error that contains this text.
const LOADS: &str = "it loads";
const EMPTY: &str = "no triangle to render";

/// The files with an unusual outcome, for each of the two readings. All others load, except that the validator's
/// files are [`EMPTY`] when read unchanged, as they have no scene.
const OUTCOMES: &str = include_str!("malformed.tsv");

/// The rows of [`OUTCOMES`] for one of the two readings, `read`: file and outcome.
fn outcomes(read: &str) -> Vec<(&'static str, &'static str)> {
    let rows = OUTCOMES.lines().filter_map(|line| line.split_once('\t'));
    rows.filter(|(kind, _)| *kind == read).filter_map(|(_, row)| row.split_once('\t')).collect()
}

/// A `.glb` of a file's JSON with a scene of all its contents and a buffer of zeros. `None` if the JSON is
/// malformed or incomplete.
fn with_a_scene(path: &Path) -> Option<Vec<u8>> {
    let mut root: Value = serde_json::from_slice(&fs::read(path).ok()?).ok()?;
    let count = |root: &Value, list| root.get(list).and_then(Value::as_array).map_or(0, Vec::len);
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

/// Adds a complaint if the outcome is not that of the file's row or, without a row, `others`. Removes the row, so that
/// each is used once.
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
    // With a buffer of zeros all corners coincide, so the error that no triangle has an area counts as loading.
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
    let [mut unchanged, mut with_scene] = ["unchanged", "with a scene"].map(outcomes);
    assert!(unchanged.len() > 40 && with_scene.len() > 20, "rows are missing");
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
