//! Tests that scenes are written completely or not at all, and as the readers of other programs expect.

use std::collections::{BTreeSet, HashMap};

use glam::{DMat3, DQuat, DVec2, DVec3};
use serde_json::Value;

use super::*;
use crate::{Options, PointOptions, Source};

fn small() -> Scene {
    let options = Options {
        size: Some((24, 20)),
        train: Some(4),
        test: Some(2),
        grid: 1,
        points: PointOptions { count: 50, ..PointOptions::default() },
        ..Options::default()
    };
    Scene::prepare(&Source::Preset("spheres".into()), &options).expect("preset")
}

/// Writes the scene [`small`] to two folders: with its own options, and with `options`.
fn written(options: Options) -> (tempfile::TempDir, [std::path::PathBuf; 2]) {
    let plain = small();
    let other = Scene::prepare(&Source::Preset("spheres".into()), &options).expect("preset");
    let root = tempfile::tempdir().expect("folder");
    let targets = [(&plain, "plain"), (&other, "other")].map(|(scene, name)| {
        let target = root.path().join(name);
        write(scene, &target, false, |_| ()).expect("write");
        target
    });
    (root, targets)
}

fn read(folder: &Path, name: &str) -> Vec<u8> {
    fs::read(folder.join(name)).expect(name)
}

/// The files of training views have the lens in every format, and those of test views do not.
#[test]
fn a_lens_affects_training_views_only() {
    let lens = Some("fisheye:0.05,-0.01".parse().expect("a lens"));
    let (_root, [a, b]) = written(Options { lens, ..small().options });
    assert!(read(&a, "images/test/r_001.png") == read(&b, "images/test/r_001.png"));
    assert!(read(&a, "images/train/r_001.png") != read(&b, "images/train/r_001.png"));
    let cameras = String::from_utf8(read(&b, "sparse/0/cameras.txt")).expect("text");
    let lines: Vec<&str> = cameras.lines().filter(|line| !line.starts_with('#')).collect();
    let is_bent =
        |line: &&str| line.contains(" OPENCV_FISHEYE ") && line.ends_with(" 0.05 -0.01 0 0");
    assert!(lines[..4].iter().all(is_bent), "{cameras}");
    assert!(lines[4..].iter().all(|line| line.contains(" PINHOLE ")), "{cameras}");
    for name in ["transforms_train.json", "transforms_test.json", "transforms.json"] {
        let top: Value = serde_json::from_slice(&read(&b, name)).expect("JSON");
        for frame in top["frames"].as_array().expect("frames") {
            let field = |key: &str| frame.get(key).unwrap_or(&top[key]).clone();
            let is_test = text(&frame["file_path"]).contains("/test/");
            let (model, k1) = if is_test { ("OPENCV", 0.0) } else { ("OPENCV_FISHEYE", 0.05) };
            assert_eq!(text(&field("camera_model")), model, "{name}");
            assert_eq!(field("k1").as_f64(), Some(k1), "{name}");
        }
    }
}

/// The mask hides every pixel changed by passers-by; everything else, including the ground truth, is unchanged.
#[test]
fn passers_by_are_in_some_training_views_and_masked() {
    let (_root, [a, b]) = written(Options { passers_by: 0.5, ..small().options });
    for name in
        ["images/test/r_001.png", "depth/train/r_001.exr", "points3d.ply", "sparse/0/points3D.txt"]
    {
        assert!(read(&a, name) == read(&b, name), "{name}");
    }
    assert!(!a.join("masks").exists());
    let pixels = |path: std::path::PathBuf| image::open(path).expect("PNG").into_rgba8();
    let mut masked = 0;
    for name in
        ["train/r_000", "train/r_001", "train/r_002", "train/r_003", "test/r_000", "test/r_001"]
    {
        let image = format!("images/{name}.png");
        let [plain, other] = [&a, &b].map(|folder| pixels(folder.join(&image)));
        let mask = image::open(b.join(format!("masks/{name}.png"))).expect("a mask").into_luma8();
        let hidden = mask.iter().filter(|&&value| value == 0).count();
        masked += usize::from(hidden > 0);
        assert!(hidden == 0 || (20..300).contains(&hidden), "{name}: {hidden} of 480 pixels");
        let mut changed = 0;
        for ((plain, other), mask) in plain.pixels().zip(other.pixels()).zip(mask.pixels()) {
            assert!(plain == other || mask.0 == [0], "{name}: {plain:?} {other:?}");
            changed += usize::from(plain != other);
        }
        assert!(2 * changed >= hidden, "{name}: {changed} of {hidden}");
    }
    assert_eq!(masked, 2);
    let top: Value = serde_json::from_slice(&read(&b, "transforms.json")).expect("JSON");
    for frame in top["frames"].as_array().expect("frames") {
        assert!(b.join(text(&frame["mask_path"])).is_file(), "{frame}");
    }
    for bad in [-0.1, 1.1, f64::NAN] {
        let options = Options { passers_by: bad, ..small().options };
        let refused =
            Scene::prepare(&Source::Preset("spheres".into()), &options).err().expect("refused");
        assert!(refused.to_string().contains("--passers-by"), "{refused}");
    }
}

