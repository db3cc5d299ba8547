//! One function per format that strangers' files come in. Whatever the bytes are, it must return
//! whether they were accepted: no panic, no hang, no allocation that the file's size does not account
//! for.
//!
//! `cargo fuzz` drives them without end (see CONTRIBUTING.md), and `tests/it/fuzz.rs` for a moment
//! in every test run, from the same corpora.

use std::path::Path;

use densify::backend::Differentiable;
use densify::backend::cpu::{CpuBackend, CpuOptions, ImageGradient};
use densify::camera::Camera;
use densify::checkpoint::Checkpoint;
use densify::dataset::{Dataset, LoadOptions};
use densify::gaussians::Gaussians;
use densify::import::ply::{read_points, read_splats};
use densify::run::RunConfig;
use densify_scenegen::{Options, PointOptions, Scene, Source};
use glam::{DMat3, DQuat, DVec3};

/// A format and what reads it.
pub type Format = (&'static str, fn(&[u8]) -> bool);

/// All of them. The names are those of the fuzz targets in `Cargo.toml` and of the corpora's folders.
pub const FORMATS: [Format; 11] = [
    ("colmap_bin", colmap_bin),
    ("colmap_txt", colmap_txt),
    ("transforms", transforms),
    ("ply", ply),
    ("gltf", gltf),
    ("glb", glb),
    ("obj", obj),
    ("checkpoint", checkpoint),
    ("config", config),
    ("image", image),
    ("scene", scene),
];

/// Reads bytes as a file of a format.
///
/// # Panics
/// When there is no such format, or the bytes do to it what they must not.
pub fn read(format: &str, bytes: &[u8]) -> bool {
    let known = FORMATS.iter().find(|(name, _)| *name == format);
    known.expect("a format").1(bytes)
}

/// What stands between the files of a format that has several.
const BETWEEN: &[u8] = b"\n=====\n";

/// The photographs of datasets whose other files are looked at.
const PHOTOGRAPH: &[u8] = include_bytes!("corpus/image/photograph.png");

/// `cameras.bin`, `images.bin` and `points3D.bin`.
fn colmap_bin(bytes: &[u8]) -> bool {
    colmap(bytes, ["cameras.bin", "images.bin", "points3D.bin"])
}

/// `cameras.txt`, `images.txt` and `points3D.txt`.
fn colmap_txt(bytes: &[u8]) -> bool {
    colmap(bytes, ["cameras.txt", "images.txt", "points3D.txt"])
}

fn colmap(bytes: &[u8], names: [&str; 3]) -> bool {
    let mut files = split(bytes);
    let [a, b, c] = names.map(|name| (format!("sparse/0/{name}"), files.next().unwrap_or(&[])));
    dataset(&[(&a.0, a.1), (&b.0, b.1), (&c.0, c.1)])
}

/// `transforms.json`.
fn transforms(bytes: &[u8]) -> bool {
    dataset(&[("transforms.json", bytes)])
}

/// A photograph: its header when the dataset is loaded, its pixels after that.
fn image(bytes: &[u8]) -> bool {
    let listing = br#"{"camera_angle_x": 0.8, "frames": [
        {"file_path": "images/0.png", "transform_matrix": [[1,0,0,0],[0,1,0,0],[0,0,1,4],[0,0,0,1]]},
        {"file_path": "images/1.png", "transform_matrix": [[1,0,0,1],[0,1,0,0],[0,0,1,4],[0,0,0,1]]}]}"#;
    dataset(&[("transforms.json", listing), ("images/0.png", bytes), ("images/1.png", bytes)])
}

/// A PLY file, as a model and as a cloud of points.
fn ply(bytes: &[u8]) -> bool {
    within(&[("model.ply", bytes)], |folder| {
        let path = folder.join("model.ply");
        let model = read_splats(&path);
        if let Ok(file) = &model {
            assert_eq!(file.gaussians.opacity_logits.len(), file.gaussians.len());
        }
        let points = read_points(&path);
        if let Ok(points) = &points {
            assert_eq!(points.colours.len(), points.positions.len());
        }
        model.is_ok() || points.is_ok()
    })
}

/// A glTF file with everything inside.
fn gltf(bytes: &[u8]) -> bool {
    mesh(&[("mesh.gltf", bytes)])
}

