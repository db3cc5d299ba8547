//! Tests of formats and options: the same scene in every format loads as the same dataset.

use std::num::NonZeroU32;
use std::path::PathBuf;

use super::super::*;
use super::{assert_noted, load, load_with, names};
use densify_fixtures::{Made, NAMES, SIZE, image};

#[test]
fn all_formats_agree() {
    let made = Made::colmap_txt();
    let text = load(&made);
    let binary = load(&Made::colmap_bin());
    let json = load(&Made::transforms(|_| ()));
    assert_eq!(names(&text.train), NAMES);
    assert_eq!(names(&json.train), NAMES.map(|name| format!("images/{name}")));
    for other in [&binary, &json] {
        assert_eq!(other.points.colours, text.points.colours);
        for (a, b) in text.points.positions.iter().zip(&other.points.positions) {
            assert!((*a - *b).length() < 1e-12);
        }
        assert_eq!(other.train.len(), 3);
        for (a, b) in text.train.iter().zip(&other.train) {
            let (a, b) = (&a.camera, &b.camera);
            assert!((a.rotation - b.rotation).to_cols_array().iter().all(|e| e.abs() < 1e-12));
            assert!((a.translation - b.translation).length() < 1e-12);
            let lens = |c: &Camera| (c.width, c.height, c.fx, c.fy, c.cx, c.cy);
            assert_eq!(lens(a), lens(b));
        }
    }
    let world = text.normalisation.world_from_scene_camera(&text.train[0].camera);
    assert!((world.centre() - glam::DVec3::new(0.0, 0.0, -4.0)).length() < 1e-12);
    let image = text.train[1].source.load().unwrap();
    assert_eq!((image.width, image.height), SIZE);
    assert_eq!(image.rgb[..3], [40, 100, 200]);
}

#[test]
fn the_model_may_lie_directly_under_sparse() {
    let made = Made::colmap_bin();
    std::fs::rename(made.file("sparse/0"), made.file("moved")).unwrap();
    std::fs::remove_dir(made.file("sparse")).unwrap();
    std::fs::rename(made.file("moved"), made.file("sparse")).unwrap();
    assert_eq!(load(&made).train.len(), 3);
}

#[test]
fn an_option_or_the_dataset_decides_which_views_are_held_out() {
    let every = |k| LoadOptions {
        split: Split::Every(NonZeroU32::new(k).unwrap()),
        ..LoadOptions::default()
    };
    let eval = LoadOptions { split: Split::Eval, ..LoadOptions::default() };
    let made = Made::colmap_txt();
    let data = load_with(&made, &every(2));
    assert_eq!((names(&data.train), names(&data.test)), (vec!["b.png"], vec!["a.png", "c.png"]));
    let data = load_with(&made, &eval);
    assert_eq!((names(&data.train), names(&data.test)), (vec!["b.png", "c.png"], vec!["a.png"]));

    // The dataset's own test file decides, unless every K-th view is requested.
    let made = Made::transforms(|_| ());
    let json: serde_json::Value =
        serde_json::from_slice(&std::fs::read(made.file("transforms.json")).unwrap()).unwrap();
    for (file, frames) in [("transforms_train.json", 0..2), ("transforms_test.json", 2..3)] {
        let mut part = json.clone();
        part["frames"] = json["frames"].as_array().unwrap()[frames].to_vec().into();
        made.write(file, part.to_string());
    }
    for options in [LoadOptions::default(), eval] {
        let data = load_with(&made, &options);
        assert_eq!(
            (names(&data.train), names(&data.test)),
            (vec!["images/a.png", "images/b.png"], vec!["images/c.png"])
        );
        assert_eq!(data.points.len(), 200);
    }
    assert_eq!(names(&load_with(&made, &every(3)).test), ["images/a.png"]);

    // The names listed in nerfstudio's file decide as well, with or without a leading "./".
    for field in ["test_filenames", "val_filenames"] {
        let made = Made::transforms(|json| json[field] = serde_json::json!(["images/b.png"]));
        let data = load(&made);
        assert_eq!(names(&data.train), ["images/a.png", "images/c.png"]);
        assert_eq!(names(&data.test), ["images/b.png"]);
    }
}

