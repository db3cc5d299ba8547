//! Tests of depth in whole datasets, with a rendered room whose depth is known.

use std::path::{Path, PathBuf};
use std::sync::LazyLock;

use densify_scenegen::{Options, PointOptions, Scene, Source};
use glam::DVec3;

use super::super::{Dataset, LoadOptions, MaskMode, Note, Resolution};
use super::raw::Values;
use super::*;
use crate::error::{DepthRemedy, LoadRemedy};

const SIDE: u32 = 48;

/// A room as `densify scenegen` writes it, made once for all tests.
static ROOM: LazyLock<tempfile::TempDir> = LazyLock::new(|| {
    let folder = tempfile::tempdir().unwrap();
    let options = Options {
        size: Some((SIDE, SIDE)),
        train: Some(8),
        test: Some(1),
        grid: 1,
        points: PointOptions { count: 1500, ..PointOptions::default() },
        ..Options::default()
    };
    let scene = Scene::prepare(&Source::Preset("room".into()), &options).unwrap();
    densify_scenegen::write(&scene, &folder.path().join("room"), false, |_| ()).unwrap();
    folder
});

/// A copy of the room that a test may change.
struct Room(tempfile::TempDir);

impl Room {
    fn new() -> Self {
        let copy = tempfile::tempdir().unwrap();
        copy_folder(&ROOM.path().join("room"), copy.path());
        Self(copy)
    }

    fn path(&self) -> &Path {
        self.0.path()
    }

    /// The arrays of the training views, sorted by name.
    fn arrays(&self) -> Vec<PathBuf> {
        let all = self.path().join("depth/train").read_dir().unwrap();
        let mut all: Vec<PathBuf> = all.map(|entry| entry.unwrap().path()).collect();
        all.retain(|path| path.extension().is_some_and(|ending| ending == "npy"));
        all.sort();
        all
    }

    /// Changes each depth `[world units]`, given the view's number, the pixel and all depths of the view.
    fn edit(&self, change: impl Fn(usize, [u32; 2], &Values) -> f32) -> &Self {
        for (number, path) in self.arrays().iter().enumerate() {
            let mut values = stored(path);
            values.iter_mut().for_each(|value| *value /= 1000.0);
            let changed =
                (0..SIDE * SIDE).map(|i| 1000.0 * change(number, [i % SIDE, i / SIDE], &values));
            write_array(path, (SIDE, SIDE), changed);
        }
        self
    }

    fn load(&self, options: &LoadOptions) -> Result<Dataset, LoadError> {
        Dataset::load(self.path(), options)
    }

    /// The problem and the remedy of depth that is refused; and it is left out if it is not required.
    fn refusal(&self, options: DepthOptions) -> (String, Option<DepthRemedy>) {
        let auto = DepthOptions { choice: DepthChoice::Auto, ..options.clone() };
        // The depth is no longer known to come from densify.
        let _ = std::fs::remove_file(self.path().join("scene.json"));
        let data = self.load(&with(auto)).unwrap();
        assert!(data.depth.is_none() && data.train.iter().all(|view| view.source.depth.is_none()));
        let left_out = data.notes.iter().find_map(|note| match note {
            Note::DepthLeftOut(error) => Some(&**error),
            _ => None,
        });
        let error = self.load(&with(options)).unwrap_err();
        assert_eq!(left_out, Some(&error));
        match error {
            LoadError::Remedied { problem, remedy: LoadRemedy::Depth(remedy) } => {
                (problem, Some(remedy))
            }
            other => (other.to_string(), None),
        }
    }
}

fn copy_folder(from: &Path, to: &Path) {
    std::fs::create_dir_all(to).unwrap();
    for entry in from.read_dir().unwrap() {
        let (path, to) = {
            let entry = entry.unwrap();
            (entry.path(), to.join(entry.file_name()))
        };
        if path.is_dir() { copy_folder(&path, &to) } else { _ = std::fs::copy(&path, &to).unwrap() }
    }
}

