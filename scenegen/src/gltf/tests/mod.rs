//! Tests with valid, unusual and damaged glTF files.

mod geometry;

use glam::DVec3;
use serde_json::json;

use super::*;

/// A `.glb` file of a JSON part and a binary part.
fn glb(json: &Value, bin: &[u8]) -> Vec<u8> {
    let mut text = json.to_string().into_bytes();
    text.resize(text.len().next_multiple_of(4), b' ');
    let mut bytes = b"glTF\x02\0\0\0\0\0\0\0".to_vec();
    for (kind, data) in [(b"JSON", &text[..]), (b"BIN\0", bin)] {
        bytes.extend((data.len() as u32).to_le_bytes());
        bytes.extend(kind);
        bytes.extend(data);
    }
    let length = (bytes.len() as u32).to_le_bytes();
    bytes[8..12].copy_from_slice(&length);
    bytes
}

fn load_bytes(bytes: &[u8]) -> Result<Model, Error> {
    let folder = tempfile::tempdir().expect("folder");
    let path = folder.path().join("test.glb");
    std::fs::write(&path, bytes).expect("write");
    load(&path)
}

/// A square of four corners in the plane z = 0, with unused bytes between them, and 16-bit indices.
fn square() -> (Value, Vec<u8>) {
    let mut bin = Vec::new();
    for (x, y) in [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)] {
        for value in [x, y, 0.0, 7.0_f32] {
            bin.extend(value.to_le_bytes());
        }
    }
    for index in [0_u16, 1, 2, 0, 2, 3] {
        bin.extend(index.to_le_bytes());
    }
    let json = json!({
        "asset": { "version": "2.0" },
        "scenes": [{ "nodes": [0] }],
        "nodes": [{ "mesh": 0 }],
        "meshes": [{ "primitives": [{ "attributes": { "POSITION": 0 }, "indices": 1 }] }],
        "accessors": [
            { "bufferView": 0, "componentType": 5126, "count": 4, "type": "VEC3" },
            { "bufferView": 1, "componentType": 5123, "count": 6, "type": "SCALAR" },
        ],
        "bufferViews": [
            { "buffer": 0, "byteLength": 64, "byteStride": 16 },
            { "buffer": 0, "byteOffset": 64, "byteLength": 12 },
        ],
        "buffers": [{ "byteLength": 76 }],
    });
    (json, bin)
}

/// The square with one value of the JSON replaced.
fn with(pointer: &str, value: Value) -> Result<Model, Error> {
    let (mut json, bin) = square();
    let (parent, key) = pointer.rsplit_once('/').expect("a path");
    let parent = json.pointer_mut(parent).unwrap_or_else(|| panic!("{pointer}"));
    match parent {
        Value::Object(map) => drop(map.insert(key.to_owned(), value)),
        Value::Array(list) => list[key.parse::<usize>().expect("an index")] = value,
        _ => panic!("{pointer}"),
    }
    load_bytes(&glb(&json, &bin))
}

/// The sum of the triangles' area vectors.
fn area(model: &Model) -> DVec3 {
    let cross = |t: &[u32; 3]| {
        let [a, b, c] = t.map(|i| model.positions[i as usize]);
        0.5 * (b - a).cross(c - a)
    };
    model.triangles.iter().map(cross).sum()
}

#[test]
fn interleaved_accessors_and_nodes_are_read() {
    let (json, bin) = square();
    let model = load_bytes(&glb(&json, &bin)).expect("square");
    assert_eq!(area(&model), DVec3::Z);
    // Scaled by 2, rotated about x and translated; and the same as a matrix.
    let turn = json!({
        "mesh": 0, "scale": [2, 2, 2], "translation": [1, 2, 3],
        "rotation": [0.5_f64.sqrt(), 0.0, 0.0, 0.5_f64.sqrt()],
    });
    let matrix = json!({ "mesh": 0, "matrix": [2, 0, 0, 0, 0, 0, 2, 0, 0, -2, 0, 0, 1, 2, 3, 1] });
    for node in [turn, matrix] {
        let model = with("/nodes/0", node).expect("node");
        assert!(area(&model).distance(-4.0 * DVec3::Y) < 1e-6, "{}", area(&model));
        assert!(model.positions[2].distance(DVec3::new(3.0, 2.0, 5.0)) < 1e-6);
    }
    // Mirrored in x, it still faces +z.
    let model = with("/nodes/0", json!({ "mesh": 0, "scale": [-1, 1, 1] })).expect("node");
    assert_eq!(area(&model), DVec3::Z);
    // Mirrored in z, it faces the other way.
    let model = with("/nodes/0", json!({ "mesh": 0, "scale": [1, 1, -1] })).expect("node");
    assert_eq!(area(&model), -DVec3::Z);
}