/// Each case has nerfstudio's lists (as letters of frames), the frames trained on and tested on, and words of the note.
#[test]
fn frames_are_split_as_their_lists_say() {
    let file = |letter: char| format!("images/{letter}.png");
    let all = |letters: &str| letters.chars().map(file).collect::<Vec<_>>();
    let eval = LoadOptions { split: Split::Eval, ..LoadOptions::default() };
    let every = LoadOptions { split: Split::Every(NonZeroU32::MAX), ..LoadOptions::default() };
    let reduced =
        LoadOptions { resolution: Some(Resolution::Divisor(2)), ..LoadOptions::default() };
    for ([train, validation, test], (trained, tested), note) in [
        ([Some("b"), None, None], ("b", ""), "2 of 3 frames, in no list, images/a.png"),
        ([Some("b"), Some(""), Some("")], ("b", ""), "none for tests, no view is held out"),
        ([Some("b"), Some("a"), None], ("b", "a"), "1 of 3 frames, in no list, images/c.png"),
        ([Some("b"), Some("c"), Some("a")], ("b", "a"), "1 of 3 frames, validation, images/c.png"),
        ([Some("abc"), Some("c"), None], ("abc", "c"), "1 of 3 frames, for training and for tests"),
        ([None, Some("c"), Some("a")], ("b", "a"), "1 of 3 frames, validation, images/c.png"),
        ([None, Some("c"), Some("")], ("ab", "c"), ""),
        ([None, None, Some("ac")], ("b", "ac"), ""),
    ] {
        let made = Made::transforms(|json| {
            for (field, list) in ["train", "val", "test"].iter().zip([train, validation, test]) {
                if let Some(list) = list {
                    json[format!("{field}_filenames")] = all(list).into();
                }
            }
        });
        for name in NAMES {
            image(&made.file("images_2").join(name), (10, 6), 7);
        }
        for options in [&LoadOptions::default(), &eval, &reduced] {
            let data = load_with(&made, options);
            assert_eq!(names(&data.train), all(trained), "{trained}, {tested}");
            assert_eq!(names(&data.test), all(tested), "{trained}, {tested}");
            if !note.is_empty() {
                assert_noted(&data, note);
            }
        }
        // If every K-th view is held out by option, the lists are ignored.
        let data = load_with(&made, &every);
        assert_eq!(names(&data.train), all("bc"));
        assert_eq!(names(&data.test), all("a"));
    }
}

/// Lists may spell the paths of frames in any way, even those of frames whose photograph is missing.
#[test]
fn lists_and_frames_may_spell_paths_differently() {
    let made = Made::transforms(|json| {
        json["frames"][0]["file_path"] = "images\\a.png".into();
        json["frames"][2]["file_path"] = "images/c".into();
        json["train_filenames"] = vec!["./images/a.png", "images\\b.png", "images/./c.png"].into();
    });
    assert_eq!(load(&made).train.len(), 3);
    std::fs::rename(made.file("images/b.png"), made.file("images/b.jpeg")).unwrap();
    let data = load(&made);
    assert_eq!(data.train.len(), 2);
    assert_noted(&data, "1 of 3 frames have no image file, is the first; b.jpeg exists");
    // The paths may be those of another machine.
    let made = Made::transforms(|json| {
        json["frames"][1]["file_path"] = "/home/x/images/b.png".into();
        json["train_filenames"] = vec!["images/a.png", "C:\\x\\images\\b.png"].into();
    });
    let images = Some("images".into());
    let data = load_with(&made, &LoadOptions { images, ..LoadOptions::default() });
    assert_eq!(data.train.len(), 2);
}