/// The values of an array in thousandths, NaN where nothing is seen.
fn stored(path: &Path) -> Values {
    raw::read(&SourceFile::existing(path.to_owned()).unwrap(), DepthKind::Npy, false).unwrap().0
}

fn write_array(path: &Path, (width, height): (u32, u32), values: impl Iterator<Item = f32>) {
    let header =
        format!("{{'descr': '<f4', 'fortran_order': False, 'shape': ({height}, {width}), }}\n");
    let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
    bytes.extend((header.len() as u16).to_le_bytes());
    bytes.extend(header.bytes());
    let known = |value: f32| if value.is_nan() { 0.0 } else { value };
    bytes.extend(values.flat_map(|value| known(value).to_le_bytes()));
    std::fs::write(path, bytes).unwrap();
}

fn with(depth: DepthOptions) -> LoadOptions {
    LoadOptions { depth, ..LoadOptions::default() }
}

fn on() -> DepthOptions {
    DepthOptions { choice: DepthChoice::On, ..DepthOptions::default() }
}

/// Relative error of a view's map against depths `[world units]` at its own resolution, over the pixels that count, and
/// their share.
fn error(data: &Dataset, view: usize, truth: impl Fn(u32, u32) -> f32) -> (f32, f32) {
    let source = &data.train[view].source;
    let map = source.load_depth().unwrap().unwrap();
    let loaded = source.load().unwrap();
    assert_eq!((map.width, map.height), (loaded.width, loaded.height));
    assert_eq!(map.bytes(), 3 * u64::from(map.width) * u64::from(map.height));
    assert!(loaded.bytes() + map.bytes() <= source.loaded_bytes());
    let (mut worst, mut counted) = (0.0_f32, 0);
    for pixel in 0..map.inverse.len() {
        let [inverse, weight] = map.inverse_depth(pixel);
        if weight > 0.0 {
            let world = 1.0 / inverse / data.normalisation.scale as f32;
            let truth = truth(pixel as u32 % map.width, pixel as u32 / map.width);
            worst = worst.max((world / truth - 1.0).abs());
            counted += 1;
        }
    }
    (worst, counted as f32 / map.inverse.len() as f32)
}

#[test]
fn true_depth_is_read_at_every_resolution_and_agrees_with_the_points() {
    let room = Room::new();
    let data = room.load(&with(on())).unwrap();
    let found = data.depth.as_ref().unwrap();
    assert_eq!((found.source, found.views, found.of_views), (DepthOrigin::Maps, 8, 8));
    assert!((found.scale - 1.0).abs() < 0.01 && !found.is_corrected, "{found:?}");
    assert!(found.points > 300 && found.known > 0.5, "{found:?}");
    assert!(data.test.iter().all(|view| view.source.depth.is_none()));
    let whole = stored(&room.arrays()[3]);
    let (worst, counted) = error(&data, 3, |x, y| whole[(x, y)].0[0] / 1000.0);
    assert!(worst < 0.002 && counted > 0.6, "{worst} {counted}");
    let small = LoadOptions { resolution: Some(Resolution::Divisor(2)), ..with(on()) };
    let data = room.load(&small).unwrap();
    // A pixel's centre is the corner of four; the first of them counts.
    let (worst, counted) = error(&data, 3, |x, y| whole[(2 * x + 1, 2 * y + 1)].0[0] / 1000.0);
    assert!(worst < 0.002 && counted > 0.4, "{worst} {counted}");
}

#[test]
fn depth_that_densify_rendered_is_used_only_on_request() {
    let room = Room::new();
    let choices = |choice| with(DepthOptions { choice, ..on() });
    for (choice, is_used) in
        [(DepthChoice::Auto, false), (DepthChoice::Off, false), (DepthChoice::On, true)]
    {
        let data = room.load(&choices(choice)).unwrap();
        assert_eq!(data.depth.is_some(), is_used, "{choice:?}");
        assert_eq!(data.train.iter().any(|view| view.source.depth.is_some()), is_used);
        assert!(!data.notes.iter().any(|note| matches!(note, Note::DepthLeftOut(_))));
    }
    std::fs::remove_file(room.path().join("scene.json")).unwrap();
    assert!(room.load(&choices(DepthChoice::Auto)).unwrap().depth.is_some());
}

