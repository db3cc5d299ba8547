//! Numbers of accessors.

use std::path::Path;

use serde_json::json;

use super::accessors::{Accessor, Buffers, View};

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
