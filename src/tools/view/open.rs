//! Opens a run, a model file or a dataset as the scene to show.

use std::path::{Path, PathBuf};

use glam::{DMat3, DVec3};

use super::picture_kind::PictureKind::{RowAge, RowEdit, RowGradient, RowInFront, RowWeight};
use super::scene::{LoadedScene, ModelInfo, NO_MODEL, Scene};
use densify_core::antialiasing::Antialiasing;
use densify_core::camera_path::Keyframe;
use densify_core::gaussians::{Gaussians, logit};
use densify_data::dataset::normalise::Normalisation;
use densify_data::dataset::{Dataset, PointCloud, SeenDepths, builtin};
use densify_run::failure::Failure;
use densify_run::finished::{
    Machine, is_model, iteration_so_far, load, name_of, names_of, near_plane, near_plane_of_run,
    or_moved, read_model_as,
};
use densify_run::{DataSpec, Fraction, NearPlane, Observer, RunConfig};
use densify_train::checkpoint::checkpoint_path;
use densify_train::init::{initialise, random_points};
use densify_train::output::{CONFIG_FILE, model_path};

/// Maximum number of points of a dataset that are shown as Gaussians.
const MAX_POINTS: usize = 500_000;
/// Number of random points for a dataset without points.
const RANDOM_POINTS: usize = 20_000;
/// Opacity of points; at the opacity at which training starts they would be hard to see.
const POINT_OPACITY: f32 = 0.9;
/// Scale of points, relative to the scale at which training starts.
const POINT_SCALE: f32 = 0.5;
/// Vertical field of view of a scene without cameras `[rad]`.
const FOV: f64 = 0.8;

/// The scene to open.
pub struct ViewOptions<'a> {
    /// A run, a model file or a dataset.
    pub path: &'a Path,
    /// Another run or model of the same scene, to compare with.
    pub other: Option<&'a Path>,
    /// The dataset of a model file, or of a run whose dataset has moved.
    pub dataset: Option<PathBuf>,
    /// Iteration of the run's saved model; by default the last one.
    pub iteration: Option<u32>,
    /// Near plane for a model file or a dataset, as a fraction of the scene's extent; `None`: the usual near plane of
    /// the dataset.
    pub near: Option<Fraction>,
    /// Antialiasing of all models; `None`: as their files state.
    pub antialias: Option<Antialiasing>,
    /// Options for reading the dataset; a run has its own.
    pub data: DataSpec,
}

/// True if the path is the folder of a run.
pub fn is_run(path: &Path) -> bool {
    path.join(CONFIG_FILE).is_file()
}

/// Reads the models and the dataset, and prepares a backend for each model.
///
/// # Errors
/// If a file cannot be read or the device cannot hold a model.
pub fn open(
    options: ViewOptions<'_>,
    machine: Machine,
    observer: &dyn Observer,
) -> Result<LoadedScene, Failure> {
    let ViewOptions { path, other, dataset, iteration, near: given, antialias, data } = options;
    let paths: Vec<&Path> = std::iter::once(path).chain(other).collect();
    if other.is_some()
        && let Some(path) = paths.iter().find(|path| !is_model(path) && !is_run(path))
    {
        return Err(not_comparable(path));
    }
    let names = names_of(&paths);
    if iteration.is_some() && !is_run(path) {
        return Err(Failure::input("--iteration is for a run's folder; leave it out"));
    }
    let mut first_config = None;
    // The near plane of models that do not state their own.
    let near;
    let mut loaded = if is_model(path) {
        let model = read_model_as(path, antialias, observer)?;
        let mut loaded;
        (loaded, near) = match dataset {
            Some(dataset) => {
                let dataset = load(&dataset, &data, observer)?;
                let near = near_plane(given, &dataset, observer);
                (scene_of_dataset(machine, path, dataset, &data), near)
            }
            None => {
                let near = NearPlane::from_depths(given, &SeenDepths::default()).distance();
                (scene_without_cameras(machine, path, &model, &data)?, near)
            }
        };
        loaded.add_model(names[0].clone(), model, near, None)?;
        loaded
    } else if is_run(path) {
        let (model, config, iteration) = read_run(path, iteration, antialias, observer)?;
        let is_given = dataset.is_some();
        let folder = dataset.unwrap_or_else(|| config.scene_path());
        let dataset = load(&folder, &config.spec.data, observer)
            .map_err(|failure| if is_given { failure } else { or_moved(failure, &folder) })?;
        near = near_plane_of_run(&config, &dataset, observer);
        let mut loaded = scene_of_dataset(machine, path, dataset, &config.spec.data);
        let name = format!("{}, iteration {iteration}", names[0]);
        loaded.add_model_of_run(name, model, (path, iteration, &config), near)?;
        first_config = Some(config);
        loaded
    } else {
        if dataset.is_some() {
            return Err(not_viewable(path).and("--scene is for a run or a model"));
        }
        if antialias.is_some() {
            return Err(not_viewable(path).and("--antialias is for a run or a model"));
        }
        let dataset = load(path, &data, observer).map_err(|failure| match builtin::name(path) {
            Some(_) => failure,
            None => not_viewable(path).and(&failure.to_string()),
        })?;
        let near = near_plane(given, &dataset, observer);
        return scene_of_points(machine, path, dataset, &data, near);
    };
    if let Some(other) = other {
        let name = names[1].clone();
        if is_model(other) {
            loaded.add_model(name, read_model_as(other, antialias, observer)?, near, None)?;
        } else {
            let (model, config, iteration) = read_run(other, None, antialias, observer)?;
            let name = format!("{name}, iteration {iteration}");
            loaded.add_model_of_run(name, model, (other, iteration, &config), near)?;
            if let Some(note) = first_config.and_then(|first| data_difference(&first, &config)) {
                observer.say(format_args!("note: {}: {note}", other.display()));
            }
        }
    }
    Ok(loaded)
}