#[test]
fn depth_that_disagrees_with_the_points_is_refused_or_left_out() {
    let at = |values: &Values, [x, y]: [u32; 2]| values[(x, y)].0[0];
    // The field of view of the room's cameras follows from the file of poses.
    let focal = {
        let text = std::fs::read_to_string(ROOM.path().join("room/transforms_train.json")).unwrap();
        let json: serde_json::Value = serde_json::from_str(&text).unwrap();
        json["fl_x"].as_f64().unwrap() as f32
    };
    let ray = |[x, y]: [u32; 2]| {
        let along = |i: u32| (i as f32 + 0.5 - 0.5 * SIDE as f32) / focal;
        (along(x).powi(2) + along(y).powi(2) + 1.0).sqrt()
    };
    let refusal = |change: &dyn Fn(usize, [u32; 2], &Values) -> f32| {
        let room = Room::new();
        room.edit(change).refusal(on())
    };
    let (problem, remedy) = refusal(&|_, pixel, values| 1000.0 * at(values, pixel));
    assert!(
        problem.contains("times that of") && problem.contains("unit of 0.000001 would fit"),
        "{problem}"
    );
    assert_eq!(remedy, Some(DepthRemedy::Unit));
    let (problem, remedy) = refusal(&|_, pixel, values| at(values, pixel) / 5.0);
    assert!(problem.contains("0.2") && problem.contains("e-3 would fit"), "{problem}");
    assert_eq!(remedy, Some(DepthRemedy::Unit));
    let (problem, remedy) = refusal(&|_, pixel, values| ray(pixel) * at(values, pixel));
    assert!(problem.contains("along rays") && problem.contains(".npy"), "{problem}");
    assert_eq!(remedy, Some(DepthRemedy::AlongRay));
    let (problem, remedy) = refusal(&|_, pixel, values| 9.0 / at(values, pixel));
    assert!(problem.contains("inverse depth"), "{problem}");
    assert_eq!(remedy, Some(DepthRemedy::Relative));
    let (problem, remedy) = refusal(&|_, [x, y], values| at(values, [x.saturating_sub(3), y]));
    assert!(problem.contains("(3, 0) px"), "{problem}");
    assert_eq!(remedy, Some(DepthRemedy::Register));
    let (problem, remedy) = refusal(&|_, _, _| 0.0);
    assert!(problem.contains("no depth is known in any of 8"), "{problem}");
    assert_eq!(remedy, Some(DepthRemedy::Repair));
    let (problem, _) = refusal(&|_, _, _| f32::INFINITY);
    assert!(problem.contains("no depth is known"), "{problem}");
    let (problem, remedy) = refusal(&|_, _, _| 4.0);
    assert!(problem.contains("only one value"), "{problem}");
    assert_eq!(remedy, Some(DepthRemedy::Repair));
    let (problem, remedy) = refusal(&|_, pixel, values| -at(values, pixel));
    assert!(problem.contains("most depths of the 8 checked views are negative"), "{problem}");
    assert_eq!(remedy, Some(DepthRemedy::Repair));
}

#[test]
fn maps_of_other_views_are_refused() {
    let room = Room::new();
    let maps: Vec<Values> = room.arrays().iter().map(|path| stored(path)).collect();
    let rotated = Room::new();
    rotated.edit(|view, [x, y], _| maps[(view + 1) % 8][(x, y)].0[0] / 1000.0);
    let (problem, remedy) = rotated.refusal(on());
    assert!(problem.contains("other views"), "{problem}");
    assert_eq!(remedy, Some(DepthRemedy::OtherViews));
    let turned = Room::new();
    turned.edit(|view, [x, y], _| maps[view][(SIDE - 1 - x, SIDE - 1 - y)].0[0] / 1000.0);
    assert_eq!(turned.refusal(on()).1, Some(DepthRemedy::OtherViews));
}