#[test]
fn images_are_loaded_at_the_requested_resolution() {
    let options =
        |resolution| LoadOptions { resolution: Some(resolution), ..LoadOptions::default() };
    for made in [Made::colmap_txt(), Made::transforms(|_| ())] {
        for (resolution, size) in [
            (Resolution::Divisor(1), SIZE),
            (Resolution::Divisor(2), (10, 6)),
            (Resolution::Divisor(8), (3, 2)),
            (Resolution::Width(15), (15, 9)),
            (Resolution::Width(400), SIZE),
        ] {
            let data = load_with(&made, &options(resolution));
            for view in &data.train {
                let image = view.source.load().unwrap();
                assert_eq!((image.width, image.height), size, "{resolution:?}");
                assert_eq!((view.camera.width, view.camera.height), size, "{resolution:?}");
                assert!((view.camera.fx / f64::from(size.0) - 15.0 / 20.0).abs() < 1e-12);
            }
        }
        // The folder of reduced images is used if it exists; here, one image is missing in the folder.
        for name in &NAMES[1..] {
            image(&made.file("images_2").join(name), (10, 6), 7);
        }
        let data = load_with(&made, &options(Resolution::Divisor(2)));
        let first = |view: &View| view.source.load().unwrap().rgb[0];
        assert_eq!(data.train.iter().map(first).collect::<Vec<_>>(), [0, 7, 7]);
        assert!(data.train.iter().all(|view| view.camera.width == 10));
        assert_noted(&data, "images_2");
        // The folder is not used for another divisor.
        assert_eq!(first(&load_with(&made, &options(Resolution::Divisor(4))).train[1]), 40);
    }
}

#[test]
fn images_are_read_from_the_folder_that_the_options_name() {
    let elsewhere = tempfile::tempdir().unwrap();
    for made in [Made::colmap_txt(), Made::transforms(|_| ())] {
        for name in NAMES {
            image(&made.file("small").join(name), (10, 6), 9);
            image(&elsewhere.path().join(name), (10, 6), 11);
        }
        for (folder, value) in [(PathBuf::from("small"), 9), (elsewhere.path().to_owned(), 11)] {
            let data =
                load_with(&made, &LoadOptions { images: Some(folder), ..LoadOptions::default() });
            assert_eq!(data.train[2].source.load().unwrap().rgb[0], value);
            assert!((data.train[2].camera.fx - 7.5).abs() < 1e-12);
        }
    }
}

/// Transparent photographs are composited on the background in every format.
#[test]
fn transparency_is_the_same_in_every_format() {
    for extension in ["png", "webp"] {
        for (made, listing) in [
            (Made::colmap_txt(), "sparse/0/images.txt"),
            (Made::transforms(|_| ()), "transforms.json"),
            (Made::realitycapture(), "cameras.csv"),
        ] {
            for name in NAMES {
                made.remove(&format!("images/{name}"));
                let renamed = name.replace("png", extension);
                made.replace(listing, name, &renamed);
                let alpha = |x, _| image::Rgba([255, 102, 0, if x < 10 { 51 } else { 255 }]);
                let image = image::RgbaImage::from_fn(SIZE.0, SIZE.1, alpha);
                image.save(made.file(&format!("images/{renamed}"))).unwrap();
            }
            let data = load(&made);
            assert_eq!(data.train.len(), 3);
            for view in &data.train {
                assert!(view.source.header.has_alpha, "{}", view.name);
                let image = view.source.load().unwrap();
                for (x, expected) in [(0, [0.2, 0.88, 0.8]), (10, [1.0, 0.4, 0.0])] {
                    let found = image.composited(x, 0, [0.0, 1.0, 1.0]);
                    let near = found.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-6);
                    assert!(near, "{listing}, {}: {found:?}", view.name);
                }
            }
        }
    }
}

#[test]
fn intrinsics_of_a_frame_override_those_at_the_top_level() {
    let data = load(&Made::transforms(|json| json["frames"][1]["fl_x"] = 12.0.into()));
    let fx: Vec<f64> = data.train.iter().map(|view| view.camera.fx).collect();
    assert_eq!(fx, [15.0, 12.0, 15.0]);
    // NeRF-synthetic files state only a field of view.
    let data = load(&Made::transforms(|json| {
        for field in ["w", "h", "fl_x", "fl_y", "cx", "cy"] {
            json.as_object_mut().unwrap().remove(field);
        }
        json["camera_angle_x"] = 1.0.into();
    }));
    let camera = &data.train[0].camera;
    assert!((camera.fx - 10.0 / 0.5f64.tan()).abs() < 1e-12);
    assert!((camera.fy - camera.fx).abs() < 1e-12);
    assert!((camera.cx - 10.0).abs() < 1e-12 && (camera.cy - 6.0).abs() < 1e-12);
}

