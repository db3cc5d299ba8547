//! Reads arbitrary bytes as a file of each format that comes from other programs. Whatever the bytes are, a reader
//! accepts or refuses them: it never panics, hangs, or allocates more than the size of the file justifies.
//!
//! The formats of models and datasets come from their registries. `cargo fuzz` runs without end (see CONTRIBUTING.md),
//! `tests/it/fuzz.rs` runs briefly in every test run. Both use the same corpora.

use std::path::Path;

use densify::data::dataset::{Dataset, LoadOptions, TrackReading, formats as dataset_formats};
use densify::data::las;
use densify::data::meshes;
use densify::data::models::{formats as model_formats, read_model};
use densify::data::points::read_points;
use densify::render::Setup;
use densify::render::cpu::CpuBackend;
use densify::run::RunConfig;
use densify::train::checkpoint::Checkpoint;
use densify_fixtures::corpus_files;
use densify_scenegen::{Options, PointOptions, Scene, Source};

/// A target of the fuzzer.
pub struct Target {
    /// Name of the target and of the folder with its corpus.
    pub name: &'static str,
    /// File name of an input that consists of one file.
    file: String,
    /// File names under which a photograph is put beside the input.
    photographs: &'static [&'static str],
    /// Returns true if the files in a folder are accepted. The second argument is the path of `file`.
    accepts: fn(&Path, &Path) -> bool,
}

/// A target outside the registries: name, file, and function.
type Other = (&'static str, &'static str, fn(&Path, &Path) -> bool);

/// All targets.
pub fn targets() -> Vec<Target> {
    let models = model_formats().into_iter().filter(|format| format.reader.is_some());
    let models = models.map(|format| Target {
        name: format.name,
        file: format!("model.{}", format.extension),
        photographs: &[],
        accepts: accepts_model,
    });
    let datasets = dataset_formats().iter().map(|format| Target {
        name: format.name,
        file: format.file.to_owned(),
        photographs: &["images/0.png", "images/1.png"],
        accepts: |folder, _| accepts_dataset(folder),
    });
    let others: [Other; 10] = [
        ("archive", "scan.zip", |_, file| accepts_dataset(file)),
        ("checkpoint", "step.safetensors", |_, file| accepts_checkpoint(file)),
        ("config", "config.toml", |folder, _| accepts_config(folder)),
        ("image", "images/0.png", |folder, _| accepts_images(folder)),
        ("las", "scan.las", |_, file| accepts_scan(file)),
        ("mesh-glb", "mesh.glb", |_, file| accepts_mesh(file)),
        ("mesh-gltf", "mesh.gltf", |_, file| accepts_mesh(file)),
        ("mesh-obj", "mesh.obj", |_, file| accepts_mesh(file)),
        ("mesh-ply", "mesh.ply", |_, file| accepts_mesh_to_measure(file)),
        ("points", "points.ply", |_, file| accepts_points(file)),
    ];
    let others = others.map(|(name, file, accepts)| Target {
        name,
        file: file.into(),
        photographs: &["texture.png"],
        accepts,
    });
    models.chain(datasets).chain(others).collect()
}

/// The photographs of datasets whose other files are fuzzed, and the texture of meshes.
const PHOTOGRAPH: &[u8] = include_bytes!("corpus/image/photograph.png");

impl Target {
    /// The target with this name.
    ///
    /// # Panics
    /// When there is none.
    #[allow(dead_code, reason = "the fuzzer uses it, the tests do not")]
    pub fn named(name: &str) -> Self {
        let target = targets().into_iter().find(|target| target.name == name);
        target.unwrap_or_else(|| panic!("no target is called {name:?}"))
    }

    /// Reads an input; returns true if it is accepted.
    pub fn accepts(&self, input: &[u8]) -> bool {
        let folder = tempfile::tempdir().expect("a folder");
        let photographs = self.photographs.iter().map(|&name| (name.to_owned(), PHOTOGRAPH));
        for (name, contents) in photographs.chain(corpus_files(input, &self.file)) {
            let path = folder.path().join(name);
            if let Some(parent) = path.parent() {
                // Damaged names may contradict each other (a file and a folder of one name); such files are left out.
                let _ =
                    std::fs::create_dir_all(parent).and_then(|()| std::fs::write(&path, contents));
            }
        }
        (self.accepts)(folder.path(), &folder.path().join(&self.file))
    }
}

