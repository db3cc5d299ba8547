//! Tests of depth in whole datasets, with rendered scenes whose depth is known.

mod checks;
mod reading;

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
static ROOM: LazyLock<tempfile::TempDir> = LazyLock::new(|| written("room"));

/// A built-in scene of eight training views, in a folder of its own.
fn written(preset: &str) -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    let options = Options {
        size: Some((SIDE, SIDE)),
        train: Some(8),
        test: Some(1),
        grid: 1,
        points: PointOptions { count: 1500, ..PointOptions::default() },
        ..Options::default()
    };
    let scene = Scene::prepare(&Source::Preset(preset.into()), &options).unwrap();
    densify_scenegen::write(&scene, folder.path(), false, |_| ()).unwrap();
    folder
}

/// A copy of the room that a test may change.
struct Room(tempfile::TempDir);

impl Room {
    fn new() -> Self {
        let copy = tempfile::tempdir().unwrap();
        copy_folder(ROOM.path(), copy.path());
        Self(copy)
    }

    /// Thin layers, behind which most points are hidden, in place of the room.
    fn layers() -> Self {
        Self(written("layers"))
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
