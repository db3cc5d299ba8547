//! One fuzz target per format of untrusted files: a function that reads arbitrary bytes and returns true
//! if they are accepted. It must not panic, hang, or allocate more memory than the file's size justifies.
//!
//! `cargo fuzz` runs the targets for as long as wanted (see CONTRIBUTING.md), and `tests/it/fuzz.rs`
//! briefly in every test run, with the same corpora.

use std::path::Path;

use densify::data::dataset::{Dataset, LoadOptions};
use densify::data::import::ply::read_points;
use densify::data::import::read_model;
use densify::render::Setup;
use densify::render::cpu::CpuBackend;
use densify::run::RunConfig;
use densify::train::checkpoint::Checkpoint;
use densify_scenegen::{Options, PointOptions, Scene, Source};

/// The name of a format, and the function that reads it.
pub type Format = (&'static str, fn(&[u8]) -> bool);

/// All formats. Their names are those of the fuzz targets in `Cargo.toml` and of the corpora's folders.
pub const FORMATS: [Format; 17] = [
    ("colmap_bin", colmap_bin),
    ("colmap_txt", colmap_txt),
    ("transforms", transforms),
    ("realitycapture", realitycapture),
    ("archive", archive),
    ("ply", ply),
    ("gltf", gltf),
    ("glb", glb),
    ("obj", obj),
    ("checkpoint", checkpoint),
    ("config", config),
    ("image", image),
    ("spz", spz),
    ("sog", sog),
    ("sog_folder", sog_folder),
    ("splat", splat),
    ("splat_glb", splat_glb),
];

/// Reads bytes as a file of a format; true if they are accepted.
///
/// # Panics
/// If there is no such format, or the bytes reveal a bug in its reader.
pub fn read(format: &str, bytes: &[u8]) -> bool {
    let known = FORMATS.iter().find(|(name, _)| *name == format);
    known.expect("a known format").1(bytes)
}

/// Separates the files of an input that consists of several.
const SEPARATOR: &[u8] = b"\n=====\n";

/// The photograph used wherever another file is tested.
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

/// RealityCapture's table of cameras.
fn realitycapture(bytes: &[u8]) -> bool {
    dataset(&[("cameras.csv", bytes)])
}

/// A dataset in a ZIP archive.
fn archive(bytes: &[u8]) -> bool {
    in_folder(&[("scan.zip", bytes)], |folder| loads(&folder.join("scan.zip")))
}

/// A photograph: loading the dataset reads its header, loading the view its pixels.
fn image(bytes: &[u8]) -> bool {
    let frames = br#"{"camera_angle_x": 0.8, "frames": [
        {"file_path": "images/0.png", "transform_matrix": [[1,0,0,0],[0,1,0,0],[0,0,1,4],[0,0,0,1]]},
        {"file_path": "images/1.png", "transform_matrix": [[1,0,0,1],[0,1,0,0],[0,0,1,4],[0,0,0,1]]}]}"#;
    dataset(&[("transforms.json", frames), ("images/0.png", bytes), ("images/1.png", bytes)])
}

/// A PLY file, read as a model, compressed or not, and as a point cloud.
fn ply(bytes: &[u8]) -> bool {
    in_folder(&[("model.ply", bytes)], |folder| {
        let path = folder.join("model.ply");
        let model = model(&path);
        let points = read_points(&path);
        if let Ok(points) = &points {
            assert_eq!(points.colours.len(), points.positions.len());
        }
        model || points.is_ok()
    })
}

/// An SPZ file of any version.
fn spz(bytes: &[u8]) -> bool {
    in_folder(&[("model.spz", bytes)], |folder| model(&folder.join("model.spz")))
}

/// An SOG archive.
fn sog(bytes: &[u8]) -> bool {
    in_folder(&[("model.sog", bytes)], |folder| model(&folder.join("model.sog")))
}