#[test]
fn fans_sparse_strips_and_child_nodes_are_read() {
    let (mut json, bin) = square();
    json["meshes"][0]["primitives"][0]["mode"] = json!(6);
    json["meshes"][0]["primitives"][0].as_object_mut().expect("object").remove("indices");
    assert_eq!(area(&load_bytes(&glb(&json, &bin)).expect("fan")), DVec3::Z);
    // A strip needs the corners in the order 0, 1, 3, 2: a sparse accessor swaps the last two.
    json["meshes"][0]["primitives"][0]["mode"] = json!(5);
    let mut sparse = bin.clone();
    sparse.extend([2, 3, 0, 0]);
    for (x, y) in [(0.0, 1.0), (1.0, 1.0)] {
        for value in [x, y, 0.0_f32] {
            sparse.extend(value.to_le_bytes());
        }
    }
    json["accessors"][0]["sparse"] = json!({
        "count": 2,
        "indices": { "bufferView": 2, "componentType": 5121 },
        "values": { "bufferView": 3 },
    });
    json["bufferViews"].as_array_mut().expect("list").extend([
        json!({ "buffer": 0, "byteOffset": 76, "byteLength": 2 }),
        json!({ "buffer": 0, "byteOffset": 80, "byteLength": 24 }),
    ]);
    json["buffers"][0]["byteLength"] = json!(104);
    json["nodes"] =
        json!([{ "mesh": 0, "children": [1] }, { "mesh": 0, "translation": [5, 0, 0] }]);
    let model = load_bytes(&glb(&json, &sparse)).expect("strip");
    assert_eq!((area(&model), model.triangles.len()), (2.0 * DVec3::Z, 4));
    assert_eq!(model.bounds().1.x, 6.0);
}

#[test]
fn quantised_positions_are_read() {
    let (mut json, _) = square();
    let mut bin = Vec::new();
    for (x, y) in [(0_i16, 0_i16), (32767, 0), (32767, 32767), (0, 32767)] {
        for value in [x, y, 0, 99] {
            bin.extend(value.to_le_bytes());
        }
    }
    bin.extend([0, 1, 2, 0, 2, 3]);
    json["extensionsRequired"] = json!(["KHR_mesh_quantization"]);
    json["accessors"] = json!([
        { "bufferView": 0, "componentType": 5122, "normalized": true, "count": 4, "type": "VEC3" },
        { "bufferView": 1, "componentType": 5121, "count": 6, "type": "SCALAR" },
    ]);
    json["bufferViews"] = json!([
        { "buffer": 0, "byteLength": 32, "byteStride": 8 },
        { "buffer": 0, "byteOffset": 32, "byteLength": 6 },
    ]);
    json["buffers"] = json!([{ "byteLength": 38 }]);
    assert_eq!(area(&load_bytes(&glb(&json, &bin)).expect("square")), DVec3::Z);
}

/// Colours are floats or normalised integers; the range of other integers is not defined.
#[test]
fn colours_in_plain_integers_are_refused() {
    let load = |normalized: bool| {
        let (mut json, mut bin) = square();
        json["bufferViews"]
            .as_array_mut()
            .expect("views")
            .push(json!({ "buffer": 0, "byteOffset": bin.len(), "byteLength": 16 }));
        bin.extend([0, 255, 51, 255].repeat(4));
        json["buffers"][0]["byteLength"] = json!(bin.len());
        json["accessors"].as_array_mut().expect("accessors").push(json!(
            { "bufferView": 2, "componentType": 5121, "normalized": normalized, "count": 4, "type": "VEC4" }
        ));
        json["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"] = json!(2);
        load_bytes(&glb(&json, &bin))
    };
    let colours = load(true).expect("a square").colours;
    assert!((colours[3] - glam::Vec4::new(0.0, 1.0, 0.2, 1.0)).abs().max_element() < 1e-6);
    let message = load(false).expect_err("bytes").to_string();
    assert!(message.contains("primitive 0 COLOR_0") && message.contains("normalized"), "{message}");
}

