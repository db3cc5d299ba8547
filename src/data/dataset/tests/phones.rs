//! Tests of datasets as phone apps export them: intrinsics per frame, arbitrary names, additional fields.

use serde_json::{Value, json};

use super::super::*;
use super::{assert_noted, load, load_with, names, refused};
use densify_fixtures::{Made, image};

/// Renames the photographs, moves intrinsics into the frames, and adds the fields of an app.
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
fn exports_of_phone_apps_load_as_the_same_scene() {
    let made = Made::transforms(|_| ());
    let plain = load(&made);
    let each = |json: &mut Value, field: &str, value: Value| {
        for frame in json["frames"].as_array_mut().unwrap() {
            frame[field] = value.clone();
        }
    };
    let exports = [
        // Polycam, through nerfstudio: no intrinsics at the top level, a blur score in each frame.
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
        // Record3D: numbers as names of files, depth images beside the photographs.
        exported(["rgb/0.png", "rgb/1.png", "rgb/10.png"], "sparse_pc.ply", |json| {
            each(json, "depth_path", "depth/0.exr".into());
            each(json, "timestamp", 1700000000.25.into());
            json["is_fisheye"] = false.into();
            json["aabb_scale"] = 16.into();
        }),
        // Spaces and brackets in names, distortion fields that are all 0.
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
        // Names in other scripts, fields that are null.
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

/// Phones focus and stabilise, so that each photograph has its own camera.
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

/// Missing intrinsics are reported with the frame that lacks them.
#[test]
fn a_frame_without_intrinsics_is_named() {
    let without = |fields: &[&str]| {
        exported(["a 1.png", "b 2.png", "c 3.png"], "points.ply", |json| {
            for field in fields {
                json["frames"][1].as_object_mut().unwrap().remove(*field);
            }
        })
    };
    let options = LoadOptions::default();
    refused("none", &without(&["fl_x", "fl_y"]), &options, "frames[1].fl_x, camera_angle_x");
    // One focal length is used for both axes.
    for (field, focal) in [("fl_x", 16.0), ("fl_y", 15.0)] {
        let camera = load(&without(&[field])).train[1].camera;
        assert_eq!((camera.fx, camera.fy), (focal, focal));
    }
}

/// Programs write the paths of the machine that they ran on (RealityScan's `transforms.json`).
#[test]
fn paths_of_another_machine_are_found_in_the_folder_that_the_options_name() {
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
    // Of two files with the same name, the one with the longer matching path counts.
    image(&made.file("moved/a.png"), (20, 12), 9);
    image(&made.file("masks/1/a.png"), (20, 12), 255);
    let options = LoadOptions { images: Some("moved".into()), ..LoadOptions::default() };
    let names = |made: &Made| {
        let data = load_with(made, &options);
        let name = |view: &View| (view.name.clone(), view.source.mask.is_some());
        [data.train.iter().map(name).collect::<Vec<_>>(), data.test.iter().map(name).collect()]
    };
    let [train, test] = names(&made);
    assert_eq!(train, [("1/a.png".to_owned(), true), ("b.png".to_owned(), false)]);
    assert_eq!(test, [("c.png".to_owned(), false)]);
    // Missing photographs are skipped and named, and links are not followed out of the folder.
    made.remove("moved/b.png");
    assert_eq!(names(&made)[0].len(), 1);
    let outside = tempfile::tempdir().unwrap();
    image(&outside.path().join("b.png"), (20, 12), 9);
    std::os::unix::fs::symlink(outside.path().join("b.png"), made.file("moved/b.png")).unwrap();
    let error = Dataset::load(made.path(), &options).unwrap_err().to_string();
    assert!(error.contains("symbolic link"), "{error}");
    // Paths with `..` are refused.
    made.replace("transforms.json", "/home/me/walk/2", "/home/../2");
    let error = Dataset::load(made.path(), &options).unwrap_err().to_string();
    assert!(error.contains("`..`"), "{error}");
}

/// Paths of any system are found, whatever their root, with or without a file extension.
#[test]
fn paths_of_any_system_are_found_by_suffix() {
    let with_images = || LoadOptions { images: Some("moved".into()), ..LoadOptions::default() };
    for (written, found) in [
        ("file:///C:/Users/me/b.png", Some("b.png")),
        (r"\\?\C:\Users\me\b.png", Some("b.png")),
        (r"\\host\share\walk\b.png", Some("b.png")),
        ("C:b.png", Some("b.png")),
        ("/home/x:y/walk/b.png", Some("b.png")),
        ("/home/me/b", Some("b")),
        (r"C:\Users\me\none.png", None),
    ] {
        let made = Made::transforms(|json| json["frames"][1]["file_path"] = written.into());
        std::fs::rename(made.file("images"), made.file("moved")).unwrap();
        let data = load_with(&made, &with_images());
        let mut expected = vec!["images/a.png", "images/c.png"];
        expected.extend(found);
        expected.sort_unstable();
        assert_eq!(names(&data.train), expected, "{written}");
    }
    for (written, words) in [
        (r"C:\", "frames[1].file_path, is empty"),
        ("file:///", "frames[1].file_path, is empty"),
        ("/home/../b.png", "frames[1].file_path, `..`"),
        ("/home/me/b.png\u{7}", "frames[1].file_path, control character"),
    ] {
        let made = Made::transforms(|json| json["frames"][1]["file_path"] = written.into());
        std::fs::create_dir(made.file("moved")).unwrap();
        refused("phones", &made, &with_images(), words);
    }
    // Other formats match suffixes, too.
    let colmap = Made::colmap_txt();
    colmap.replace("sparse/0/images.txt", "b.png", "C:/walk/b.png");
    let table = Made::realitycapture();
    table.replace("cameras.csv", "images/b.png", r"C:\walk\b.png");
    for (made, folder) in [(colmap, ""), (table, "images/")] {
        refused("phones", &made, &LoadOptions::default(), "C:, is absolute, OtherImagesFolder");
        std::fs::rename(made.file("images"), made.file("moved")).unwrap();
        let data = load_with(&made, &with_images());
        let [a, c] = ["a.png", "c.png"].map(|name| format!("{folder}{name}"));
        let mut expected = ["b.png", &*a, &*c];
        expected.sort_unstable();
        assert_eq!(names(&data.train), expected);
    }
}

/// Two paths with the same suffix would refer to one file, which could then be both trained on and held out.
#[test]
fn two_paths_to_one_photograph_are_refused() {
    let twice = ["/x/train/r_0.png", "/x/test/r_0.png"];
    let made = Made::transforms(|json| {
        for (frame, path) in json["frames"].as_array_mut().unwrap().iter_mut().zip(twice) {
            frame["file_path"] = path.into();
        }
    });
    for path in ["moved/r_0.png", "moved/c.png"] {
        image(&made.file(path), (20, 12), 9);
    }
    let options = LoadOptions { images: Some("moved".into()), ..LoadOptions::default() };
    let words = "/x/train/r_0.png, /x/test/r_0.png, same file, moved/r_0.png, ImagesFolderOfBoth";
    refused("phones", &made, &options, words);
    let all = std::fs::read_to_string(made.file("transforms.json")).unwrap();
    let all: Value = serde_json::from_str(&all).unwrap();
    for (file, frames) in
        [("transforms_train.json", &[0, 2][..]), ("transforms_test.json", &[1][..])]
    {
        let mut part = all.clone();
        part["frames"] = frames.iter().map(|&at: &usize| all["frames"][at].clone()).collect();
        made.write(file, part.to_string());
    }
    refused("phones", &made, &options, words);
    // In separate folders they are different files.
    for path in ["moved/train/r_0.png", "moved/test/r_0.png"] {
        image(&made.file(path), (20, 12), 9);
    }
    let data = load_with(&made, &options);
    assert_eq!((data.train.len(), &*data.test[0].name), (2, "test/r_0.png"));
}

#[test]
fn masks_and_points_of_another_machine_are_found_too() {
    let options = LoadOptions { images: Some("moved".into()), ..LoadOptions::default() };
    let made = || {
        let made = Made::transforms(|json| {
            json["ply_file_path"] = "/home/me/walk/points.ply".into();
            json["frames"][1]["file_path"] = "/home/me/walk/b.png".into();
            json["frames"][1]["mask_path"] = "/home/me/walk/masks/hidden.png".into();
            json["test_filenames"] = json!(["b.png"]);
        });
        std::fs::rename(made.file("images"), made.file("moved")).unwrap();
        made
    };
    let load = |made: &Made| load_with(made, &options);
    let mask_path = |data: &Dataset| data.test[0].source.mask.clone().unwrap().file.path;
    let found = made();
    for path in ["masks/hidden.png", "masks/b.png", "hidden.png"] {
        image(&found.file(path), (20, 12), 255);
    }
    let data = load(&found);
    assert_eq!((data.train.len(), data.test.len(), data.points.len()), (2, 1, 200));
    assert!(mask_path(&data).ends_with("masks/hidden.png"));
    // Otherwise the mask is found by the photograph's name; a file of the mask's bare name may be a photograph.
    found.remove("masks/hidden.png");
    assert!(mask_path(&load(&found)).ends_with("masks/b.png"));
    found.remove("masks/b.png");
    refused("phones", &found, &options, "frames[1].mask_path, hidden.png, `masks/`");
    // Points that were not copied with the photographs are left out.
    let without_points = made();
    image(&without_points.file("masks/b.png"), (20, 12), 255);
    without_points.remove("points.ply");
    let data = load(&without_points);
    assert!(data.points.is_empty());
    assert_noted(&data, "points.ply, left out");
    // Without a folder of images in the options, no path is guessed.
    let [moved, images] = ["moved", "images"].map(|name| without_points.file(name));
    std::fs::rename(moved, images).unwrap();
    let words = "is absolute, OtherImagesFolder";
    refused("phones", &without_points, &LoadOptions::default(), words);
}

#[test]
fn names_may_contain_backslashes() {
    let made = Made::transforms(|json| {
        json["ply_file_path"] = r"cloud\points.ply".into();
        json["frames"][1]["file_path"] = r"images\b.png".into();
        json["frames"][1]["mask_path"] = r"hidden\b.png".into();
        json["test_filenames"] = json!([r"images\a.png"]);
    });
    std::fs::create_dir(made.file("cloud")).unwrap();
    std::fs::rename(made.file("points.ply"), made.file("cloud/points.ply")).unwrap();
    image(&made.file("hidden/b.png"), (20, 12), 255);
    let data = load(&made);
    assert_eq!(names(&data.train), ["images/b.png", "images/c.png"]);
    assert_eq!(names(&data.test), ["images/a.png"]);
    assert!(data.train[0].source.mask.is_some() && data.points.len() == 200);
    std::fs::rename(made.file("images"), made.file("moved")).unwrap();
    let options = LoadOptions { images: Some("moved".into()), ..LoadOptions::default() };
    assert_eq!(Dataset::load(made.path(), &options).unwrap().train.len(), 2);
    // A file of the literal name takes precedence, on systems that allow it.
    #[cfg(unix)]
    {
        std::fs::rename(made.file("moved"), made.file("images")).unwrap();
        image(&made.file(r"images\b.png"), (20, 12), 7);
        assert_eq!(load(&made).train[1].source.load().unwrap().rgb[0], 7);
    }
}