#[test]
fn distorted_cameras_become_pinholes() {
    let made = Made::colmap_txt();
    made.replace(
        "sparse/0/cameras.txt",
        "PINHOLE 20 12 15 16 10 6",
        "OPENCV 20 12 15 16 10 6 0.05 -0.01 0.001 0.002",
    );
    let data = load(&made);
    let view = &data.train[0];
    assert!(view.source.undistortion.is_some());
    assert!((view.camera.fx - 15.0).abs() > 1e-3);
    assert_eq!(view.source.load().unwrap().rgb, [0, 100, 200].repeat(20 * 12));
}

#[test]
fn missing_frames_and_bad_points_are_noted() {
    let made = Made::transforms(|_| ());
    std::fs::remove_file(made.file("images/b.png")).unwrap();
    made.replace("points.ply", "\n3 0 0.5", "\nnan 0 0.5");
    let data = load(&made);
    assert_eq!((data.train.len(), data.points.len()), (2, 199));
    assert_noted(&data, "images/b.png");
    assert_noted(&data, "1 of 200 points");
}

#[test]
fn a_far_off_scene_keeps_its_precision() {
    let made = Made::colmap_txt();
    let data = load(&made);
    let far = Made::colmap_txt();
    // All cameras and points are moved by (1e6, 0, 0), so a translation t becomes t − R·offset.
    far.replace("sparse/0/images.txt", "1 0 0 0 0 0 4 ", "1 0 0 0 -1000000 0 4 ");
    far.replace("sparse/0/images.txt", "0.8 0 0.6 0 0.5 0 4 ", "0.8 0 0.6 0 -279999.5 0 960004 ");
    far.replace("sparse/0/images.txt", "0 0 1 0 0 0.25 5 ", "0 0 1 0 1000000 0.25 5 ");
    let text = std::fs::read_to_string(far.file("sparse/0/points3D.txt")).unwrap();
    let moved = text.lines().skip(1).map(|line| {
        let mut words: Vec<String> = line.split(' ').map(str::to_owned).collect();
        words[1] = format!("{}", 1e6 + words[1].parse::<f64>().unwrap());
        words.join(" ") + "\n"
    });
    far.write("sparse/0/points3D.txt", moved.collect::<String>());
    let far = load(&far);
    for (a, b) in data.points.positions.iter().zip(&far.points.positions) {
        assert!((*a - *b).length() < 1e-8, "{a} {b}");
    }
    for (a, b) in data.train.iter().zip(&far.train) {
        assert!((a.camera.translation - b.camera.translation).length() < 1e-8);
    }
    assert!(far.normalisation.is_remote() && !data.normalisation.is_remote());
}

/// Photographers keep exports of several programs in one folder.
#[test]
fn a_file_that_another_format_supersedes_is_named() {
    let made = Made::colmap_txt();
    let unread = |data: &Dataset| {
        data.notes.iter().filter(|note| note.contains("transforms.json is not read")).count()
    };
    assert_eq!(unread(&load(&made)), 0);
    made.write("transforms.json", r#"{"frames": []}"#);
    assert_noted(&load(&made), "transforms.json is not read: sparse/0 takes precedence");
    made.write("transforms.json", r#"{"frames": [], "test_filenames": ["a.png"]}"#);
    assert_noted(&load(&made), "not read, nor are its lists of views: sparse/0 takes precedence");
    let chosen = LoadOptions { sparse: Some("sparse/0".into()), ..LoadOptions::default() };
    assert_eq!(unread(&load_with(&made, &chosen)), 0);
}

#[test]
fn the_note_on_narrow_images_names_one_of_them() {
    let made = Made::colmap_txt();
    image(&made.file("images/b.png"), (10, 6), 9);
    let resolution = Some(Resolution::Width(15));
    let data = load_with(&made, &LoadOptions { resolution, ..LoadOptions::default() });
    assert_noted(&data, "1 image narrower than 15 px, first: b.png");
}