#[test]
fn bad_values_are_errors_that_name_the_element() {
    let big = 1_u64 << 60;
    for (pointer, value, part) in [
        ("/accessors/0/count", json!(5), "accessor 0"),
        ("/accessors/0/count", json!(big), "accessor 0"),
        ("/accessors/0/byteOffset", json!(big), "accessor 0"),
        ("/accessors/0/bufferView", json!(9), "buffer view 9"),
        ("/accessors/0/componentType", json!(1), "accessor 0"),
        ("/accessors/0/type", json!("MAT4"), "accessor 0"),
        ("/accessors/0/type", json!("VEC2"), "accessor 0"),
        ("/accessors/1/componentType", json!(5126), "accessor 1"),
        ("/bufferViews/0/byteLength", json!(big), "buffer view 0"),
        ("/bufferViews/0/byteOffset", json!(70), "buffer view 0"),
        ("/bufferViews/0/byteStride", json!(4), "accessor 0"),
        ("/bufferViews/0/buffer", json!(3), "buffer 3"),
        ("/buffers/0/byteLength", json!(big), "buffer 0"),
        ("/buffers/0/uri", json!("../x.bin"), "buffer 0"),
        ("/buffers/0/uri", json!("data:;base64,*"), "buffer 0"),
        ("/nodes/0/mesh", json!(4), "mesh 4"),
        ("/nodes/0/children", json!([0]), "node 0"),
        ("/nodes/0/children", json!([7]), "node 7"),
        ("/meshes/0/primitives/0/mode", json!(9), "primitive 0"),
        ("/meshes/0/primitives/0/material", json!(2), "material 2"),
        ("/meshes/0/primitives/0/indices", json!(8), "accessor 8"),
        ("/meshes/0/primitives/0/attributes", json!({ "NORMAL": 0 }), "no triangle"),
        (
            "/meshes/0/primitives/0/attributes",
            json!({ "POSITION": 0, "TEXCOORD_0": 1 }),
            "accessor 1",
        ),
        ("/scenes/0/nodes", json!([1]), "node 1"),
        ("/asset/version", json!("1.0"), "version"),
        ("/asset", json!({}), "JSON"),
    ] {
        let result = with(pointer, value.clone());
        let message = result.err().unwrap_or_else(|| panic!("{pointer} = {value}")).to_string();
        assert!(message.contains(part), "{pointer} = {value}: {message}");
    }
    let (json, mut bin) = square();
    bin[16..20].copy_from_slice(&f32::NAN.to_le_bytes());
    let message = load_bytes(&glb(&json, &bin)).expect_err("NaN").to_string();
    assert!(message.contains("vertex 1"), "{message}");
    // A truncated file may load or be refused, but must not panic.
    let (json, bin) = square();
    let whole = glb(&json, &bin);
    for length in 0..whole.len() {
        let _ = load_bytes(&whole[..length]);
    }
}

#[test]
fn unsupported_required_extensions_are_refused_by_name() {
    for (name, remedy) in [
        ("KHR_draco_mesh_compression", "Draco"),
        ("EXT_meshopt_compression", "meshopt"),
        ("KHR_texture_basisu", "PNG"),
        ("ACME_thing", "without it"),
    ] {
        let message = with("/extensionsRequired", json!([name])).expect_err(name).to_string();
        assert!(message.contains(name) && message.contains(remedy), "{message}");
    }
    assert!(with("/extensionsRequired", json!(["KHR_materials_clearcoat"])).is_ok());
}

#[test]
fn whole_numbers_may_be_written_as_floats() {
    let model = with("/accessors/0/count", json!(4.0)).expect("square");
    assert_eq!(area(&model), DVec3::Z);
    let message = with("/accessors/0/count", json!(4.5)).expect_err("no whole number").to_string();
    assert!(message.contains("JSON") && message.contains("4.5"), "{message}");
}

#[test]
fn extras_may_be_of_any_type() {
    for extras in [json!("a word"), json!([1.5, null]), json!(7), json!({ "deep": { "er": [] } })] {
        for place in
            ["/extras", "/asset/extras", "/meshes/0/primitives/0/extras", "/nodes/0/extras"]
        {
            let model = with(place, extras.clone());
            assert_eq!(model.expect("a valid file").triangles.len(), 2, "{place}: {extras}");
        }
    }
}

#[test]
fn a_scene_without_nodes_is_valid_and_empty() {
    let (mut json, bin) = square();
    json["scenes"] = json!([{ "nodes": [0] }, { "name": "for later" }]);
    assert_eq!(load_bytes(&glb(&json, &bin)).expect("a valid file").triangles.len(), 2);
    json["scene"] = json!(1);
    let error = load_bytes(&glb(&json, &bin)).expect_err("nothing").to_string();
    assert!(error.contains("no triangle to render"), "{error}");
}