#[test]
fn negative_values_and_constant_maps_cost_only_themselves() {
    let room = Room::new();
    room.edit(|view, [x, y], values| match view {
        2 if x < 9 => -1.0,
        5 => 4.0,
        _ => values[(x, y)].0[0],
    });
    let data = room.load(&with(on())).unwrap();
    assert_eq!(data.depth.as_ref().unwrap().views, 7);
    let noted = |note: &Note| note.contains("1 of 8 checked depth maps have only one value");
    assert!(data.notes.iter().any(noted), "{:?}", data.notes);
    assert!(data.train[5].source.depth.is_none());
    let map = data.train[2].source.load_depth().unwrap().unwrap();
    let row = (20 * SIDE) as usize;
    assert!(map.inverse[row..row + 8].iter().all(|x| *x == 0) && map.inverse[row + 30] > 0);
}

#[test]
fn confidences_may_have_16_bits_but_must_not_all_be_0() {
    let room = Room::new();
    let path = |array: &Path| {
        room.path().join(format!("confidence/train/{}.png", array.file_stem().unwrap().display()))
    };
    let write = |level: u16| {
        for array in room.arrays() {
            let path = path(&array);
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            image::ImageBuffer::from_pixel(SIDE, SIDE, image::Luma([level])).save(&path).unwrap();
        }
    };
    write(2);
    let data = room.load(&with(on())).unwrap();
    let map = data.train[0].source.load_depth().unwrap().unwrap();
    assert!(map.confidence.contains(&255));
    write(0);
    let (problem, remedy) = room.refusal(on());
    assert!(problem.contains("all confidences are 0"), "{problem}");
    assert_eq!(remedy, Some(DepthRemedy::Repair));
}

#[test]
fn faults_of_depth_do_not_end_runs_without_depth() {
    let room = Room::new();
    let list = room.path().join("transforms_train.json");
    let text = std::fs::read_to_string(&list).unwrap();
    let mut json: serde_json::Value = serde_json::from_str(&text).unwrap();
    for (name, value) in [
        ("depth_file_path", serde_json::json!(7)),
        ("depth_file_path", serde_json::json!("scene.txt")),
        ("depth_file_path", serde_json::json!("../../depth.npy")),
    ] {
        json["frames"][0][name] = value;
        std::fs::write(&list, json.to_string()).unwrap();
        std::fs::write(room.path().join("scene.txt"), "").unwrap();
        assert_eq!(room.refusal(on()).1, Some(DepthRemedy::LeaveOut), "{name}");
        let off = room.load(&LoadOptions::default()).unwrap();
        assert!(!off.notes.iter().any(|note| matches!(note, Note::DepthLeftOut(_))));
    }
}

#[test]
fn a_map_damaged_after_the_checks_costs_the_depth_of_its_view() {
    let room = Room::new();
    let [tolerant, strict] = [true, false]
        .map(|drops_damaged| room.load(&with(DepthOptions { drops_damaged, ..on() })).unwrap());
    std::fs::write(&room.arrays()[3], b"\x93NUMPY\x01\x00").unwrap();
    assert!(strict.train[3].source.load_depth().unwrap_err().to_string().contains(".npy"));
    assert_eq!(strict.take_depth_faults(), []);
    for _ in 0..2 {
        assert_eq!(tolerant.train[3].source.load_depth(), Ok(None));
    }
    assert!(tolerant.train[2].source.load_depth().unwrap().is_some());
    let faults = tolerant.take_depth_faults();
    assert!(matches!(&faults[..], [Note::DepthDropped(_)]), "{faults:?}");
}

