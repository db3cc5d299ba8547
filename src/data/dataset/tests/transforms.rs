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

/// Each case has fields of the top level and of the second frame, and the focal lengths of that frame.
#[test]
fn focal_lengths_of_a_frame_override_those_at_the_top_level() {
    let (x, y) = (10.0 / 0.5_f64.tan(), 6.0 / 0.4_f64.tan());
    let degrees = 1.0_f64.to_degrees();
    for (top, frame, expected) in [
        (json!({"fl_x": 15, "fl_y": 16}), json!({}), (15.0, 16.0)),
        (json!({"fl_x": 15}), json!({"camera_angle_x": 1.0}), (x, x)),
        (json!({"fl_x": 15, "fl_y": 16}), json!({"camera_angle_x": 1.0}), (x, x)),
        (json!({"fl_x": 15, "fl_y": 16}), json!({"fl_x": 12}), (12.0, 12.0)),
        (json!({"fl_x": 15}), json!({"fl_y": 12}), (15.0, 12.0)),
        (json!({"fl_y": 16}), json!({"fl_x": 12}), (12.0, 16.0)),
        (json!({"camera_angle_x": 1.0}), json!({"fl_x": 12, "fl_y": 13}), (12.0, 13.0)),
        (json!({"fl_x": 15, "camera_angle_x": 1.0}), json!({}), (15.0, 15.0)),
        (json!({"fl_x": 15, "camera_angle_y": 0.8}), json!({}), (15.0, y)),
        (json!({"camera_angle_y": 0.8}), json!({}), (y, y)),
        (json!({"fl_y": 16}), json!({}), (16.0, 16.0)),
        (json!({"x_fov": degrees}), json!({}), (x, x)),
        (json!({"fl_x": 15}), json!({"x_fov": degrees, "camera_angle_y": 0.8}), (x, y)),
    ] {
        let data = load(&Made::transforms(|json| {
            for field in ["fl_x", "fl_y"] {
                json.as_object_mut().unwrap().remove(field);
            }
            for (field, value) in top.as_object().unwrap() {
                json[field] = value.clone();
            }
            for index in 0..3 {
                for (field, value) in frame.as_object().unwrap() {
                    json["frames"][index][field] = value.clone();
                }
            }
        }));
        let camera = &data.train[1].camera;
        let error = (camera.fx - expected.0).abs() + (camera.fy - expected.1).abs();
        assert!(error < 1e-12, "{top}, {frame}: {}, {}", camera.fx, camera.fy);
    }
}

#[test]
fn fields_that_change_little_are_noted_and_unused_ones_are_not() {
    let used = load(&Made::transforms(|json| {
        json["rolling_shutter"] = json!([0.0, 0.0, 1.0]);
        json["frames"][1]["transform_matrix_end"] = json["frames"][1]["transform_matrix"].clone();
        json["sharpness_discard_threshold"] = 0.5.into();
        json["sharpen"] = 1.into();
        json["n_frames"] = 2.into();
    }));
    assert_eq!(used.train.len(), 3);
    for words in [
        "transforms.json: rolling_shutter is not honoured",
        "transform_matrix_end",
        "sharpness_discard_threshold",
        "transforms.json: sharpen is",
        "n_frames = 2, all 3 frames",
    ] {
        assert_noted(&used, words);
    }
    let unused = load(&Made::transforms(|json| {
        json["rolling_shutter"] = json!([0.0, 0, 0.0, 0.0]);
        json["sharpness_discard_threshold"] = 0.into();
        json["n_frames"] = 3.into();
        for field in ["equirectangular", "latlong", "white_transparent", "sharpen"] {
            json[field] = false.into();
        }
        json["black_transparent"] = Value::Null;
        json["ftheta_p0"] = 0.0.into();
    }));
    assert!(!unused.notes.iter().any(|note| note.contains("honoured")), "{:?}", unused.notes);
}

/// Moves the second frame to ScanNet++'s list of frames for tests.
fn with_test_frames(json: &mut Value) {
    let frame = json["frames"].as_array_mut().unwrap().remove(1);
    json["test_frames"] = json!([frame]);
}

#[test]
fn test_frames_are_held_out_and_bad_frames_left_out() {
    let made = Made::transforms(with_test_frames);
    let eval = LoadOptions { split: Split::Eval, ..LoadOptions::default() };
    for options in [&LoadOptions::default(), &eval] {
        let data = load_with(&made, options);
        assert_eq!(names(&data.train), ["images/a.png", "images/c.png"]);
        assert_eq!(names(&data.test), ["images/b.png"]);
    }
    // If every K-th view is held out by option, all frames are divided.
    let every = Split::Every(std::num::NonZeroU32::new(3).unwrap());
    let data = load_with(&made, &LoadOptions { split: every, ..LoadOptions::default() });
    assert_eq!(names(&data.train), ["images/b.png", "images/c.png"]);
    assert_eq!(names(&data.test), ["images/a.png"]);

    let data = load(&Made::transforms(|json| {
        json["frames"][0]["is_bad"] = false.into();
        json["frames"][2]["is_bad"] = true.into();
        json["test_frames"] = json!([]);
    }));
    assert_eq!((names(&data.train).len(), data.test.len()), (2, 0));
    assert_noted(&data, "1 of 3 frames are marked is_bad, first: ./images/c.png");
    let made = Made::transforms(|json| {
        for frame in json["frames"].as_array_mut().unwrap() {
            frame["is_bad"] = true.into();
        }
    });
    refused("all", &made, &LoadOptions::default(), "transforms.json, is_bad, marks all frames");
}

#[test]
fn contradicting_divisions_are_refused() {
    let options = LoadOptions::default();
    let made = Made::transforms(|json| {
        with_test_frames(json);
        json["train_filenames"] = json!(["images/a.png"]);
    });
    refused("lists", &made, &options, "test_frames, train_filenames divides, remove one");
    let made = Made::transforms(|json| {
        with_test_frames(json);
        json["frames"][0] = json["test_frames"][0].clone();
    });
    refused("shared", &made, &options, "transforms.json, test_frames, images/b.png is in `frames`");
    let made = Made::transforms(with_test_frames);
    let text = std::fs::read(made.file("transforms.json")).unwrap();
    made.write("transforms_train.json", &text);
    made.write("transforms_test.json", &text);
    refused("pair", &made, &options, "transforms_train.json, test_frames, transforms_test.json");
}

#[test]
fn initial_points_are_found_under_their_usual_names() {
    for name in ["pointcloud.ply", "init.ply"] {
        let made = Made::transforms(|json| json["ply_file_path"] = Value::Null);
        assert!(load(&made).points.is_empty());
        std::fs::rename(made.file("points.ply"), made.file(name)).unwrap();
        let data = load(&made);
        assert_eq!(data.points.len(), 200, "{name}");
        assert_noted(&data, &format!("initial points are taken from {name}"));
    }
    // A PLY file may have any name.
    let made = Made::transforms(|json| json["ply_file_path"] = "points.txt".into());
    std::fs::rename(made.file("points.ply"), made.file("points.txt")).unwrap();
    assert_eq!(load(&made).points.len(), 200);
}

#[test]
fn a_splat_model_in_place_of_points_is_noted() {
    let made = Made::transforms(|_| ());
    let properties = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0"];
    let properties = properties.map(|name| format!("property float {name}\n")).concat();
    let header = format!("ply\nformat ascii 1.0\nelement vertex 1\n{properties}end_header\n");
    made.write("points.ply", header + "1 2 3 0 0 0 0 -3\n");
    assert_noted(&load(&made), "points.ply: this is a splat model, start from the model");
}