/// An SOG folder: `meta.json` and its pictures.
fn sog_folder(bytes: &[u8]) -> bool {
    let names =
        ["meta.json", "means_l.webp", "means_u.webp", "quats.webp", "scales.webp", "sh0.webp"];
    let names = names.into_iter().chain(["shN_centroids.webp", "shN_labels.webp"]);
    let files: Vec<_> = names.zip(split(bytes)).collect();
    in_folder(&files, model)
}

/// A `.splat` file.
fn splat(bytes: &[u8]) -> bool {
    in_folder(&[("model.splat", bytes)], |folder| model(&folder.join("model.splat")))
}

/// A glTF file of splats, binary or text.
fn splat_glb(bytes: &[u8]) -> bool {
    in_folder(&[("model.glb", bytes)], |folder| model(&folder.join("model.glb")))
}

fn model(path: &Path) -> bool {
    read_model(path).is_ok_and(|file| {
        let model = file.gaussians;
        let coefficients = 3 * (usize::from(model.sh_degree) + 1).pow(2);
        assert_eq!(model.opacity_logits.len(), model.len());
        assert_eq!(model.sh.len(), coefficients * model.len());
        assert!(model.means.iter().flatten().all(|v| v.is_finite()));
        true
    })
}

/// A glTF text file with embedded buffers.
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

/// A checkpoint: its header, its model, and the state of the backend.
fn checkpoint(bytes: &[u8]) -> bool {
    in_folder(&[("step.safetensors", bytes)], |folder| {
        let Ok(mut found) = Checkpoint::open(&folder.join("step.safetensors")) else {
            return false;
        };
        let budget = found.header().budget;
        let Ok(model) = found.blank_model() else {
            return false;
        };
        assert!(model.len() <= budget);
        let options = Setup { threads: Some(1), ..Setup::new(model.len()) };
        let mut backend = CpuBackend::new(&model, &options).expect("a model as small as its file");
        // The file may be refused here: it may come from a backend with other state.
        let _ = found.restore(&mut backend);
        true
    })
}

/// `config.toml` of a run.
fn config(bytes: &[u8]) -> bool {
    in_folder(&[("config.toml", bytes)], |folder| {
        let config = RunConfig::read(folder);
        config.is_ok_and(|config| !config.scene_path().as_os_str().is_empty())
    })
}

fn dataset(files: &[(&str, &[u8])]) -> bool {
    let images = ["images/0.png", "images/1.png"].map(|name| (name, PHOTOGRAPH));
    let all: Vec<_> = images.into_iter().chain(files.iter().copied()).collect();
    in_folder(&all, loads)
}

fn loads(path: &Path) -> bool {
    let options = LoadOptions { tracks: true, ..LoadOptions::default() };
    let Ok(dataset) = Dataset::load(path, &options) else {
        return false;
    };
    assert!(!dataset.train.is_empty());
    dataset.train.iter().all(|view| {
        let Ok(image) = view.source.load() else { return false };
        assert_eq!((image.width, image.height), (view.camera.width, view.camera.height));
        true
    })
}

fn mesh(files: &[(&str, &[u8])]) -> bool {
    in_folder(files, |folder| {
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

/// Splits an input into its files.
fn split(bytes: &[u8]) -> impl Iterator<Item = &[u8]> {
    let mut rest = Some(bytes);
    std::iter::from_fn(move || {
        let all = rest?;
        let at = all.windows(SEPARATOR.len()).position(|window| window == SEPARATOR);
        rest = at.map(|at| &all[at + SEPARATOR.len()..]);
        Some(&all[..at.unwrap_or(all.len())])
    })
}

/// Writes files to a temporary folder and reads them there.
fn in_folder(files: &[(&str, &[u8])], read: impl FnOnce(&Path) -> bool) -> bool {
    let folder = tempfile::tempdir().expect("a folder");
    for (name, bytes) in files {
        let path = folder.path().join(name);
        if let Some(parent) = path.parent() {
            std::fs::create_dir_all(parent).expect("a folder");
        }
        std::fs::write(path, bytes).expect("a file");
    }
    read(folder.path())
}