#[test]
fn along_rays_and_small_errors_in_scale_are_corrected() {
    let room = Room::new();
    let truth = stored(&room.arrays()[5]);
    room.edit(|_, [x, y], values| 1.07 * values[(x, y)].0[0]);
    let data = room.load(&with(on())).unwrap();
    let found = data.depth.as_ref().unwrap();
    assert!((found.scale - 1.07).abs() < 0.01 && found.is_corrected, "{found:?}");
    let noted = |note: &Note| note.contains("% too large");
    assert!(data.notes.iter().any(noted), "{:?}", data.notes);
    let (worst, _) = error(&data, 5, |x, y| truth[(x, y)].0[0] / 1000.0);
    assert!(worst < 0.01, "{worst}");
    // Read as distances along rays, the same values are refused as what they are.
    let (problem, remedy) = room.refusal(DepthOptions { along: DepthAlong::Ray, ..on() });
    assert!(problem.contains("optical axis"), "{problem}");
    assert_eq!(remedy, Some(DepthRemedy::AlongAxis));
}

#[test]
fn relative_depth_is_fitted_to_each_view() {
    let room = Room::new();
    let truth: Vec<Values> = room.arrays().iter().map(|path| stored(path)).collect();
    room.edit(|view, [x, y], values| {
        let (scale, offset) = (3.0 + view as f32, 0.1 * view as f32);
        scale / values[(x, y)].0[0] + offset
    });
    let options = DepthOptions { unit: Some(DepthUnit::Relative), ..on() };
    let data = room.load(&with(options.clone())).unwrap();
    assert_eq!(data.depth.as_ref().unwrap().source, DepthOrigin::RelativeMaps);
    let mut fitted = 0;
    for view in 0..8 {
        // A view of a bare wall does not determine a scale.
        let Some(map) = data.train[view].source.load_depth().unwrap() else { continue };
        fitted += 1;
        let mut errors: Vec<f32> = (0..map.inverse.len())
            .filter(|&pixel| map.inverse_depth(pixel)[1] > 0.0)
            .map(|pixel| {
                let world = 1.0 / map.inverse_depth(pixel)[0] / data.normalisation.scale as f32;
                let truth = truth[view].as_raw()[pixel] / 1000.0;
                (world / truth - 1.0).abs()
            })
            .collect();
        errors.sort_by(f32::total_cmp);
        assert!(errors[errors.len() / 2] < 0.05, "view {view}: {}", errors[errors.len() / 2]);
    }
    assert!(fitted >= 7, "{fitted}");
    // Depth itself is not inverse depth.
    let room = Room::new();
    assert_eq!(room.refusal(options).1, Some(DepthRemedy::NotRelative));
}

#[test]
fn views_without_depth_are_counted_and_confidence_is_read() {
    let room = Room::new();
    std::fs::remove_file(&room.arrays()[0]).unwrap();
    std::fs::remove_file(room.arrays()[0].with_file_name("0000.exr")).ok();
    let exr: Vec<PathBuf> =
        room.path().join("depth/train").read_dir().unwrap().map(|e| e.unwrap().path()).collect();
    for path in exr.iter().filter(|path| path.extension().is_some_and(|e| e == "exr")) {
        let _ = std::fs::remove_file(path);
    }
    let stem = room.arrays()[0].file_stem().unwrap().to_str().unwrap().to_owned();
    let confidence = room.path().join(format!("confidence/train/{stem}.png"));
    std::fs::create_dir_all(confidence.parent().unwrap()).unwrap();
    image::GrayImage::from_fn(SIDE, SIDE, |x, _| [(3 * x / SIDE) as u8].into())
        .save(&confidence)
        .unwrap();
    let data = room.load(&with(on())).unwrap();
    assert_eq!(data.depth.as_ref().unwrap().views, 7);
    assert!(
        data.notes.iter().any(|note| note.contains("1 of 8 views have no depth")),
        "{:?}",
        data.notes
    );
    let view = data.train.iter().find(|view| view.name.contains(&stem)).unwrap();
    let map = view.source.load_depth().unwrap().unwrap();
    let levels: std::collections::BTreeSet<u8> = map.confidence.iter().copied().collect();
    assert_eq!(levels.into_iter().collect::<Vec<_>>(), [0, 127, 255]);
    image::GrayImage::new(SIDE, SIDE / 2).save(&confidence).unwrap();
    assert!(room.refusal(on()).0.contains("instead of the depth map's 48x48 px"));
}

