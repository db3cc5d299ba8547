//! Folders as the apps of phones write them: intrinsics in each frame, names of any kind, fields that nobody else
//! has.

use serde_json::{Value, json};

use super::super::*;
use super::write::{Made, image};

fn load(made: &Made) -> Dataset {
    Dataset::load(made.path(), &LoadOptions::default()).unwrap_or_else(|e| panic!("{e}"))
}

/// Renames the photographs, moves intrinsics into the frames, and adds what an app adds.
fn exported(names: [&str; 3], points: &str, edit: impl Fn(&mut Value)) -> Made {
    let made = Made::transforms(|json| {
        for field in ["w", "h", "fl_x", "fl_y", "cx", "cy"] {
            let value = json[field].take();
            json.as_object_mut().unwrap().remove(field);
            for frame in json["frames"].as_array_mut().unwrap() {
                frame[field] = value.clone();
            }
        }
        for (frame, name) in json["frames"].as_array_mut().unwrap().iter_mut().zip(names) {
            frame["file_path"] = name.into();
        }
        json["ply_file_path"] = points.into();
        edit(json);
    });
    for (old, new) in ["a", "b", "c"].into_iter().zip(names) {
        let new = made.file(new);
        std::fs::create_dir_all(new.parent().unwrap()).unwrap();
        std::fs::rename(made.file(&format!("images/{old}.png")), new).unwrap();
    }
    std::fs::rename(made.file("points.ply"), made.file(points)).unwrap();
    made
}

#[test]
fn exports_of_apps_are_the_same_scene() {
    let made = Made::transforms(|_| ());
    let plain = load(&made);
    let each = |json: &mut Value, field: &str, value: Value| {
        for frame in json["frames"].as_array_mut().unwrap() {
            frame[field] = value.clone();
        }
    };
    let exports = [
        // Polycam, through nerfstudio: no lens at the top, a confidence in each frame.
        exported(
            ["./images/frame_00001.png", "./images/frame_00002.png", "./images/frame_00003.png"],
            "sparse_pc.ply",
            |json| {
                json["camera_model"] = "OPENCV".into();
                json["orientation_override"] = "none".into();
                json["applied_transform"] =
                    json!([[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]]);
                each(json, "blur_score", 42.5.into());
            },
        ),
        // Record3D: names without folders, numbers as names, depth beside them.
        exported(["rgb/0.png", "rgb/1.png", "rgb/10.png"], "sparse_pc.ply", |json| {
            each(json, "depth_path", "depth/0.exr".into());
            each(json, "timestamp", 1700000000.25.into());
            json["is_fisheye"] = false.into();
            json["aabb_scale"] = 16.into();
        }),
        // Spaces and brackets in names, distortion that is there and 0.
        exported(
            ["images/IMG 0001 (1).png", "images/IMG 0002 (1).png", "images/IMG 0003 (1).png"],
            "My points.ply",
            |json| {
                json["camera_model"] = "OPENCV".into();
                for field in ["k1", "k2", "k3", "p1", "p2"] {
                    each(json, field, 0.0.into());
                }
            },
        ),
        // Names of other scripts, fields that are null.
        exported(
            ["images/厨房 01.png", "images/厨房 02.png", "images/厨房 03 – Süd.png"],
            "点云.ply",
            |json| {
                json["camera_model"] = "PINHOLE".into();
                each(json, "mask_path", Value::Null);
                each(json, "colmap_im_id", 7.into());
            },
        ),
    ];
    for made in exports {
        let data = load(&made);
        assert_eq!(data.points, plain.points);
        assert_eq!(data.train.len(), 3, "{:?}", data.notes);
        for (view, other) in data.train.iter().zip(&plain.train) {
            assert_eq!(view.camera, other.camera, "{}", view.name);
            assert_eq!(view.source.load().unwrap(), other.source.load().unwrap(), "{}", view.name);
        }
    }
}

