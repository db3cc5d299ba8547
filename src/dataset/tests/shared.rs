//! Real datasets load: tests of the folder `DENSIFY_SHARED`, or `../shared`.

use std::path::PathBuf;

use super::super::*;
use crate::init::{initialise, random_points};

/// The folder of a real dataset.
pub(crate) fn shared(name: &str) -> PathBuf {
    let root = std::env::var_os("DENSIFY_SHARED")
        .map_or_else(|| PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../shared"), PathBuf::from);
    let path = root.join("data").join(name);
    assert!(path.exists(), "there is no {}; set DENSIFY_SHARED", path.display());
    path
}

struct Expected {
    name: &'static str,
    train: usize,
    test: usize,
    size: (u32, u32),
    points: usize,
    undistorted: bool,
}

const fn expected(
    name: &'static str,
    train: usize,
    test: usize,
    size: (u32, u32),
    points: usize,
    undistorted: bool,
) -> Expected {
    Expected { name, train, test, size, points, undistorted }
}

const DATASETS: [Expected; 6] = [
    expected("room256", 40, 8, (256, 256), 5000, false),
    expected("cup", 67, 10, (256, 192), 9262, false),
    expected("office", 112, 16, (192, 256), 5751, false),
    expected("beercan", 62, 9, (144, 256), 4414, true),
    expected("fox", 43, 7, (288, 512), 0, true),
    expected("chair", 100, 200, (256, 256), 0, false),
];

#[test]
#[ignore = "needs real photographs: set DENSIFY_SHARED"]
fn real_datasets_load() {
    for expected in DATASETS {
        let name = expected.name;
        let path = shared(name);
        let options = LoadOptions { split: Split::Eval, ..LoadOptions::default() };
        let data = Dataset::load(&path, &options).unwrap_or_else(|e| panic!("{name}: {e}"));
        assert_eq!((data.train.len(), data.test.len()), (expected.train, expected.test), "{name}");
        assert_eq!(data.points.len(), expected.points, "{name}");
        let farthest =
            data.train.iter().map(|view| view.camera.centre().length()).fold(0.0, f64::max);
        assert!((farthest - 1.0).abs() < 1e-9, "{name}: {farthest}");
        for view in data.train.iter().chain(&data.test) {
            // Sides differ by a few pixels between the cameras of `office`.
            let (width, height) = (view.camera.width, view.camera.height);
            let near = width.abs_diff(expected.size.0).max(height.abs_diff(expected.size.1)) <= 3;
            assert!(near, "{name} {}: {width}x{height}", view.name);
            assert_eq!(
                view.source.undistortion.is_some(),
                expected.undistorted,
                "{name} {}",
                view.name
            );
            assert!(view.camera.fx > 100.0 && view.camera.fx < 600.0, "{name} {}", view.name);
        }
        for view in data.train.iter().step_by(20) {
            let image = view.source.load().unwrap();
            assert_eq!(
                (image.width, image.height),
                (view.camera.width, view.camera.height),
                "{name}"
            );
            assert_eq!(image.alpha.is_some(), name == "chair", "{name} {}", view.name);
            assert!(image.bytes() <= view.source.loaded_bytes());
        }
        if name == "fox" {
            assert!(data.notes.iter().any(|note| note.contains("17 of 67")), "{:?}", data.notes);
        }
        if expected.points > 0 {
            // Points are what the cameras saw: all but a few are in view of one of them.
            let seen_by = |camera: &Camera, p: DVec3| {
                let (pixel, depth) = camera.project(p);
                let (w, h) = (f64::from(camera.width), f64::from(camera.height));
                depth > 0.0 && pixel.x >= 0.0 && pixel.y >= 0.0 && pixel.x <= w && pixel.y <= h
            };
            let seen = |p: &&DVec3| data.train.iter().any(|view| seen_by(&view.camera, **p));
            let share =
                data.points.positions.iter().filter(seen).count() as f64 / expected.points as f64;
            assert!(share > 0.97, "{name}: {share} of the points are in view");
            let (model, report) = initialise(&data.points, 4000, 3, 0).unwrap();
            assert_eq!((model.len(), report.rows), (4000, 4000), "{name}");
            assert!(model.log_scales.iter().all(|log| log[0] > -12.0 && log[0] < 5.0), "{name}");
        }
    }
}

/// room256 comes in two formats: the poses agree.
#[test]
#[ignore = "needs real photographs: set DENSIFY_SHARED"]
fn the_two_formats_of_room256_agree() {
    let path = shared("room256");
    let folder = tempfile::tempdir().unwrap();
    for name in ["images", "sparse/0"] {
        std::fs::create_dir_all(folder.path().join(name)).unwrap();
        for entry in std::fs::read_dir(path.join(name)).unwrap() {
            let entry = entry.unwrap();
            let bytes = std::fs::read(entry.path()).unwrap();
            std::fs::write(folder.path().join(name).join(entry.file_name()), bytes).unwrap();
        }
    }
    let json = Dataset::load(&path, &LoadOptions::default()).unwrap();
    let binary = Dataset::load(folder.path(), &LoadOptions::default()).unwrap();
    for name in ["cameras.bin", "images.bin", "points3D.bin"] {
        std::fs::remove_file(folder.path().join("sparse/0").join(name)).unwrap();
    }
    let text = Dataset::load(folder.path(), &LoadOptions::default()).unwrap();
    for other in [&binary, &text] {
        assert_eq!(other.train.len(), json.train.len());
        for (a, b) in json.train.iter().zip(&other.train) {
            assert_eq!(a.name, format!("images/{}", b.name));
            assert!((a.camera.translation - b.camera.translation).length() < 1e-6);
            assert!(
                (a.camera.rotation - b.camera.rotation)
                    .to_cols_array()
                    .iter()
                    .all(|e| e.abs() < 1e-6)
            );
        }
        assert_eq!(other.points.colours, text.points.colours);
    }
}

/// The focus of `chair` is its origin, of `fox` the fox: points are put there.
#[test]
#[ignore = "needs real photographs: set DENSIFY_SHARED"]
fn random_points_lie_where_the_cameras_look() {
    for (name, background) in [("chair", false), ("fox", true)] {
        let path = shared(name);
        let data = Dataset::load(&path, &LoadOptions::default()).unwrap();
        let cameras: Vec<_> = data.train.iter().map(|view| view.camera).collect();
        let points = random_points(2000, &cameras, background, 1);
        let world: Vec<DVec3> =
            points.positions.iter().map(|&p| data.normalisation.world_from_scene(p)).collect();
        if name == "chair" {
            // The original's cube of ±1.3.
            let reach = world.iter().map(|p| p.abs().max_element()).fold(0.0, f64::max);
            assert!((1.25..1.4).contains(&reach), "{reach}");
        } else {
            let inside = world.iter().filter(|p| p.abs().max_element() < 1.8).count();
            assert!((900..1700).contains(&inside), "{inside} points are near the fox");
        }
    }
}
