//! From what was named, a run, a model or a scene, to what is looked at.

use std::path::{Path, PathBuf};

use glam::{DMat3, DVec3};

use super::kinds::Kind;
use super::stage::{Exhibition, NO_MODEL, Shown, Stage};
use densify_core::camera::Camera;
use densify_core::camera_path::Keyframe;
use densify_core::gaussians::{Gaussians, logit};
use densify_data::dataset::normalise::{EXTENT, Normalisation};
use densify_data::dataset::{Dataset, PointCloud, builtin};
use densify_run::failure::Failure;
use densify_run::finished::{
    Machine, is_model, iteration_so_far, load, name_of, names_of, or_moved, read_model,
};
use densify_run::{DataSpec, Observer, RunConfig};
use densify_train::checkpoint::checkpoint_path;
use densify_train::init::{initialise, random_points};
use densify_train::output::{CONFIG_FILE, model_path};

/// Most points of a scene that are shown as Gaussians.
const MOST_POINTS: usize = 500_000;
/// Points of a scene that brings none.
const RANDOM_POINTS: usize = 20_000;
/// Opacity and size of points, relative to how training starts: it starts as mist.
const POINT_OPACITY: f32 = 0.9;
const POINT_SIZE: f32 = 0.5;
/// Vertical field of view where no camera says one `[rad]`.
const FOV: f64 = 0.8;

/// What is named to look at.
pub struct Looked<'a> {
    /// A run, a model or a scene.
    pub what: &'a Path,
    /// Another run or model of the same scene.
    pub other: Option<&'a Path>,
    /// Where the dataset is, if what is looked at does not say.
    pub scene: Option<PathBuf>,
    /// Which saved model of a run.
    pub iteration: Option<u32>,
    /// Near plane of a file, as a fraction of the scene's extent.
    pub near: f64,
    /// How the dataset of a file, or a scene, is read.
    pub data: DataSpec,
}

/// Whether a path is the folder of a run.
pub fn is_run(path: &Path) -> bool {
    path.join(CONFIG_FILE).is_file()
}

/// Opens it.
///
/// # Errors
/// When a file cannot be read, or the device does not suffice.
pub fn open(
    looked: Looked<'_>,
    machine: Machine,
    observer: &dyn Observer,
) -> Result<Exhibition, Failure> {
    let Looked { what, other, scene, iteration, near, data } = looked;
    let named: Vec<&Path> = std::iter::once(what).chain(other).collect();
    if other.is_some()
        && let Some(path) = named.iter().find(|path| !is_model(path) && !is_run(path))
    {
        return Err(not_comparable(path));
    }
    let names = names_of(&named);
    if iteration.is_some() && !is_run(what) {
        return Err(Failure::input("--iteration is for a run's folder; leave it out"));
    }
    let mut first = None;
    let mut shown = if is_model(what) {
        let model = read_model(what, observer)?;
        let mut shown = match scene {
            Some(scene) => of_dataset(machine, what, load(&scene, &data, observer)?, &data),
            None => without_cameras(machine, what, &model, &data)?,
        };
        shown.show(names[0].clone(), model, near)?;
        shown
    } else if is_run(what) {
        let (model, config, iteration) = of_run(what, iteration, observer)?;
        let has_moved = scene.is_some();
        let path = scene.unwrap_or_else(|| config.scene_path());
        let dataset = load(&path, &config.spec.data, observer)
            .map_err(|failure| if has_moved { failure } else { or_moved(failure, &path) })?;
        let mut shown = of_dataset(machine, what, dataset, &config.spec.data);
        let called = format!("{}, iteration {iteration}", names[0]);
        shown.show_of_run(called, model, (what, iteration, &config))?;
        first = Some(config);
        shown
    } else {
        if scene.is_some() {
            return Err(no_run(what).and("--scene is for a run or a model"));
        }
        let dataset = load(what, &data, observer).map_err(|failure| match builtin::name(what) {
            Some(_) => failure,
            None => no_run(what).and(&failure.to_string()),
        })?;
        return of_points(machine, what, dataset, &data, near);
    };
    if let Some(other) = other {
        let called = names[1].clone();
        if is_model(other) {
            shown.show(called, read_model(other, observer)?, near)?;
        } else {
            let (model, config, iteration) = of_run(other, None, observer)?;
            let called = format!("{called}, iteration {iteration}");
            shown.show_of_run(called, model, (other, iteration, &config))?;
            if let Some(note) = first.and_then(|first| apart(&first, &config)) {
                observer.say(format_args!("note: {}: {note}", other.display()));
            }
        }
    }
    Ok(shown)
}