#[test]
fn pictures_of_depth_and_other_sizes_are_refused() {
    let of_png = |picture: image::DynamicImage| {
        let room = Room::new();
        for path in room.arrays() {
            picture.save(path.with_extension("png")).unwrap();
            std::fs::remove_file(path.with_extension("npy")).unwrap();
            std::fs::remove_file(path.with_extension("exr")).unwrap();
        }
        room.refusal(on()).0
    };
    let message = of_png(image::GrayImage::new(SIDE, SIDE).into());
    assert!(message.contains("8 bits"), "{message}");
    let message = of_png(image::ImageBuffer::<image::Luma<u16>, _>::new(SIDE, SIDE / 2).into());
    assert!(message.contains("proportions"), "{message}");
    let room = Room::new();
    std::fs::write(&room.arrays()[0], b"\x93NUMPY\x01\x00").unwrap();
    assert!(room.refusal(on()).0.contains(".npy"));
    let empty = Room::new();
    std::fs::remove_dir_all(empty.path().join("depth")).unwrap();
    let error = empty.load(&with(on())).unwrap_err();
    assert!(error.to_string().contains("no training view has depth"), "{error}");
}

#[test]
fn depth_in_open_exr_and_with_a_mask_and_a_smaller_map_is_read() {
    let room = Room::new();
    let truth = stored(&room.arrays()[2]);
    for path in room.arrays() {
        std::fs::remove_file(path).unwrap();
    }
    let options = LoadOptions { mask_mode: MaskMode::Ignore, ..with(on()) };
    let data = room.load(&options).unwrap();
    let (worst, _) = error(&data, 2, |x, y| truth[(x, y)].0[0] / 1000.0);
    assert!(worst < 0.002, "{worst}");
    // A map of half the size: each of its pixels covers four of the photograph.
    let room = Room::new();
    for path in room.arrays() {
        let whole = stored(&path);
        let half =
            (0..SIDE * SIDE / 4).map(|i| whole[(2 * (i % (SIDE / 2)), 2 * (i / (SIDE / 2)))].0[0]);
        write_array(&path, (SIDE / 2, SIDE / 2), half);
    }
    let data = room.load(&with(on())).unwrap();
    let (worst, counted) = error(&data, 2, |x, y| truth[(x / 2 * 2, y / 2 * 2)].0[0] / 1000.0);
    assert!(worst < 0.002 && counted > 0.1, "{worst} {counted}");
}

#[test]
fn noise_is_no_edge() {
    let known = |noise: f32| {
        let room = Room::new();
        room.edit(|view, [x, y], values| {
            let mixed =
                (view as u64 * 7919 + u64::from(y * SIDE + x)).wrapping_mul(0x9E37_79B9_7F4A_7C15);
            let unit = (mixed >> 40) as f32 / 16_777_216.0;
            values[(x, y)].0[0] * (1.0 + noise * (unit - 0.5))
        });
        room.load(&with(on())).unwrap().depth.unwrap().known
    };
    let (clean, noisy) = (known(0.0), known(0.2));
    assert!(noisy > 0.9 * clean && noisy < 0.99, "{noisy} with noise, {clean} without");
}