fn not_viewable(path: &Path) -> Failure {
    let path = path.display();
    Failure::input(format!(
        "{path} is neither a run (it holds no {CONFIG_FILE}) nor a file of Gaussian splats nor a scene; name the \
         folder that `densify train` wrote, a model, or a dataset"
    ))
}

fn not_comparable(path: &Path) -> Failure {
    let problem = match builtin::name(path) {
        Some(_) => "is a scene".to_owned(),
        None => {
            format!("is neither a run (it holds no {CONFIG_FILE}) nor a file of Gaussian splats")
        }
    };
    Failure::input(format!(
        "{} {problem}; only two runs or models can be compared: leave one of them out",
        path.display()
    ))
}

/// A warning if the second run was trained on other data than the first, in whose scene both are shown.
fn data_difference(first: &RunConfig, other: &RunConfig) -> Option<&'static str> {
    let [a, b] = [first, other].map(|config| (config.scene_path(), &config.spec.data));
    if a.0 != b.0 {
        return Some("it was trained on another scene, whose coordinates may differ");
    }
    let splits = [a.1, b.1].map(|data| (data.eval, data.test_every));
    (splits[0] != splits[1])
        .then_some("it was trained on other views, possibly on those held out here")
}

/// Reads a saved model of a run, which may still be training.
fn read_run(
    run: &Path,
    iteration: Option<u32>,
    antialias: Option<Antialiasing>,
    observer: &dyn Observer,
) -> Result<(Gaussians, RunConfig, u32), Failure> {
    let config = RunConfig::read(run)?;
    let (iteration, _) = iteration_so_far(run, iteration, observer)?;
    let model = read_model_as(&model_path(run, iteration), antialias, observer)?;
    Ok((model, config, iteration))
}

fn scene_of_dataset(
    machine: Machine,
    path: &Path,
    dataset: Dataset,
    data: &DataSpec,
) -> LoadedScene {
    let Dataset { train, test, points, normalisation, .. } = dataset;
    let views = [test, train];
    let background = data.background.fixed();
    let scene = Scene::new(machine, name_of(path), normalisation, background, views, points);
    LoadedScene { scene, backends: Vec::new() }
}

/// The scene of a model file alone, centred on its Gaussians.
fn scene_without_cameras(
    machine: Machine,
    path: &Path,
    model: &Gaussians,
    data: &DataSpec,
) -> Result<LoadedScene, Failure> {
    if model.is_empty() {
        let problem = format!("{} contains no Gaussians: there is nothing to show", path.display());
        return Err(Failure::input(problem));
    }
    let normalisation = Normalisation::fit_model(model);
    let views = [Vec::new(), Vec::new()];
    let points = PointCloud::default();
    let background = data.background.fixed();
    let mut scene = Scene::new(machine, name_of(path), normalisation, background, views, points);
    // The camera looks slightly from above; y points down, as in structure from motion.
    let turn = DMat3::from_rotation_x(-0.25);
    let centre = turn * DVec3::new(0.0, 0.0, -2.5);
    let key = Keyframe::looking_at(centre, DVec3::ZERO, DVec3::NEG_Y, FOV);
    scene.start = Some(key.camera((1024, 768)));
    Ok(LoadedScene { scene, backends: Vec::new() })
}