/// Reads a model. If the input has no file with the target's name, the model is the folder.
fn accepts_model(folder: &Path, file: &Path) -> bool {
    let path = if file.is_file() { file } else { folder };
    read_model(path).is_ok_and(|file| {
        let model = file.gaussians;
        let coefficients = 3 * (usize::from(model.sh_degree) + 1).pow(2);
        assert_eq!(model.opacity_logits.len(), model.len());
        assert_eq!(model.sh.len(), coefficients * model.len());
        assert!(model.means.iter().flatten().all(|v| v.is_finite()));
        true
    })
}

fn accepts_points(path: &Path) -> bool {
    read_points(path).is_ok_and(|(points, _)| {
        assert_eq!(points.colours.len(), points.positions.len());
        true
    })
}

fn accepts_scan(path: &Path) -> bool {
    las::read(path).is_ok_and(|points| {
        assert_eq!(points.colours.len(), points.positions.len());
        true
    })
}

/// Reads the cameras of a folder or an archive, then the images.
fn accepts_dataset(path: &Path) -> bool {
    let options = LoadOptions { tracks: TrackReading::Directions, ..LoadOptions::default() };
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

/// Reads a dataset with the photograph in two views: its header when the dataset is loaded, its pixels afterwards.
fn accepts_images(folder: &Path) -> bool {
    let listing = br#"{"camera_angle_x": 0.8, "frames": [
        {"file_path": "images/0.png", "transform_matrix": [[1,0,0,0],[0,1,0,0],[0,0,1,4],[0,0,0,1]]},
        {"file_path": "images/1.png", "transform_matrix": [[1,0,0,1],[0,1,0,0],[0,0,1,4],[0,0,0,1]]}]}"#;
    std::fs::write(folder.join("transforms.json"), listing).expect("a file");
    let copied = std::fs::copy(folder.join("images/0.png"), folder.join("images/1.png"));
    copied.is_ok() && accepts_dataset(folder)
}

/// Reads a checkpoint: its header, its model, and the backend's arrays.
fn accepts_checkpoint(path: &Path) -> bool {
    let Ok(mut checkpoint) = Checkpoint::open(path) else {
        return false;
    };
    let budget = checkpoint.header().budget;
    let Ok(model) = checkpoint.blank_model() else {
        return false;
    };
    assert!(model.len() <= budget);
    let options = Setup { threads: Some(1), ..Setup::new(model.len()) };
    let mut backend =
        CpuBackend::new(&model, &options).expect("the model is no larger than its file");
    // The arrays may be those of another backend.
    let _ = checkpoint.restore(&mut backend);
    true
}

/// Reads `config.toml` of a run.
fn accepts_config(folder: &Path) -> bool {
    RunConfig::read(folder).is_ok_and(|config| !config.scene_path().as_os_str().is_empty())
}

fn accepts_mesh(path: &Path) -> bool {
    let options = Options {
        size: Some((8, 8)),
        train: Some(2),
        test: Some(1),
        grid: 1,
        points: PointOptions { count: 8, ..PointOptions::default() },
        ..Options::default()
    };
    let Ok(scene) = Scene::prepare(&Source::File(path.to_owned()), &options) else { return false };
    assert!(scene.render(0).depth.iter().all(|z| z.is_finite()));
    true
}

/// Reads a mesh as `densify eval` does.
fn accepts_mesh_to_measure(path: &Path) -> bool {
    meshes::is_mesh(path)
        && meshes::read(path).is_ok_and(|mesh| {
            let corners = || mesh.triangles.iter().flatten();
            assert!(corners().all(|&corner| mesh.positions[corner as usize].is_finite()));
            !mesh.triangles.is_empty()
        })
}
