//! Tests of the features that place and deform geometry: skins, morph targets, instances, and hidden nodes.

use glam::{DVec3, Vec3};
use serde_json::json;

use super::super::*;
use super::{area, glb, load_bytes, square};

/// Adds an accessor of numbers, and returns its index.
fn append(json: &mut Value, bin: &mut Vec<u8>, kind: &str, values: &[f32]) -> usize {
    let size = match kind {
        "VEC3" => 3,
        "VEC4" => 4,
        _ => 16,
    };
    bin.resize(bin.len().next_multiple_of(4), 0);
    let view = json!({ "buffer": 0, "byteOffset": bin.len(), "byteLength": 4 * values.len() });
    bin.extend(values.iter().flat_map(|value| value.to_le_bytes()));
    json["buffers"][0]["byteLength"] = json!(bin.len());
    let views = json["bufferViews"].as_array_mut().expect("list");
    views.push(view);
    let accessor = json!({
        "bufferView": views.len() - 1, "componentType": 5126, "count": values.len() / size, "type": kind,
    });
    let accessors = json["accessors"].as_array_mut().expect("list");
    accessors.push(accessor);
    accessors.len() - 1
}

/// The square with a skin: its left corners follow the joint in node 2, its right corners those in nodes 2 and 3
/// with these `weights`.
fn skinned(weights: [f32; 2]) -> (Value, Vec<u8>) {
    let (mut json, mut bin) = square();
    let [a, b] = weights;
    let joints = append(&mut json, &mut bin, "VEC4", &[[0.0, 1.0, 0.0, 0.0]; 4].concat());
    let (left, right) = ([3.0, 0.0, 0.0, 0.0], [a, b, 0.0, 0.0]);
    let weights = append(&mut json, &mut bin, "VEC4", &[left, right, right, left].concat());
    // The second joint is scaled by one half, and its inverse bind matrix by two.
    let mut binds = [0.0; 32];
    for (i, value) in
        [(0, 1.0), (5, 1.0), (10, 1.0), (15, 1.0), (16, 2.0), (21, 2.0), (26, 2.0), (31, 1.0)]
    {
        binds[i] = value;
    }
    let binds = append(&mut json, &mut bin, "MAT4", &binds);
    json["scenes"][0]["nodes"] = json!([0, 1]);
    json["nodes"] = json!([
        // The transform of the mesh's own node is ignored.
        { "mesh": 0, "skin": 0, "translation": [100, 100, 100] },
        { "translation": [2, 0, 0], "children": [2] },
        { "children": [3] },
        { "translation": [0, 0, 4], "scale": [0.5, 0.5, 0.5] },
    ]);
    json["skins"] = json!([{ "joints": [2, 3], "inverseBindMatrices": binds }]);
    let attributes = &mut json["meshes"][0]["primitives"][0]["attributes"];
    attributes["JOINTS_0"] = json!(joints);
    attributes["WEIGHTS_0"] = json!(weights);
    (json, bin)
}

#[test]
fn skins_multiply_joint_transforms_by_inverse_bind_matrices() {
    for weights in [[0.5, 0.5], [0.2, 0.2]] {
        let (json, bin) = skinned(weights);
        let model = load_bytes(&glb(&json, &bin)).expect("a skin");
        for (found, expected) in model.positions.iter().zip([
            DVec3::new(2.0, 0.0, 0.0),
            DVec3::new(3.0, 0.0, 2.0),
            DVec3::new(3.0, 1.0, 2.0),
            DVec3::new(2.0, 1.0, 0.0),
        ]) {
            assert!(found.distance(expected) < 1e-6, "{found}, not {expected}");
        }
        assert!(model.notes.is_empty(), "{:?}", model.notes);
    }
    // Missing inverse bind matrices are identities, so the second joint halves the square.
    let (mut json, bin) = skinned([0.0, 1.0]);
    json["skins"][0].as_object_mut().expect("object").remove("inverseBindMatrices");
    let model = load_bytes(&glb(&json, &bin)).expect("a skin");
    assert_eq!(model.positions[2], DVec3::new(2.5, 0.5, 4.0));
    // A second set of joints is read; mirrored joints reverse the winding, as mirrored nodes do.
    let (mut json, bin) = skinned([1.0, 0.0]);
    let attributes = &mut json["meshes"][0]["primitives"][0]["attributes"];
    let (joints, weights) = (attributes["JOINTS_0"].clone(), attributes["WEIGHTS_0"].clone());
    attributes["JOINTS_1"] = joints;
    attributes["WEIGHTS_1"] = weights;
    json["nodes"][2]["scale"] = json!([-1, 1, 1]);
    let model = load_bytes(&glb(&json, &bin)).expect("a skin");
    assert_eq!((area(&model), model.positions[1]), (DVec3::Z, DVec3::X));
}

#[test]
fn skins_that_cannot_be_applied_are_refused() {
    let check = |pointer: &str, value: Value, part: &str| {
        let (mut json, bin) = skinned([0.5, 0.5]);
        *json.pointer_mut(pointer).expect(pointer) = value;
        let message = load_bytes(&glb(&json, &bin)).expect_err(pointer).to_string();
        assert!(message.contains(part), "{pointer}: {message}");
    };
    check("/nodes/0/skin", json!(1), "there is no skin 1");
    check("/skins/0/joints", json!([2, 3, 3]), "3 joints have 2 inverse bind matrices");
    check("/skins/0/joints", json!([2]), "there is no joint 1: the skin has 1");
    check("/skins/0/joints", json!([2, 9]), "node 9, is not in the scene");
    check("/nodes/1/children", json!([]), "node 2, is not in the scene");
    check("/skins/0/inverseBindMatrices", json!(0), "accessor 0");
    let attributes = "/meshes/0/primitives/0/attributes";
    check(attributes, json!({ "POSITION": 0 }), "vertex 0 has no weight");
    check(&format!("{attributes}/WEIGHTS_0"), json!(0), "accessor 0");
}