fn no_run(path: &Path) -> Failure {
    let path = path.display();
    Failure::input(format!(
        "{path} is neither a run (it holds no {CONFIG_FILE}) nor a file of Gaussian splats nor a scene; name the \
         folder that `densify train` wrote, a model, or a dataset"
    ))
}

fn not_comparable(path: &Path) -> Failure {
    let what = match builtin::name(path) {
        Some(_) => "is a scene".to_owned(),
        None => {
            format!("is neither a run (it holds no {CONFIG_FILE}) nor a file of Gaussian splats")
        }
    };
    Failure::input(format!(
        "{} {what}; two runs or models are compared, not a scene and a run: leave one of them out",
        path.display()
    ))
}

/// What the datasets of two runs differ in, that they are shown of the first's.
fn apart(first: &RunConfig, other: &RunConfig) -> Option<&'static str> {
    let [a, b] = [first, other].map(|config| (config.scene_path(), &config.spec.data));
    if a.0 != b.0 {
        return Some("it was trained on another scene, whose coordinates may be others");
    }
    let splits = [a.1, b.1].map(|data| (data.eval, data.test_every));
    (splits[0] != splits[1])
        .then_some("it was trained on other views; what is held out here it may have seen")
}

/// A model that a run has saved, while it trains too.
fn of_run(
    run: &Path,
    asked: Option<u32>,
    observer: &dyn Observer,
) -> Result<(Gaussians, RunConfig, u32), Failure> {
    let config = RunConfig::read(run)?;
    let (iteration, _) = iteration_so_far(run, asked, observer)?;
    let model = read_model(&model_path(run, iteration), observer)?;
    Ok((model, config, iteration))
}

fn of_dataset(machine: Machine, what: &Path, dataset: Dataset, data: &DataSpec) -> Exhibition {
    let Dataset { train, test, points, normalisation, .. } = dataset;
    let views = [test, train];
    let background = data.background.fixed();
    let stage = Stage::new(machine, name_of(what), normalisation, background, views, points);
    Exhibition { stage, backends: Vec::new() }
}

/// A model alone: the middle of its rows is the middle of what is looked at.
fn without_cameras(
    machine: Machine,
    what: &Path,
    model: &Gaussians,
    data: &DataSpec,
) -> Result<Exhibition, Failure> {
    if model.is_empty() {
        let what = what.display();
        return Err(Failure::input(format!(
            "{what} holds no Gaussian: there is nothing to look at"
        )));
    }
    let normalisation = Normalisation::fit_model(model);
    let none = || [Vec::new(), Vec::new()];
    let points = PointCloud::default();
    let background = data.background.fixed();
    let mut stage = Stage::new(machine, name_of(what), normalisation, background, none(), points);
    // A little from above, y pointing down as structure from motion has it.
    let turn = DMat3::from_rotation_x(-0.25);
    let centre = turn * DVec3::new(0.0, 0.0, -2.5);
    let key = Keyframe::looking_at(centre, DVec3::ZERO, DVec3::NEG_Y, FOV);
    let camera: Camera = key.camera((1024, 768));
    stage.start = Some(camera);
    Ok(Exhibition { stage, backends: Vec::new() })
}