fn names(folder: &Path) -> Vec<String> {
    let entries = fs::read_dir(folder).expect("folder");
    let mut names: Vec<String> =
        entries.map(|e| e.expect("entry").file_name().to_string_lossy().into_owned()).collect();
    names.sort();
    names
}

/// Linear light of an encoded value.
fn light(value: u8) -> f64 {
    let v = f64::from(value) / 255.0;
    if v <= 0.04045 { v / 12.92 } else { ((v + 0.055) / 1.055).powf(2.4) }
}

/// Training views are exposed by the recorded factors; test views, depth and points are unchanged.
#[test]
fn exposures_vary_in_training_views_only() {
    let (_root, [a, b]) = written(Options { exposure_jitter: 1.0, ..small().options });
    for name in ["images/test/r_001.png", "depth/train/r_001.exr", "points3d.ply"] {
        assert!(read(&a, name) == read(&b, name), "{name}");
    }
    let record: Value = serde_json::from_slice(&read(&b, "scene.json")).expect("JSON");
    let pixels = |folder: &Path, number: usize| {
        let path = folder.join(format!("images/train/r_{number:03}.png"));
        image::open(path).expect("PNG").into_rgba8().into_raw()
    };
    let mut stops = Vec::new();
    for number in 0..4 {
        let factors = &record["view_exposures"][format!("train/r_{number:03}")];
        let factors = [0, 1, 2].map(|c| factors[c].as_f64().expect("a factor"));
        stops.push(factors[1].log2());
        assert!(factors[1].log2().abs() <= 1.0, "{factors:?}");
        for c in [0, 2] {
            assert!((factors[c] / factors[1] - 1.0).abs() <= 0.1 + 1e-6, "{factors:?}");
        }
        let (plain, exposed) = (pixels(&a, number), pixels(&b, number));
        let pairs = plain.chunks_exact(4).zip(exposed.chunks_exact(4));
        let mut compared = 0;
        for (plain, exposed) in pairs.filter(|(plain, _)| plain[3] > 0) {
            assert_eq!(plain[3], exposed[3], "alpha changed");
            for c in 0..3 {
                // Only values that are not clipped and are large compared with a step of eight bits.
                if exposed[c] < 255 && plain[c] < 255 && plain[c] > 60 && exposed[c] > 60 {
                    let ratio = light(exposed[c]) / light(plain[c]) / factors[c];
                    assert!((ratio - 1.0).abs() < 0.05, "{number}: {plain:?} {exposed:?}");
                    compared += 1;
                }
            }
        }
        assert!(compared > 50, "{compared}");
    }
    stops.sort_by(f64::total_cmp);
    assert!(stops[3] - stops[0] > 0.2, "{stops:?}");
}