#[test]
fn morph_targets_with_weights_are_applied() {
    let (mut json, mut bin) = square();
    let normals = append(&mut json, &mut bin, "VEC3", &[[0.0, 0.0, 1.0]; 4].concat());
    let moved = append(&mut json, &mut bin, "VEC3", &[[2.0, 0.0, 0.0]; 4].concat());
    let raised = append(&mut json, &mut bin, "VEC3", &[[0.0, 0.0, 8.0]; 4].concat());
    let turned = append(&mut json, &mut bin, "VEC3", &[[1.0, 0.0, -1.0]; 4].concat());
    let primitive = &mut json["meshes"][0]["primitives"][0];
    primitive["attributes"]["NORMAL"] = json!(normals);
    primitive["targets"] = json!([{ "POSITION": moved, "NORMAL": turned }, { "POSITION": raised }, { "POSITION": 99 }]);
    let with = |weights: [Option<Value>; 2]| {
        let mut json = json.clone();
        for (place, weights) in ["/meshes/0", "/nodes/0"].into_iter().zip(weights) {
            let object = json.pointer_mut(place).and_then(Value::as_object_mut).expect("object");
            object.extend(weights.map(|weights| ("weights".to_owned(), weights)));
        }
        load_bytes(&glb(&json, &bin))
    };
    for (weights, corner, normal) in [
        ([None, None], [0.0; 3], Vec3::Z),
        ([Some(json!([1.0, 0.25, 0])), None], [2.0, 0.0, 2.0], Vec3::X),
        // A node's weights replace those of its mesh.
        ([Some(json!([1.0, 1.0])), Some(json!([0.0, 0.5]))], [0.0, 0.0, 4.0], Vec3::Z),
    ] {
        let model = with(weights.clone()).expect("a square");
        assert_eq!(
            (model.positions[0], model.normals[0]),
            (DVec3::from(corner), normal),
            "{weights:?}"
        );
    }
    for (weights, part) in [(json!([0, 0, 1]), "accessor 99"), (json!([0, 0, 0, 1]), "weight 3")] {
        let message = with([Some(weights), None]).expect_err("no such target").to_string();
        assert!(message.contains(part), "{message}");
    }
}

#[test]
fn instances_are_relative_to_their_node() {
    let (mut json, mut bin) = square();
    let half = 0.5_f32.sqrt();
    let at = append(&mut json, &mut bin, "VEC3", &[0.0, 0.0, 0.0, 5.0, 0.0, 0.0]);
    let turned = append(&mut json, &mut bin, "VEC4", &[0.0, 0.0, 0.0, 1.0, 0.0, 0.0, half, half]);
    let scaled = append(&mut json, &mut bin, "VEC3", &[1.0, 1.0, 1.0, 2.0, 3.0, 1.0]);
    json["extensionsRequired"] = json!([nodes::INSTANCING]);
    let attributes = json!({ "TRANSLATION": at, "ROTATION": turned, "SCALE": scaled, "_ID": 0 });
    json["nodes"] = json!([
        {
            "mesh": 0, "translation": [0, 10, 0], "children": [1],
            "extensions": { nodes::INSTANCING: { "attributes": attributes } },
        },
        // Children are not instanced.
        { "mesh": 0 },
    ]);
    let model = load_bytes(&glb(&json, &bin)).expect("instances");
    assert_eq!((model.triangles.len(), area(&model).round()), (6, 8.0 * DVec3::Z));
    assert!(
        model.positions[6].distance(DVec3::new(2.0, 12.0, 0.0)) < 1e-5,
        "{:?}",
        model.positions
    );
    assert!(model.notes.is_empty(), "{:?}", model.notes);
    let pointer = format!("/nodes/0/extensions/{}/attributes/SCALE", nodes::INSTANCING);
    for (value, part) in
        [(json!(0), "differ in length"), (json!("x"), "SCALE"), (json!(99), "accessor 99")]
    {
        let mut json = json.clone();
        *json.pointer_mut(&pointer).expect("scales") = value;
        let message = load_bytes(&glb(&json, &bin)).expect_err("no scales").to_string();
        assert!(message.contains("node 0") && message.contains(part), "{message}");
    }
    json["nodes"][0]["skin"] = json!(0);
    let message = load_bytes(&glb(&json, &bin)).expect_err("a skin").to_string();
    assert!(message.contains("with a skin"), "{message}");
}

#[test]
fn hidden_nodes_are_not_rendered() {
    let (mut json, bin) = square();
    json["nodes"] = json!([
        { "mesh": 0, "children": [1], "extensions": { nodes::VISIBILITY: { "visible": false } } },
        { "mesh": 0, "extensions": { nodes::VISIBILITY: { "visible": true } } },
        { "mesh": 0, "extensions": { nodes::VISIBILITY: {} } },
    ]);
    json["scenes"][0]["nodes"] = json!([0, 2]);
    assert_eq!(load_bytes(&glb(&json, &bin)).expect("a square").triangles.len(), 2);
}