/// A binary glTF file.
fn glb(bytes: &[u8]) -> bool {
    mesh(&[("mesh.glb", bytes)])
}

/// An OBJ file and its `mesh.mtl`.
fn obj(bytes: &[u8]) -> bool {
    let mut files = split(bytes);
    let (mesh_file, library) = (files.next().unwrap_or(&[]), files.next().unwrap_or(&[]));
    mesh(&[("mesh.obj", mesh_file), ("mesh.mtl", library), ("texture.png", PHOTOGRAPH)])
}

/// A checkpoint: its header, its model, and what a backend keeps beside it.
fn checkpoint(bytes: &[u8]) -> bool {
    within(&[("step.safetensors", bytes)], |folder| {
        let Ok(mut found) = Checkpoint::open(&folder.join("step.safetensors")) else {
            return false;
        };
        let budget = found.header().budget;
        let Ok(model) = found.blank_model() else {
            return false;
        };
        assert!(model.len() <= budget);
        let options = CpuOptions { threads: Some(1), ..CpuOptions::new(model.len()) };
        let mut backend = CpuBackend::new(&model, &options).expect("it is as small as its file");
        // Whether this backend keeps what the file's kept is another question.
        let _ = found.restore(&mut backend);
        true
    })
}

/// `config.toml` of a run.
fn config(bytes: &[u8]) -> bool {
    within(&[("config.toml", bytes)], |folder| {
        let config = RunConfig::read(folder);
        config.is_ok_and(|config| !config.scene_path().as_os_str().is_empty())
    })
}

/// Log-scales up to which gradients must be finite.
const LARGEST_LOG_SCALE: f32 = 20.0;

/// Any finite Gaussians, rendered and differentiated: all pixels must be finite, and all gradients of
/// rows that can come up in training.
/// 52 bytes are a camera, each 92 after them a row.
fn scene(bytes: &[u8]) -> bool {
    let mut numbers = Numbers { bytes };
    let camera = camera(&mut numbers);
    let mut model = Gaussians { sh_degree: 1, ..Gaussians::default() };
    while !numbers.bytes.is_empty() && model.len() < 64 {
        model.means.push(std::array::from_fn(|_| numbers.within(1e6)));
        model.log_scales.push(std::array::from_fn(|_| numbers.within(40.0)));
        // Shorter ones no file brings in (`src/ply/splats.rs`): a gradient is as many times longer.
        let quat = DQuat::from_array(std::array::from_fn(|_| f64::from(numbers.within(1e10))));
        let quat = if quat.length() > 1e-6 { quat } else { DQuat::IDENTITY };
        model.quats.push(quat.to_array().map(|v| v as f32));
        model.opacity_logits.push(numbers.within(100.0));
        model.sh.extend((0..12).map(|_| numbers.within(1e6)));
    }
    let mut options = CpuOptions::new(model.len().max(1));
    options.threads = Some(1);
    options.tile_cap = 256;
    let mut backend = CpuBackend::new(&model, &options).expect("a few rows fit");
    let pixels = (camera.width * camera.height) as usize;
    let upstream = ImageGradient {
        rgb: (0..3 * pixels).map(|i| (i % 7) as f32 - 3.0).collect(),
        alpha: vec![0.5; pixels],
        depth: vec![0.0; pixels],
    };
    let outcome = backend.differentiate(&camera, [0.2, 0.5, 0.8], 1, &upstream);
    let (rendering, gradient) = outcome.expect("a small image is rendered");
    assert!(rendering.rgb.iter().chain(&rendering.alpha).all(|v| v.is_finite()));
    let (means, log_scales) = (gradient.means.as_flattened(), gradient.log_scales.as_flattened());
    let classes: [(&str, &[f32], usize); 5] = [
        ("mean", means, 3),
        ("log_scale", log_scales, 3),
        ("quat", gradient.quats.as_flattened(), 4),
        ("opacity", &gradient.opacity_logits, 1),
        ("sh", &gradient.sh, 12),
    ];
    for (class, values, width) in classes {
        for (row, values) in values.chunks(width).enumerate() {
            // The optimiser keeps them below 2.3, and no other row is differentiated in training;
            // products of squares leave f32 beyond some e²⁰.
            let is_trainable = model.log_scales[row].iter().all(|s| *s <= LARGEST_LOG_SCALE);
            let finite = !is_trainable || values.iter().all(|g| g.is_finite());
            assert!(
                finite,
                "gradient of {class} {row}: {values:?}; mean {:?}, log_scale {:?}, quat {:?}, \
                 opacity {}, {camera:?}",
                model.means[row],
                model.log_scales[row],
                model.quats[row],
                model.opacity_logits[row],
            );
        }
    }
    true
}

