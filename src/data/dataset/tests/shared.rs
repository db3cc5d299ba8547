//! Tests that load real datasets from the folder `DENSIFY_SHARED` or, if it is not set, `../shared`.

use super::super::*;
use densify_fixtures::shared;

/// Name, numbers of training and test views, size of the images, number of points, whether the lens is
/// distorted.
type Expected = (&'static str, (usize, usize), (u32, u32), usize, bool);

const DATASETS: [Expected; 6] = [
    ("room256", (40, 8), (256, 256), 5000, false),
    ("cup", (67, 10), (256, 192), 9262, false),
    ("office", (112, 16), (192, 256), 5751, false),
    ("beercan", (62, 9), (144, 256), 4414, true),
    ("fox", (43, 7), (288, 512), 0, true),
    ("chair", (100, 200), (256, 256), 0, false),
];

#[test]
#[ignore = "needs real photographs: set DENSIFY_SHARED"]
fn real_datasets_load() {
    for (name, views, size, points, undistorted) in DATASETS {
        let path = shared(name);
        let options = LoadOptions { split: Split::Eval, ..LoadOptions::default() };
        let data = Dataset::load(&path, &options).unwrap_or_else(|e| panic!("{name}: {e}"));
        assert_eq!((data.train.len(), data.test.len()), views, "{name}");
        assert_eq!(data.points.len(), points, "{name}");
        let reach = data.train.iter().map(|view| view.camera.centre().length()).fold(0.0, f64::max);
        assert!((reach - 1.0).abs() < 1e-9, "{name}: {reach}");
        for view in data.train.iter().chain(&data.test) {
            // Sides differ by a few pixels between the cameras of `office`.
            let (width, height) = (view.camera.width, view.camera.height);
            let near = width.abs_diff(size.0).max(height.abs_diff(size.1)) <= 3;
            assert!(near, "{name} {}: {width}x{height}", view.name);
            assert_eq!(view.source.undistortion.is_some(), undistorted, "{name} {}", view.name);
            assert!(view.camera.fx > 100.0 && view.camera.fx < 600.0, "{name} {}", view.name);
        }
        for view in data.train.iter().step_by(20) {
            let image = view.source.load().unwrap();
            let size = (view.camera.width, view.camera.height);
            assert_eq!((image.width, image.height), size, "{name}");
            assert_eq!(image.alpha.is_some(), name == "chair", "{name} {}", view.name);
            assert!(image.bytes() <= view.source.loaded_bytes());
        }
        if name == "fox" {
            assert!(data.notes.iter().any(|note| note.contains("17 of 67")), "{:?}", data.notes);
        }
        if points > 0 {
            // Points were reconstructed from the photographs: all but a few are in view of one of the cameras.
            let seen_by = |camera: &Camera, p: DVec3| {
                let (pixel, depth) = camera.project(p);
                let (w, h) = (f64::from(camera.width), f64::from(camera.height));
                depth > 0.0 && pixel.x >= 0.0 && pixel.y >= 0.0 && pixel.x <= w && pixel.y <= h
            };
            let seen = |p: &&DVec3| data.train.iter().any(|view| seen_by(&view.camera, **p));
            let share = data.points.positions.iter().filter(seen).count() as f64 / points as f64;
            assert!(share > 0.97, "{name}: {share} of the points are in view");
        }
    }
}

/// Datasets that reproduce public bug reports.
#[test]
#[ignore = "needs shared data"]
fn shared_cases_load_or_fail_as_expected() {
    let case = |name: &str| Dataset::load(&shared("../cases").join(name), &LoadOptions::default());
    for (name, train, test) in [("split/both", 10, 3), ("split/subset", 4, 4)] {
        let data = case(name).unwrap_or_else(|e| panic!("{name}: {e}"));
        assert_eq!((data.train.len(), data.test.len()), (train, test), "{name}");
    }
    let message = case("colmap/eq1").unwrap_err().to_string();
    assert!(message.contains("EQUIRECTANGULAR") && message.contains("cube"), "{message}");
}