#[test]
fn points_become_sparse_depth() {
    let room = Room::new();
    let points = Some(room.path().join("points3d.ply"));
    let data = room.load(&with(DepthOptions { points, ..on() })).unwrap();
    let found = data.depth.as_ref().unwrap();
    assert_eq!((found.source, found.views), (DepthOrigin::Points, 8));
    assert!(found.known > 0.005 && found.known < 0.4, "{found:?}");
    assert!(found.points > 0, "{found:?}");
    let cloud = |name: &str, change: &dyn Fn(DVec3) -> DVec3| {
        let path = room.path().join(name);
        let (points, _) = crate::points::read_points(&room.path().join("points3d.ply")).unwrap();
        let rows = points.positions.iter().map(|&point| {
            let DVec3 { x, y, z } = change(point);
            format!("{x} {y} {z}\n")
        });
        let header = format!(
            "ply\nformat ascii 1.0\nelement vertex {}\nproperty float x\nproperty float y\nproperty float z\n\
             end_header\n",
            points.len()
        );
        std::fs::write(&path, header + &rows.collect::<String>()).unwrap();
        DepthOptions { points: Some(path), ..on() }
    };
    let refused = |options| match room.load(&with(options)).map(|data| data.depth).unwrap_err() {
        LoadError::Remedied { problem, remedy: LoadRemedy::Depth(remedy) } => (problem, remedy),
        other => panic!("{other}"),
    };
    // A cloud in other units, around the middle of the cameras, and one that no view shows.
    let (problem, remedy) = refused(cloud("scaled.ply", &|point| 1.5 * point));
    assert_eq!(remedy, DepthRemedy::Align, "{problem}");
    let (problem, remedy) = refused(cloud("away.ply", &|point| point + DVec3::splat(1e4)));
    assert_eq!(remedy, DepthRemedy::Align, "{problem}");
    assert!(problem.contains("none of the 8 checked views"), "{problem}");
    // Without other points the cloud seeds the scene, whether its depth is used or not, and is not compared with itself.
    let same = cloud("same.ply", &|point| point);
    std::fs::remove_file(room.path().join("points3d.ply")).unwrap();
    for split in ["train", "test"] {
        let list = room.path().join(format!("transforms_{split}.json"));
        let text = std::fs::read_to_string(&list).unwrap();
        let mut json: serde_json::Value = serde_json::from_str(&text).unwrap();
        json.as_object_mut().unwrap().remove("ply_file_path");
        std::fs::write(&list, json.to_string()).unwrap();
    }
    let seeded = room.load(&with(same.clone())).unwrap();
    assert_eq!(seeded.depth.as_ref().map(|found| found.points), Some(0));
    let off = room.load(&with(DepthOptions { choice: DepthChoice::Off, ..same })).unwrap();
    assert!(off.depth.is_none() && off.points.len() == seeded.points.len());
    assert!(off.points.len() > 100);
    let none = DepthOptions { points: Some("missing.ply".into()), ..on() };
    assert!(room.load(&with(none)).unwrap_err().to_string().contains("missing.ply"));
}

#[test]
fn built_in_scenes_have_the_depth_of_their_surface() {
    let path = Path::new("scene:spheres");
    let small = |depth| LoadOptions { resolution: Some(Resolution::Width(16)), ..with(depth) };
    let data = Dataset::load(path, &small(on())).unwrap();
    let found = data.depth.as_ref().unwrap();
    assert_eq!((found.source, found.views), (DepthOrigin::Surface, data.train.len()));
    let map = data.train[0].source.load_depth().unwrap().unwrap();
    assert_eq!(map.width, data.train[0].camera.width);
    let depth = data.train[0].source.depth.as_ref().unwrap();
    assert!(depth.pixel_bytes() >= 4 * 16 * 16 && depth.held_bytes() < 4 * 16 * 16);
    let auto = DepthOptions { choice: DepthChoice::Auto, ..on() };
    assert!(Dataset::load(path, &small(auto)).unwrap().depth.is_none());
}

