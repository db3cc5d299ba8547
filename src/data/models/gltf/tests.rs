//! Tests of the numbers in accessors, and of numbers that cannot be scales or opacities.

use std::path::Path;

use serde_json::{Value, json};

use super::accessors::{Accessor, Buffers, View};
use super::layout::{SPLATS, coefficient};
use super::read::SPZ;
use crate::models::ply::activation::may_be_logarithms;
use crate::models::read_model;
use densify_core::gaussians::Gaussians;

/// A normalised minimum is −1, like the value above it (glTF 2.0, section 3.11); without normalisation it keeps its
/// value.
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
    let document = json!({
        "asset": {"version": "2.0"}, "buffers": [{"uri": "data.bin", "byteLength": data.len()}],
        "bufferViews": views, "accessors": accessors, "nodes": [{"mesh": 0}], "meshes": [{"primitives": [primitive]}],
    });
    std::fs::write(&path, document.to_string()).unwrap();
    read_model(&path).map(|file| file.gaussians).map_err(|error| error.to_string())
}

/// Only sRGB is read; the draft of 2025 had other names than the standard.
#[test]
fn other_colour_spaces_and_kernels_are_refused() {
    let read = |stated| read_one([0.5; 3], 0.5, stated);
    for stated in [
        json!({}),
        json!({"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}),
        json!({"colorSpace": "BT.709-sRGB"}),
    ] {
        assert_eq!(read(stated.clone()).map(|model| model.len()), Ok(1), "{stated}");
    }
    for (key, value) in [
        ("colorSpace", json!("lin_rec709_display")),
        ("colorSpace", json!("BT.709-linear")),
        ("colorSpace", json!(1)),
        ("kernel", json!("box")),
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