/// Training views lose light towards their corners by the recorded share; test views, depth and points are unchanged.
#[test]
fn vignettes_darken_training_views_only() {
    let (_root, [a, b]) = written(Options { vignette: 0.5, ..small().options });
    for name in ["images/test/r_001.png", "depth/train/r_001.exr", "points3d.ply"] {
        assert!(read(&a, name) == read(&b, name), "{name}");
    }
    let record =
        |folder| -> Value { serde_json::from_slice(&read(folder, "scene.json")).expect("JSON") };
    assert_eq!(record(&b)["options"]["vignette"], 0.5);
    assert!(record(&a)["options"].get("vignette").is_none());
    let pixels = |folder: &Path, number: usize| {
        let path = folder.join(format!("images/train/r_{number:03}.png"));
        image::open(path).expect("PNG").into_rgba8()
    };
    let (mut compared, mut darkest) = (0, 1.0_f64);
    for number in 0..4 {
        let (plain, dimmed) = (pixels(&a, number), pixels(&b, number));
        let half = [plain.width(), plain.height()].map(|side| 0.5 * f64::from(side));
        for (x, y, colour) in plain.enumerate_pixels() {
            let seen = dimmed.get_pixel(x, y);
            assert_eq!(colour[3], seen[3], "alpha changed");
            let at = [f64::from(x) + 0.5 - half[0], f64::from(y) + 0.5 - half[1]];
            let d2 = (at[0] * at[0] + at[1] * at[1]) / (half[0] * half[0] + half[1] * half[1]);
            // The cos⁴ law that halves the light at d = 1.
            let expected = (1.0 + (2.0_f64.sqrt() - 1.0) * d2).powi(-2);
            for c in (0..3).filter(|&c| colour[3] > 0 && colour[c] < 255 && seen[c] > 60) {
                let ratio = light(seen[c]) / light(colour[c]);
                assert!((ratio / expected - 1.0).abs() < 0.05, "{x}, {y}: {ratio} {expected}");
                (compared, darkest) = (compared + 1, darkest.min(expected));
            }
        }
    }
    assert!(compared > 100 && darkest < 0.8, "{compared}, {darkest}");
    for bad in [-0.1, 1.0, f32::NAN] {
        let options = Options { vignette: bad, ..small().options };
        let refused =
            Scene::prepare(&Source::Preset("spheres".into()), &options).err().expect("refused");
        assert!(refused.to_string().contains("--vignette"), "{refused}");
    }
}

#[test]
fn all_files_are_written_and_no_temporary_folder_is_left() {
    let scene = small();
    let root = tempfile::tempdir().expect("folder");
    let target = root.path().join("deep").join("scene");
    let mut seen = Vec::new();
    let written = write(&scene, &target, false, |view| seen.push(view)).expect("write");
    assert_eq!((written.views, seen), (6, vec![0, 1, 2, 3, 4, 5]));
    assert_eq!(names(&root.path().join("deep")), ["scene"]);
    let expected = "depth images mesh.ply normals points3d.ply scene.json sparse transforms.json \
                    transforms_test.json transforms_train.json";
    assert_eq!(names(&target).join(" "), expected);
    for (kind, files) in [("images", 1), ("depth", 2), ("normals", 1)] {
        assert_eq!(names(&target.join(kind).join("train")).len(), 4 * files, "{kind}");
        assert_eq!(names(&target.join(kind).join("test")).len(), 2 * files, "{kind}");
    }
    // Depth is stored exactly.
    let frame = scene.render(4);
    let path = target.join("depth/test/r_000.exr");
    let image = ::exr::prelude::read_first_flat_layer_from_file(&path).expect("EXR");
    let channel = &image.layer_data.channel_data.list[0];
    assert_eq!(channel.name.to_string(), "Z");
    let values: Vec<f32> = channel.sample_data.values_as_f32().collect();
    assert_eq!(values, frame.depth);
    // So are colour and alpha.
    let png = image::open(target.join("images/test/r_000.png")).expect("PNG").into_rgba8();
    assert_eq!(png.into_raw(), frame.rgba);
    // Writing the same scene again gives the same files.
    let again = root.path().join("again");
    write(&small(), &again, false, |_| ()).expect("write");
    for name in
        ["scene.json", "points3d.ply", "mesh.ply", "sparse/0/images.txt", "images/train/r_002.png"]
    {
        assert!(read(&target, name) == read(&again, name), "{name}");
    }
}

#[test]
fn only_scenes_are_overwritten() {
    let scene = small();
    let root = tempfile::tempdir().expect("folder");
    let target = root.path().join("scene");
    fs::create_dir(&target).expect("folder");
    // An empty folder may be used.
    write(&scene, &target, false, |_| ()).expect("write");
    assert!(matches!(write(&scene, &target, false, |_| ()), Err(Error::Input(_))));
    fs::write(target.join("old"), "old").expect("write");
    write(&scene, &target, true, |_| ()).expect("write");
    assert!(!target.join("old").exists() && target.join("scene.json").exists());
    // Other folders are never changed.
    let other = root.path().join("other");
    fs::create_dir(&other).expect("folder");
    fs::write(other.join("thesis.txt"), "words").expect("write");
    for overwrite in [false, true] {
        assert!(matches!(write(&scene, &other, overwrite, |_| ()), Err(Error::Input(_))));
    }
    assert_eq!(names(&other), ["thesis.txt"]);
    assert_eq!(names(root.path()), ["other", "scene"]);
}