/// A scene that has not been trained: its points.
fn of_points(
    machine: Machine,
    what: &Path,
    dataset: Dataset,
    data: &DataSpec,
    near: f64,
) -> Result<Exhibition, Failure> {
    let cameras = || dataset.train.iter().map(|view| view.camera).collect::<Vec<Camera>>();
    let is_random = dataset.points.is_empty();
    let drawn = if is_random {
        random_points(RANDOM_POINTS, &cameras(), false, 0)
    } else {
        PointCloud::default()
    };
    let points = if is_random { &drawn } else { &dataset.points };
    let (mut model, _) = initialise(points, MOST_POINTS, 0, 0)?;
    model.opacity_logits.fill(logit(POINT_OPACITY));
    model.log_scales.as_flattened_mut().iter_mut().for_each(|scale| *scale += POINT_SIZE.ln());
    let called = match is_random {
        true => format!("{}: random points, as it has none of its own", name_of(what)),
        false => format!("{}: its points", name_of(what)),
    };
    let mut shown = of_dataset(machine, what, dataset, data);
    let of_models = [Kind::RowGradient, Kind::RowWeight, Kind::RowAge, Kind::RowEdit];
    shown.show_in_scene(called, &model, near, None)?;
    shown.stage.lacks(&of_models, NO_MODEL);
    Ok(shown)
}

/// A dataset in a folder, to test with.
#[cfg(test)]
pub(super) fn stage_of(folder: &Path) -> Stage {
    let looked = Looked {
        what: folder,
        other: None,
        scene: None,
        iteration: None,
        near: 0.04,
        data: DataSpec::default(),
    };
    open(looked, Machine::default(), &densify_run::Silent).expect("a scene").stage
}

/// That of one black photograph, and the folder that it is in.
#[cfg(test)]
pub(super) fn stage_of_one_view() -> (tempfile::TempDir, Stage) {
    let folder = tempfile::tempdir().expect("a folder");
    let frame = r#"{"w":8,"h":8,"fl_x":8,"fl_y":8,"frames":[{"file_path":"a.png",
        "transform_matrix":[[1,0,0,0],[0,1,0,0],[0,0,1,1],[0,0,0,1]]}]}"#;
    std::fs::write(folder.path().join("transforms.json"), frame).expect("a file");
    image::RgbImage::new(8, 8).save(folder.path().join("a.png")).expect("a PNG");
    let stage = stage_of(folder.path());
    (folder, stage)
}

impl Exhibition {
    /// Shows a model that is in the dataset's own coordinates.
    fn show(&mut self, name: String, model: Gaussians, near: f64) -> Result<(), Failure> {
        self.show_model(name, model, near, None)
    }

    fn show_model(
        &mut self,
        name: String,
        model: Gaussians,
        near: f64,
        checkpoint: Option<PathBuf>,
    ) -> Result<(), Failure> {
        let model = self.stage.normalisation.model_from_world(model);
        self.show_in_scene(name, &model, near, checkpoint)
    }

    /// The same of a run.
    fn show_of_run(
        &mut self,
        name: String,
        model: Gaussians,
        (run, iteration, config): (&Path, u32, &RunConfig),
    ) -> Result<(), Failure> {
        let checkpoint = Some(checkpoint_path(run, iteration)).filter(|path| path.is_file());
        self.show_model(name, model, config.spec.start.near.0, checkpoint)
    }

    /// The same in scene coordinates. The near plane is a fraction of the scene's extent.
    fn show_in_scene(
        &mut self,
        name: String,
        model: &Gaussians,
        near: f64,
        checkpoint: Option<PathBuf>,
    ) -> Result<(), Failure> {
        let (sh_degree, near) = (model.sh_degree, (near * EXTENT) as f32);
        let backend = self.stage.machine.backend_in_scene(model, near, (1, 1))?;
        self.add(Shown { name, rows: model.len(), sh_degree, near, checkpoint }, backend);
        Ok(())
    }
}