/// The scene of a dataset without a model: its points, shown as Gaussians.
fn scene_of_points(
    machine: Machine,
    path: &Path,
    dataset: Dataset,
    data: &DataSpec,
    near: f32,
) -> Result<LoadedScene, Failure> {
    let cameras = || dataset.train.iter().map(|view| view.camera).collect::<Vec<_>>();
    let is_random = dataset.points.is_empty();
    let random = is_random.then(|| random_points(RANDOM_POINTS, &cameras(), false, 0));
    let points = random.as_ref().unwrap_or(&dataset.points);
    let (mut model, _) = initialise(points, MAX_POINTS, 0, 0)?;
    model.opacity_logits.fill(logit(POINT_OPACITY));
    model.log_scales.as_flattened_mut().iter_mut().for_each(|scale| *scale += POINT_SCALE.ln());
    let kind = if is_random { "random points, as it has none of its own" } else { "its points" };
    let name = format!("{}: {kind}", name_of(path));
    let mut loaded = scene_of_dataset(machine, path, dataset, data);
    loaded.add_model_in_scene(name, &model, near, None)?;
    loaded.scene.mark_unavailable(&[RowGradient, RowWeight, RowInFront, RowAge, RowEdit], NO_MODEL);
    Ok(loaded)
}

/// The scene of a dataset in a folder, for tests.
#[cfg(test)]
pub(super) fn scene_of(folder: &Path) -> Scene {
    let options = ViewOptions {
        path: folder,
        other: None,
        dataset: None,
        iteration: None,
        near: None,
        antialias: None,
        data: DataSpec::default(),
    };
    open(options, Machine::default(), &densify_run::Silent).expect("a scene").scene
}

/// The scene of one black photograph, and its folder, for tests.
#[cfg(test)]
pub(super) fn scene_of_one_view() -> (tempfile::TempDir, Scene) {
    let folder = tempfile::tempdir().expect("a folder");
    let frame = r#"{"w":8,"h":8,"fl_x":8,"fl_y":8,"frames":[{"file_path":"a.png",
        "transform_matrix":[[1,0,0,0],[0,1,0,0],[0,0,1,1],[0,0,0,1]]}]}"#;
    std::fs::write(folder.path().join("transforms.json"), frame).expect("a file");
    image::RgbImage::new(8, 8).save(folder.path().join("a.png")).expect("a PNG");
    let scene = scene_of(folder.path());
    (folder, scene)
}

impl LoadedScene {
    /// Adds a model in the dataset's own coordinates, with its near plane `[scene units]`.
    fn add_model(
        &mut self,
        name: String,
        model: Gaussians,
        near: f32,
        checkpoint: Option<PathBuf>,
    ) -> Result<(), Failure> {
        let model = self.scene.normalisation.model_from_world(model);
        self.add_model_in_scene(name, &model, near, checkpoint)
    }

    /// Adds the model of a run, whose description states the near plane unless the file was edited by hand.
    fn add_model_of_run(
        &mut self,
        name: String,
        model: Gaussians,
        (run, iteration, config): (&Path, u32, &RunConfig),
        near: f32,
    ) -> Result<(), Failure> {
        let checkpoint = Some(checkpoint_path(run, iteration)).filter(|path| path.is_file());
        let own = config.spec.start.near;
        let near = own.map_or(near, NearPlane::distance_of);
        self.add_model(name, model, near, checkpoint)
    }

    /// Adds a model in scene coordinates, with its near plane `[scene units]`.
    fn add_model_in_scene(
        &mut self,
        name: String,
        model: &Gaussians,
        near: f32,
        checkpoint: Option<PathBuf>,
    ) -> Result<(), Failure> {
        let sh_degree = model.sh_degree;
        let backend = self.scene.machine.backend_in_scene(model, near, (1, 1))?;
        self.add(ModelInfo { name, rows: model.len(), sh_degree, near, checkpoint }, backend);
        Ok(())
    }
}
