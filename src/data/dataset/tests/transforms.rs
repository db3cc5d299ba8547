//! Tests of `transforms.json`: fields that change the cameras, the views or the points.

use serde_json::{Value, json};

use super::super::*;
use super::{assert_noted, load, load_with, names, refused};
use densify_fixtures::Made;

/// Axes that are uniformly scaled, as those of a scaled camera in Blender, change no pixel.
#[test]
fn uniformly_scaled_axes_do_not_matter() {
    let expected = load(&Made::transforms(|_| ()));
    for scale in [0.01, 1.5, 300.0] {
        let data = load(&Made::transforms(|json| {
            for row in 0..3 {
                for column in 0..3 {
                    let entry = &mut json["frames"][1]["transform_matrix"][row][column];
                    *entry = (scale * entry.as_f64().unwrap()).into();
                }
            }
        }));
        for (view, expected) in data.train.iter().zip(&expected.train) {
            let turn = view.camera.rotation - expected.camera.rotation;
            assert!(turn.to_cols_array().iter().all(|e| e.abs() < 1e-12), "{scale}: {turn}");
            let shift = view.camera.translation - expected.camera.translation;
            assert!(shift.length() < 1e-12, "{scale}: {shift}");
        }
    }
}

#[test]
fn fisheyes_may_be_marked_by_a_number() {
    for (value, is_fisheye) in
        [(json!(0), false), (json!(0.0), false), (json!(1), true), (Value::Null, false)]
    {
        let data = load(&Made::transforms(|json| json["is_fisheye"] = value.clone()));
        assert_eq!(data.train[0].source.undistortion.is_some(), is_fisheye, "{value}");
    }
}