/// Phones focus and stabilise: each photograph has a camera of its own.
#[test]
fn each_photograph_may_have_a_camera_and_a_size_of_its_own() {
    let made = exported(["a 1.png", "b 2.png", "c 3.png"], "points.ply", |json| {
        let own = [("w", 12.0), ("h", 20.0), ("fl_x", 14.0), ("fl_y", 14.5), ("cx", 6.5)];
        for (field, value) in own {
            json["frames"][1][field] = value.into();
        }
        json["frames"][2]["k1"] = 0.05.into();
    });
    image(&made.file("b 2.png"), (12, 20), 9);
    let data = load(&made);
    let [a, b, c] = [0, 1, 2].map(|view| &data.train[view]);
    assert_eq!((a.camera.width, a.camera.fx), (20, 15.0));
    let camera = &b.camera;
    assert_eq!((camera.width, camera.height), (12, 20));
    assert_eq!((camera.fx, camera.fy, camera.cx, camera.cy), (14.0, 14.5, 6.5, 6.0));
    assert!(a.source.undistortion.is_none() && c.source.undistortion.is_some());
}

/// What such a file lacks is said of the frame that lacks it.
#[test]
fn a_frame_without_intrinsics_is_named() {
    for (field, words) in [("fl_x", "frames[1].fl_x, camera_angle_x"), ("fl_y", "")] {
        let made = exported(["a 1.png", "b 2.png", "c 3.png"], "points.ply", |json| {
            json["frames"][1].as_object_mut().unwrap().remove(field);
        });
        let loaded = Dataset::load(made.path(), &LoadOptions::default());
        match loaded {
            // One focal length is both.
            Ok(data) => assert_eq!((words, data.train[1].camera.fy), ("", 15.0)),
            Err(error) => {
                let message = error.to_string();
                for word in words.split(", ") {
                    assert!(!words.is_empty() && message.contains(word), "{message}");
                }
            }
        }
    }
}

/// Programs write where photographs lay on the machine that they ran on (RealityScan's `transforms.json`).
#[test]
fn paths_of_another_machine_are_found_in_the_folder_that_is_named() {
    let written = [r"C:\Users\me\walk\1\a.png", "/home/me/walk/2/b.png", "file:///home/me/c.png"];
    let made = Made::transforms(|json| {
        for (frame, path) in json["frames"].as_array_mut().unwrap().iter_mut().zip(written) {
            frame["file_path"] = path.into();
        }
        json["test_filenames"] = json!(["file:///home/me/c.png"]);
    });
    std::fs::create_dir_all(made.file("moved/1")).unwrap();
    std::fs::rename(made.file("images/a.png"), made.file("moved/1/a.png")).unwrap();
    for name in ["b.png", "c.png"] {
        std::fs::rename(made.file(&format!("images/{name}")), made.file(&format!("moved/{name}")))
            .unwrap();
    }
    // Of two with its name, the one in whose folder it lay.
    image(&made.file("moved/a.png"), (20, 12), 9);
    image(&made.file("masks/1/a.png"), (20, 12), 255);
    let options = LoadOptions { images: Some("moved".into()), ..LoadOptions::default() };
    let names = |made: &Made| {
        let data = Dataset::load(made.path(), &options).unwrap_or_else(|e| panic!("{e}"));
        let name = |view: &View| (view.name.clone(), view.source.mask.is_some());
        [data.train.iter().map(name).collect::<Vec<_>>(), data.test.iter().map(name).collect()]
    };
    let [train, test] = names(&made);
    assert_eq!(train, [("1/a.png".to_owned(), true), ("b.png".to_owned(), false)]);
    assert_eq!(test, [("c.png".to_owned(), false)]);
    // One that is not there is skipped by name, and links are not followed out of the folder.
    made.remove("moved/b.png");
    assert_eq!(names(&made)[0].len(), 1);
    let outside = tempfile::tempdir().unwrap();
    image(&outside.path().join("b.png"), (20, 12), 9);
    std::os::unix::fs::symlink(outside.path().join("b.png"), made.file("moved/b.png")).unwrap();
    let error = Dataset::load(made.path(), &options).unwrap_err().to_string();
    assert!(error.contains("symbolic link"), "{error}");
    // Nor does one that climbs lead anywhere.
    made.replace("transforms.json", "/home/me/walk/2", "/home/../2");
    let error = Dataset::load(made.path(), &options).unwrap_err().to_string();
    assert!(error.contains("`..`"), "{error}");
}