/// A requirement, and a function that checks it.
type Rule = (&'static str, fn(&Path, &Value, &[Value]) -> bool);

/// Requirements of nerfstudio 1.1's `nerfstudio_dataparser.py` and `data_utils.py` on a folder, its
/// transforms.json, and the frames therein.
const NERFSTUDIO: [Rule; 7] = [
    ("the camera model is known", |_, top, _| top["camera_model"] == "OPENCV"),
    ("every image exists under its full name", |root, _, frames| {
        frames.iter().all(|frame| image::open(root.join(text(&frame["file_path"]))).is_ok())
    }),
    ("every view has a NumPy depth file of the image's size", |root, top, frames| {
        frames.iter().all(|frame| {
            let bytes = fs::read(root.join(text(&frame["depth_file_path"]))).unwrap_or_default();
            let length =
                bytes.get(8..10).map_or(0, |b| usize::from(b[0]) + 256 * usize::from(b[1]));
            let side = |key: &str| top.get(key).unwrap_or(&frame[key]).as_u64().unwrap_or(0);
            let header = format!(
                "{{'descr': '<f4', 'fortran_order': False, 'shape': ({}, {}), }}",
                side("h"),
                side("w")
            );
            bytes.starts_with(b"\x93NUMPY\x01\x00")
                && (10 + length) % 64 == 0
                && bytes[10..10 + length].trim_ascii_end() == header.as_bytes()
                && bytes[9 + length] == b'\n'
                && bytes.len() as u64 == 10 + length as u64 + 4 * side("w") * side("h")
        })
    }),
    ("every pose is a rotation and a translation", |_, _, frames| {
        frames.iter().all(|frame| {
            let at = |row: usize, column: usize| frame["transform_matrix"][row][column].as_f64();
            let column = |c: usize| DVec3::from_array([0, 1, 2].map(|r| at(r, c).unwrap_or(9.0)));
            let m = DMat3::from_cols(column(0), column(1), column(2));
            (m * m.transpose()).abs_diff_eq(DMat3::IDENTITY, 1e-9)
                && m.determinant() > 0.0
                && [0, 1, 2, 3].map(|c| at(3, c)) == [0.0, 0.0, 0.0, 1.0].map(Some)
        })
    }),
    ("each intrinsic is at the top or in every frame", |_, top, frames| {
        ["fl_x", "fl_y", "cx", "cy", "w", "h"].iter().all(|key| {
            let everywhere = frames.iter().all(|frame| frame[key].is_number());
            top[key].is_number() && frames.iter().all(|frame| frame.get(key).is_none())
                || everywhere
        })
    }),
    ("the split has all three lists or none, of existing images", |_, top, frames| {
        let list = |key: &str| -> Option<BTreeSet<&str>> {
            Some(top.get(key)?.as_array()?.iter().map(text).collect())
        };
        let all: BTreeSet<&str> = frames.iter().map(|frame| text(&frame["file_path"])).collect();
        match ["train_filenames", "val_filenames", "test_filenames"].map(list) {
            [Some(train), Some(val), Some(test)] => {
                let held_out = |name: &&str| name.starts_with("images/test/");
                val == test
                    && train.is_disjoint(&val)
                    && val.iter().all(held_out)
                    && !val.is_empty()
                    && &train | &val == all
            }
            [None, None, None] => !all.iter().any(|name| name.starts_with("images/test/")),
            _ => false,
        }
    }),
    ("the points exist", |root, top, _| root.join(text(&top["ply_file_path"])).is_file()),
];

fn text(value: &Value) -> &str {
    value.as_str().unwrap_or("?")
}

#[test]
fn nerfstudio_can_open_the_files() {
    let root = tempfile::tempdir().expect("folder");
    let mut zoomed = small();
    zoomed.views[1].camera.fx *= 1.5;
    let mut train_only = small();
    train_only.views.truncate(4);
    for (name, scene) in [("small", small()), ("zoomed", zoomed), ("train only", train_only)] {
        let folder = root.path().join(name);
        write(&scene, &folder, false, |_| ()).expect("write");
        let file = fs::read(folder.join("transforms.json")).expect("transforms.json");
        let top: Value = serde_json::from_slice(&file).expect("JSON");
        let frames = top["frames"].as_array().expect("frames");
        assert_eq!(frames.len(), scene.views.len(), "{name}");
        for (rule, holds) in NERFSTUDIO {
            assert!(holds(&folder, &top, frames), "{name}: {rule}\n{top:#}");
        }
        let focal = |i: usize| frames[i].get("fl_x").unwrap_or(&top["fl_x"]).as_f64();
        for (i, view) in scene.views.iter().enumerate() {
            assert_eq!(focal(i), Some(view.camera.fx), "{name}: {}", view.name);
        }
    }
    // nerfstudio's default factor, 1e-3, converts stored depth to world units.
    let stored = fs::read(root.path().join("small/depth/test/r_000.npy")).expect("depth");
    let depth = &small().render(4).depth;
    let stored = stored[stored.len() - 4 * depth.len()..].as_chunks().0.iter();
    let stored = stored.map(|&word| 1e-3 * f32::from_le_bytes(word));
    let apart = stored.zip(depth).map(|(a, b)| (a - b).abs() / b.max(1.0)).fold(0.0, f32::max);
    assert!(apart < 1e-6 && depth.iter().any(|&d| d > 0.0), "{apart}");
}

#[test]
fn colmap_tracks_and_reprojection_errors_are_consistent() {
    let root = tempfile::tempdir().expect("folder");
    let folder = root.path().join("scene");
    // In a room, some outliers are behind cameras.
    let options = Options {
        size: Some((48, 48)),
        train: Some(24),
        test: Some(1),
        grid: 1,
        points: PointOptions { count: 300, outliers: 0.2, ..PointOptions::default() },
        ..Options::default()
    };
    let scene = Scene::prepare(&Source::Preset("room".into()), &options).expect("preset");
    write(&scene, &folder, false, |_| ()).expect("write");
    let read = |name: &str| fs::read_to_string(folder.join("sparse/0").join(name)).expect(name);
    let [cameras, images, points] = ["cameras.txt", "images.txt", "points3D.txt"].map(read);
    let lines = |text: &str| -> Vec<Vec<String>> {
        let lines = text.lines().filter(|line| !line.starts_with('#'));
        lines.map(|line| line.split(' ').map(str::to_owned).collect()).collect()
    };
    let number = |word: &String| word.parse::<f64>().expect("a number");
    let lenses: HashMap<String, Vec<f64>> = lines(&cameras)
        .iter()
        .map(|c| (c[0].clone(), c[4..].iter().map(number).collect()))
        .collect();
    let views: HashMap<String, (Vec<String>, Vec<String>)> =
        lines(&images).chunks(2).map(|v| (v[0][0].clone(), (v[0].clone(), v[1].clone()))).collect();
    assert_eq!((lenses.len(), views.len()), (25, 25));
    let mut errors: Vec<f64> = Vec::new();
    let mut observed = 0;
    for point in lines(&points) {
        let place = DVec3::new(number(&point[1]), number(&point[2]), number(&point[3]));
        let distances = point[8..].chunks(2).map(|track| {
            let (view, features) = &views[&track[0]];
            let [w, x, y, z, tx, ty, tz] = [1, 2, 3, 4, 5, 6, 7].map(|i| number(&view[i]));
            let local = DQuat::from_xyzw(x, y, z, w) * place + DVec3::new(tx, ty, tz);
            let lens = &lenses[&view[8]];
            let feature = &features[3 * track[1].parse::<usize>().expect("an index")..][..3];
            assert_eq!(feature[2], point[0], "the feature is another point's");
            assert!(local.z > 0.0, "{point:?} lies behind {}", view[9]);
            let projected = DVec2::new(lens[0] * local.x, lens[1] * local.y) / local.z
                + DVec2::new(lens[2], lens[3]);
            projected.distance(DVec2::new(number(&feature[0]), number(&feature[1])))
        });
        let distances: Vec<f64> = distances.collect();
        observed += distances.len();
        let mean = distances.iter().sum::<f64>() / distances.len() as f64;
        let expected = if distances.is_empty() { -1.0 } else { mean };
        let error = number(&point[7]);
        assert!((error - expected).abs() <= 1e-6 * (1.0 + expected), "{error}, not {expected}");
        errors.push(error);
    }
    // Each feature belongs to one track.
    let features: usize = views.values().map(|(_, features)| features.len() / 3).sum();
    assert_eq!((errors.len(), features), (300, observed));
    errors.sort_by(f64::total_cmp);
    // The room is about 50 px wide in its views: noise of a thousandth of the diagonal moves points by less than
    // a pixel, and outliers are many pixels off.
    assert!((0.01..1.0).contains(&errors[150]) && errors[290] > 5.0, "{errors:?}");
}