fn camera(numbers: &mut Numbers) -> Camera {
    let size = |number: f32| number.abs() as u32 % 96 + 1;
    let (width, height) = (size(numbers.within(1e6)), size(numbers.within(1e6)));
    let mut positive = |most: f32| f64::from(numbers.within(most).abs().max(1e-2));
    let (fx, fy) = (positive(1e4), positive(1e4));
    let (cx, cy) = (positive(1e3), positive(1e3));
    let turn = DQuat::from_array(std::array::from_fn(|_| f64::from(numbers.within(1.0))));
    let turn = if turn.length() > 1e-3 { turn.normalize() } else { DQuat::IDENTITY };
    let translation = DVec3::from_array(std::array::from_fn(|_| f64::from(numbers.within(1e3))));
    let rotation = DMat3::from_quat(turn);
    Camera { width, height, fx, fy, cx, cy, rotation, translation }
}

/// Bytes as numbers: any bits, and what is not finite or too large is brought back.
struct Numbers<'a> {
    bytes: &'a [u8],
}

impl Numbers<'_> {
    fn within(&mut self, most: f32) -> f32 {
        let (first, rest) = self.bytes.split_at(self.bytes.len().min(4));
        self.bytes = rest;
        let bits = first.iter().fold(0, |bits, &byte| bits << 8 | u32::from(byte));
        let number = f32::from_bits(bits);
        if number.is_finite() { number.clamp(-most, most) } else { most }
    }
}

fn dataset(files: &[(&str, &[u8])]) -> bool {
    let images = ["images/0.png", "images/1.png"].map(|name| (name, PHOTOGRAPH));
    let all: Vec<_> = images.into_iter().chain(files.iter().copied()).collect();
    within(&all, |folder| {
        let options = LoadOptions { tracks: true, ..LoadOptions::default() };
        let Ok(dataset) = Dataset::load(folder, &options) else {
            return false;
        };
        assert!(!dataset.train.is_empty());
        dataset.train.iter().all(|view| {
            let Ok(image) = view.source.load() else { return false };
            assert_eq!((image.width, image.height), (view.camera.width, view.camera.height));
            true
        })
    })
}

fn mesh(files: &[(&str, &[u8])]) -> bool {
    within(files, |folder| {
        let options = Options {
            size: Some((8, 8)),
            train: Some(2),
            test: Some(1),
            grid: 1,
            points: PointOptions { count: 8, ..PointOptions::default() },
            ..Options::default()
        };
        let source = Source::File(folder.join(files[0].0));
        let Ok(scene) = Scene::prepare(&source, &options) else { return false };
        assert!(scene.render(0).depth.iter().all(|z| z.is_finite()));
        true
    })
}

/// The files of an input that stands for several.
fn split(bytes: &[u8]) -> impl Iterator<Item = &[u8]> {
    let mut rest = Some(bytes);
    std::iter::from_fn(move || {
        let all = rest?;
        let at = all.windows(BETWEEN.len()).position(|window| window == BETWEEN);
        rest = at.map(|at| &all[at + BETWEEN.len()..]);
        Some(&all[..at.unwrap_or(all.len())])
    })
}

/// Writes files into a folder of their own, and looks at it.
fn within(files: &[(&str, &[u8])], look: impl FnOnce(&Path) -> bool) -> bool {
    let folder = tempfile::tempdir().expect("a folder");
    for (name, bytes) in files {
        let path = folder.path().join(name);
        if let Some(parent) = path.parent() {
            std::fs::create_dir_all(parent).expect("a folder");
        }
        std::fs::write(path, bytes).expect("a file");
    }
    look(folder.path())
}
