//! Tests of the numbers in accessors, of numbers that cannot be scales or opacities, and of what is refused or noted.

use std::path::Path;

use serde_json::{Value, json};

use super::accessors::{Accessor, Buffers, View};
use super::layout::{SPLATS, coefficient};
use super::nodes::VISIBILITY;
use super::read::SPZ;
use crate::models::ply::activation::may_be_logarithms;
use crate::models::{SplatFile, read_model};
use densify_core::gaussians::Gaussians;

/// If normalised, the smallest integer is −1, as is the next larger one (glTF 2.0, section 3.11); otherwise it keeps
/// its value.
#[test]
fn signed_integers_keep_their_minimum_unless_normalised() {
    let bytes = [-128i8, -127, 127].map(|v| v as u8).to_vec();
    let shorts = [-32_768i16, -32_767, 32_767].map(i16::to_le_bytes).concat();
    for (component_type, data, plain) in
        [(5120, bytes, [-128.0, -127.0, 127.0]), (5122, shorts, [-32_768.0, -32_767.0, 32_767.0])]
    {
        for (normalized, expected) in [(true, [-1.0, -1.0, 1.0]), (false, plain)] {
            let accessor = json!({
                "bufferView": 0, "componentType": component_type, "normalized": normalized,
                "count": 1, "type": "VEC3",
            });
            let accessors = [serde_json::from_value::<Accessor>(accessor).unwrap()];
            let view = json!({"buffer": 0, "byteLength": data.len()});
            let views = [serde_json::from_value::<View>(view).unwrap()];
            let path = Path::new("model.gltf");
            let buffers =
                Buffers { path, accessors: &accessors, views: &views, buffers: vec![data.clone()] };
            let numbers = buffers.numbers("ROTATION", 0, 3).unwrap();
            assert_eq!(numbers, expected, "type {component_type}, normalised: {normalized}");
        }
    }
}

/// Reads a model of one splat; `stated` are the properties of the extension.
fn read_one(scale: [f32; 3], opacity: f32, stated: Value) -> Result<Gaussians, String> {
    read_changed(scale, opacity, stated, |_| ()).map(|file| file.gaussians)
}

/// As [`read_one`], after a change of the document.
fn read_changed(
    scale: [f32; 3],
    opacity: f32,
    stated: Value,
    change: impl Fn(&mut Value),
) -> Result<SplatFile, String> {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("model.gltf");
    let (mut data, mut views, mut accessors) = (Vec::new(), Vec::new(), Vec::new());
    let mut attributes = serde_json::Map::new();
    for (name, shape, values) in [
        ("POSITION".to_owned(), "VEC3", &[0.0; 3][..]),
        (format!("{SPLATS}:ROTATION"), "VEC4", &[0.0, 0.0, 0.0, 1.0]),
        (format!("{SPLATS}:SCALE"), "VEC3", &scale),
        (format!("{SPLATS}:OPACITY"), "SCALAR", &[opacity]),
        (coefficient(0, 0), "VEC3", &[0.0; 3]),
    ] {
        attributes.insert(name, json!(views.len()));
        accessors.push(json!({
            "bufferView": views.len(), "componentType": 5126, "count": 1, "type": shape,
        }));
        let bytes = 4 * values.len();
        views.push(json!({"buffer": 0, "byteOffset": data.len(), "byteLength": bytes}));
        data.extend(values.iter().flat_map(|value| value.to_le_bytes()));
    }
    std::fs::write(folder.path().join("data.bin"), &data).unwrap();
    let primitive = json!({"attributes": attributes, "extensions": {SPLATS: stated}});
    let mut document = json!({
        "asset": {"version": "2.0"}, "buffers": [{"uri": "data.bin", "byteLength": data.len()}],
        "bufferViews": views, "accessors": accessors, "nodes": [{"mesh": 0}], "meshes": [{"primitives": [primitive]}],
    });
    change(&mut document);
    std::fs::write(&path, document.to_string()).unwrap();
    read_model(&path).map_err(|error| error.to_string())
}