#[test]
fn a_mesh_without_an_area_is_refused() {
    let error = with("/nodes/0/scale", json!([0, 1, 1])).expect_err("a line").to_string();
    assert!(error.contains("no triangle has an area"), "{error}");
}

#[test]
fn byte_order_marks_are_skipped() {
    let (json, bin) = square();
    let uri = format!(
        "data:;base64,{}",
        base64::Engine::encode(&base64::engine::general_purpose::STANDARD, &bin)
    );
    let mut text = json.clone();
    text["buffers"][0]["uri"] = json!(uri);
    let text = format!("\u{feff}{text}");
    assert_eq!(area(&load_bytes(text.as_bytes()).expect("a mark")), DVec3::Z);
    let mut whole = glb(&json, &bin);
    // A GLB file may have a byte-order mark before its JSON.
    whole.splice(20..20, *b"\xef\xbb\xbf ");
    let length = u32::from_le_bytes([whole[12], whole[13], whole[14], whole[15]]) + 4;
    whole[12..16].copy_from_slice(&length.to_le_bytes());
    let length = whole.len() as u32;
    whole[8..12].copy_from_slice(&length.to_le_bytes());
    assert_eq!(area(&load_bytes(&whole).expect("a mark")), DVec3::Z);
    let wide: Vec<u8> = text.encode_utf16().flat_map(u16::to_le_bytes).collect();
    let message = load_bytes(&wide).expect_err("UTF-16").to_string();
    assert!(message.contains("UTF-16"), "{message}");
}

#[test]
fn geometry_that_only_extensions_define_is_refused() {
    for name in GEOMETRY {
        let message = with("/extensionsUsed", json!([name])).expect_err(name).to_string();
        assert!(message.contains(name) && message.contains("without it"), "{message}");
    }
    let primitive = "/meshes/0/primitives/0";
    let compressed = json!({ DRACO: { "bufferView": 0, "attributes": {} } });
    for (pointer, value, part) in [
        // A file that does not require Draco must have an uncompressed copy.
        (&*format!("{primitive}/extensions"), compressed.clone(), None),
        (
            "/accessors/0",
            json!({ "componentType": 5126, "count": 4, "type": "VEC3" }),
            Some("Draco"),
        ),
        (
            primitive,
            json!({ "attributes": {}, "extensions": { "ACME_shape": {} } }),
            Some("ACME_shape"),
        ),
        (
            "/buffers/0/extensions",
            json!({ "EXT_meshopt_compression": { "fallback": true } }),
            Some("meshopt"),
        ),
        ("/buffers/0/extensions", json!({ "ACME_thing": {} }), None),
    ] {
        let (mut json, bin) = square();
        json["meshes"][0]["primitives"][0]["extensions"] = compressed.clone();
        let (parent, key) = pointer.rsplit_once('/').expect("a path");
        let parent = json.pointer_mut(parent).expect(pointer);
        match parent {
            Value::Array(list) => list[0] = value,
            other => other[key] = value,
        }
        match (load_bytes(&glb(&json, &bin)), part) {
            (Ok(model), None) => assert_eq!(area(&model), DVec3::Z),
            (Err(error), Some(part)) => {
                let message = error.to_string();
                assert!(message.contains(part) && message.contains("export"), "{message}");
            }
            (Ok(_), Some(_)) => panic!("{pointer} loads"),
            (Err(error), None) => panic!("{pointer}: {error}"),
        }
    }
}

#[test]
fn unsupported_textures_of_transparent_materials_are_refused() {
    let (mut json, bin) = square();
    json["textures"] = json!([{ "extensions": { "KHR_texture_basisu": { "source": 0 } } }]);
    json["meshes"][0]["primitives"][0]["material"] = json!(0);
    for (mode, is_read) in [("OPAQUE", true), ("MASK", false), ("BLEND", false)] {
        let texture = json!({ "baseColorTexture": { "index": 0 } });
        json["materials"] = json!([{ "alphaMode": mode, "pbrMetallicRoughness": texture }]);
        match load_bytes(&glb(&json, &bin)) {
            Ok(model) => assert!(is_read && model.notes.len() == 1, "{mode}"),
            Err(error) => assert!(!is_read && error.to_string().contains("material 0"), "{error}"),
        }
    }
}