#[test]
fn damaged_files_are_errors_and_never_panics() {
    let room = Room::new();
    let array = room.arrays()[0].clone();
    let (width, height) = (5, 4);
    let png = room.path().join("a.png");
    image::ImageBuffer::from_fn(width, height, |x, y| image::Luma([(700 * x + y) as u16]))
        .save(&png)
        .unwrap();
    let colmap = room.path().join("a.bin");
    let values: Vec<u8> = (0..width * height).flat_map(|i| (i as f32).to_le_bytes()).collect();
    std::fs::write(&colmap, [format!("{width}&{height}&1&").as_bytes(), &values].concat()).unwrap();
    let mut refused = 0;
    for (path, kind) in [
        (array.clone(), DepthKind::Npy),
        (array.with_extension("exr"), DepthKind::Exr),
        (png, DepthKind::Png),
        (colmap, DepthKind::Colmap),
    ] {
        let whole = std::fs::read(&path).unwrap();
        let read = |bytes: &[u8]| {
            std::fs::write(&path, bytes).unwrap();
            let source = SourceFile::existing(path.clone()).unwrap();
            // Headers of damaged files may be fine, but then the values must have their size.
            let header = raw::read_header(&source, kind);
            let values = raw::read(&source, kind, true);
            if let (Ok(header), Ok(values)) = (&header, &values) {
                assert_eq!((header.width, header.height), values.0.dimensions(), "{kind:?}");
            }
            usize::from(values.is_err())
        };
        assert_eq!(read(&whole), 0, "{kind:?}");
        for at in (0..whole.len().min(400)).chain([whole.len() - 1]) {
            refused += read(&whole[..at]);
            let mut flipped = whole.clone();
            flipped[at] ^= 1 << (at % 8);
            refused += read(&flipped);
        }
    }
    assert!(refused > 800, "{refused}");
}

#[test]
fn depth_of_polycam_is_found_beside_its_corrected_images() {
    let room = Room::new();
    let _ = std::fs::remove_file(room.path().join("scene.json"));
    let [images, depth] = ["corrected_images", "depth"].map(|name| {
        let folder = room.path().join("keyframes").join(name);
        std::fs::create_dir_all(&folder).unwrap();
        folder
    });
    let list = room.path().join("transforms_train.json");
    let mut json: serde_json::Value =
        serde_json::from_str(&std::fs::read_to_string(&list).unwrap()).unwrap();
    for (frame, array) in json["frames"].as_array_mut().unwrap().iter_mut().zip(room.arrays()) {
        let image = room.path().join(frame["file_path"].as_str().unwrap()).with_extension("png");
        let stem = array.file_stem().unwrap().to_str().unwrap().to_owned();
        std::fs::copy(image, images.join(format!("{stem}.png"))).unwrap();
        std::fs::copy(&array, depth.join(format!("{stem}.npy"))).unwrap();
        frame["file_path"] = format!("keyframes/corrected_images/{stem}.png").into();
        frame.as_object_mut().unwrap().remove("depth_file_path");
    }
    std::fs::write(&list, json.to_string()).unwrap();
    std::fs::remove_dir_all(room.path().join("depth")).unwrap();
    assert_eq!(room.load(&with(on())).unwrap().depth.unwrap().views, 8);
}

#[test]
fn notes_about_depth_in_an_archive_name_the_archive() {
    use std::io::Write;
    let room = Room::new();
    let _ = std::fs::remove_file(room.path().join("scene.json"));
    room.edit(|_, _, _| 4.0);
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("my room.zip");
    let mut archive = zip::ZipWriter::new(std::fs::File::create(&path).unwrap());
    let mut folders = vec![room.path().to_owned()];
    while let Some(folder) = folders.pop() {
        for entry in folder.read_dir().unwrap() {
            let entry = entry.unwrap().path();
            if entry.is_dir() {
                folders.push(entry);
                continue;
            }
            let name = entry.strip_prefix(room.path()).unwrap().to_str().unwrap();
            archive.start_file(name, zip::write::SimpleFileOptions::default()).unwrap();
            archive.write_all(&std::fs::read(&entry).unwrap()).unwrap();
        }
    }
    archive.finish().unwrap();
    let auto = DepthOptions { choice: DepthChoice::Auto, ..on() };
    let data = Dataset::load(&path, &with(auto)).unwrap();
    let left_out = data.notes.iter().find_map(|note| match note {
        Note::DepthLeftOut(error) => Some(error.to_string()),
        _ => None,
    });
    let left_out = left_out.unwrap();
    assert!(left_out.starts_with(path.to_str().unwrap()), "{left_out}");
}