/// Only sRGB is read; the draft of 2025 had other names than the standard.
#[test]
fn other_colour_spaces_and_kernels_are_refused() {
    let read = |stated| read_one([0.5; 3], 0.5, stated);
    for stated in [
        json!({}),
        json!({"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}),
        json!({"colorSpace": "BT.709-sRGB", "projection": "perspective"}),
    ] {
        assert_eq!(read(stated.clone()).map(|model| model.len()), Ok(1), "{stated}");
    }
    for (key, value) in [
        ("colorSpace", json!("lin_rec709_display")),
        ("colorSpace", json!("BT.709-linear")),
        ("colorSpace", json!(1)),
        ("kernel", json!("box")),
        ("projection", json!("orthographic")),
    ] {
        // Splats in SPZ state their colours in the same place.
        let spz = json!({SPZ: {"bufferView": 0}});
        for stated in [json!({key: value}), json!({key: value, "extensions": spz})] {
            let message = read(stated).unwrap_err();
            for word in [key, &value.to_string(), "model.gltf"] {
                assert!(message.contains(word), "{message}");
            }
        }
    }
}

/// The notes on a document of one splat after a change, or the error.
fn notes(stated: Value, change: impl Fn(&mut Value)) -> Result<Vec<String>, String> {
    read_changed([0.5; 3], 0.5, stated, change).map(|file| file.notes)
}

#[test]
fn what_has_no_effect_is_noted() {
    let none = |_: &mut Value| ();
    assert_eq!(notes(json!({"sortingMethod": "cameraDistance"}), none), Ok(Vec::new()));
    let found = notes(json!({"sortingMethod": "zDepth"}), none).unwrap();
    assert_eq!(found, ["sortingMethod \"zDepth\" is ignored: splats are sorted by their depth"]);
    for (field, value, note) in [
        ("animations", json!([{"samplers": [], "channels": []}]), Some("animations are ignored")),
        ("animations", json!([]), None),
        ("extensionsUsed", json!([SPLATS, VISIBILITY, "KHR_materials_unlit"]), None),
        ("extensionsUsed", json!([SPLATS, "EXT_x", "EXT_y"]), Some("are ignored: EXT_x, EXT_y")),
    ] {
        let found = notes(json!({}), |document| document[field] = value.clone()).unwrap();
        assert_eq!(found.len(), usize::from(note.is_some()), "{field}: {found:?}");
        assert!(note.is_none_or(|note| found[0].contains(note)), "{field}: {found:?}");
    }
}

/// A hidden node hides the nodes below it.
#[test]
fn hidden_splats_are_left_out() {
    let hidden = json!({VISIBILITY: {"visible": false}});
    let parent = json!({"children": [1], "extensions": hidden});
    let with = |nodes: Value| {
        read_changed([0.5; 3], 0.5, json!({}), |document| {
            document["extensionsRequired"] = json!([VISIBILITY]);
            document["nodes"] = nodes.clone();
        })
    };
    let shown = json!({"mesh": 0, "extensions": {VISIBILITY: {"visible": true}}});
    let file = with(json!([shown])).unwrap();
    assert_eq!((file.gaussians.len(), file.notes.len()), (1, 0));
    let file = with(json!([parent, shown, {"mesh": 0}])).unwrap();
    assert_eq!((file.gaussians.len(), file.notes.len()), (1, 1));
    assert!(file.notes[0].contains("hidden nodes (KHR_node_visibility)"), "{:?}", file.notes);
    let message = with(json!([parent, shown])).unwrap_err();
    assert!(message.contains("all splats are hidden") && message.contains("show"), "{message}");
}

#[test]
fn nodes_that_cannot_be_applied_to_splats_are_refused() {
    let with = |node: Value| notes(json!({}), |document| document["nodes"] = json!([node.clone()]));
    let instances = json!({"EXT_mesh_gpu_instancing": {"attributes": {"TRANSLATION": 0}}});
    for (node, words) in [
        (json!({"mesh": 0, "extensions": instances}), "nodes[0]: EXT_mesh_gpu_instancing"),
        (json!({"mesh": 0, "skin": 0}), "nodes[0]: a skin"),
        (json!({"mesh": 0, "scale": [-1, 1, 1]}), "mirror image"),
        (json!({"mesh": 0, "scale": [1, 2, 1]}), "shear or an uneven scale"),
    ] {
        let message = with(node).unwrap_err();
        assert!(message.contains(words) && message.contains("model.gltf"), "{message}");
    }
    // Nodes without splats may have them.
    let other = json!([{"mesh": 0}, {"scale": [-1, 2, 1], "skin": 0, "extensions": instances}]);
    assert_eq!(notes(json!({}), |document| document["nodes"] = other.clone()), Ok(Vec::new()));
}

/// Without a scene, the nodes without a parent are its roots.
#[test]
fn nodes_below_others_move_with_them_in_files_without_scenes() {
    let nodes =
        json!([{"mesh": 0, "translation": [1, 0, 0]}, {"children": [0], "translation": [0, 2, 0]}]);
    let change = |document: &mut Value| document["nodes"] = nodes.clone();
    let found = read_changed([0.5; 3], 0.5, json!({}), change).unwrap().gaussians;
    assert_eq!((found.len(), found.position(0)), (1, [-1.0, -2.0, 0.0]));
    let message = notes(json!({}), |document| document["scene"] = json!(3)).unwrap_err();
    assert!(message.contains("there is no scene 3"), "{message}");
}

/// No coefficient of spherical harmonics is left out silently.
#[test]
fn incomplete_degrees_are_refused_with_the_coefficient() {
    let with = |names: &[(u8, u8)]| {
        notes(json!({}), |document| {
            let attributes = &mut document["meshes"][0]["primitives"][0]["attributes"];
            for &(degree, n) in names {
                attributes[coefficient(degree, n)] = attributes[coefficient(0, 0)].clone();
            }
        })
    };
    let whole = |degree: u8| (1..=degree).flat_map(|d| (0..=2 * d).map(move |n| (d, n)));
    for degree in 0..=3 {
        assert_eq!(with(&whole(degree).collect::<Vec<_>>()), Ok(Vec::new()), "degree {degree}");
    }
    let four: Vec<(u8, u8)> = whole(4).collect();
    for (names, words) in [
        (&[(1, 1), (1, 2), (1, 3)][..], &["SH_DEGREE_1_COEF_1", "missing"][..]),
        (&[(1, 0), (1, 2)], &["there is no", "SH_DEGREE_1_COEF_1"]),
        (&[(2, 0), (2, 1), (2, 2), (2, 3), (2, 4)], &["SH_DEGREE_2_COEF_0", "missing"]),
        (&[(1, 0), (1, 1), (1, 2), (1, 3)], &["SH_DEGREE_1_COEF_3", "no coefficient"]),
        (&four, &["SH_DEGREE_4_COEF_0", "colours have degree 4, but densify reads 0 to 3"]),
    ] {
        let message = with(names).unwrap_err();
        assert!(words.iter().all(|word| message.contains(word)), "{words:?}: {message}");
    }
}

/// Exporters that copy the values of a PLY write logarithms and logits.
#[test]
fn logarithms_and_logits_are_refused_with_the_reason() {
    let read = |scale: f32, opacity: f32| read_one([0.5, scale, 0.5], opacity, json!({}));
    // Rounding may lead to opacities slightly above 1.
    for (scale, opacity) in [(0.2, 0.9), (0.0, 0.0), (80.0, 1.0), (0.2, 1.000_001)] {
        assert_eq!(read(scale, opacity).map(|model| model.len()), Ok(1), "{scale}, {opacity}");
    }
    for (scale, opacity, words) in [
        (0.2, 2.197, ["model.gltf", ":OPACITY", "2.197", "logit"]),
        (0.2, -3.0, ["model.gltf", ":OPACITY", "-3", "logit"]),
        (-1.6, 0.9, ["model.gltf", ":SCALE", "-1.6", "logarithm"]),
    ] {
        let message = read(scale, opacity).unwrap_err();
        assert!(words.iter().all(|word| message.contains(word)), "{message}");
    }
}

/// In a scene of a thousand units, all logarithms may be positive, so that their signs tell nothing.
#[test]
fn scales_that_may_be_logarithms_are_noted() {
    let mut model = Gaussians::default();
    for row in 0..1000_u16 {
        let at = |prime: u16| f32::from(row * prime % 1000);
        model.means.push([at(7), at(11), at(13)]);
    }
    let scales = |axes: &dyn Fn(f32) -> [f32; 3]| -> Vec<[f32; 3]> {
        (0..1000_u16).map(|row| axes(f32::from(row * 37 % 1000) / 1000.0)).collect()
    };
    let logarithms = scales(&|x| [1.0 + 3.0 * x, 1.5 + 2.0 * x, 0.5 + x]);
    let flat = scales(&|x| [1.0 + 3.0 * x, 1.5 + 2.0 * x, 0.01 * x]);
    let small = scales(&|x| [0.1 + 0.3 * x, 0.2 + 0.1 * x, 0.05 + x * 0.01]);
    let found = [logarithms, flat, small].map(|scales| may_be_logarithms(&model, &scales));
    assert_eq!(found, [true, false, false]);
}
