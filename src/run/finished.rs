//! A finished run or a bare PLY, opened for looking at it.

use std::path::{Path, PathBuf};

use densify_policies::policy::Needs;

use super::{DataSpec, DeviceSpec, Observer, RunConfig, use_threads};
use crate::failure::Failure;
use densify_core::files;
use densify_core::gaussians::Gaussians;
use densify_data::dataset::normalise::{EXTENT, Normalisation};
use densify_data::dataset::{Dataset, View, builtin, is_archive};
use densify_data::import;
use densify_data::views::DatasetViews;
use densify_render::{Backend, Device, Setup};
use densify_render::{BackendError, MomentStorage, Storage};
use densify_train::checkpoint::newest_step;
use densify_train::evaluate::Split;
use densify_train::metrics::geometry::{self, Geometry, KnownScene};
use densify_train::output::is_in_use;
use densify_train::output::{model_path, saved_iterations};

/// What a model is rendered on.
#[derive(Debug, Default)]
pub struct Machine {
    /// Processor threads; all without a number.
    threads: Option<usize>,
    device: Device,
}

impl Machine {
    /// Opens what the options say.
    pub fn open(spec: &DeviceSpec, observer: &dyn Observer) -> Result<Self, Failure> {
        let device = Device::open_to_render(spec.backend, spec.gpu.as_deref())?;
        observer.say(format_args!("device   {}", device.describe()));
        use_threads(spec.threads);
        Ok(Self { threads: spec.threads.map(|threads| threads.0 as usize), device })
    }

    /// A backend with a model in the dataset's own coordinates, to render its views. `near` is a distance
    /// `[scene units]`.
    pub fn backend(
        &self,
        dataset: &Dataset,
        model: Gaussians,
        near: f32,
    ) -> Result<Box<dyn Backend>, Failure> {
        self.backend_for(dataset, model, near, Needs::default())
    }

    fn backend_for(
        &self,
        dataset: &Dataset,
        model: Gaussians,
        near: f32,
        needs: Needs,
    ) -> Result<Box<dyn Backend>, Failure> {
        let model = dataset.normalisation.model_from_world(model);
        let options = Setup {
            near,
            threads: self.threads,
            largest_image: dataset.largest_image(),
            needs,
            ..Setup::new(model.len().max(1))
        };
        Ok(self.device.backend(&model, &options)?)
    }

    /// A backend with a model in scene coordinates, only to render it.
    pub fn backend_in_scene(
        &self,
        model: &Gaussians,
        near: f32,
        largest_image: (u32, u32),
    ) -> Result<Box<dyn Backend>, BackendError> {
        let setup = Setup { largest_image, only_renders: true, ..self.setup_in_scene(model, near) };
        self.device.backend(model, &setup)
    }

    /// The same, to measure signals by steps that change nothing.
    pub fn backend_to_measure(
        &self,
        model: &Gaussians,
        near: f32,
        needs: Needs,
    ) -> Result<Box<dyn Backend>, BackendError> {
        // Moments that change nothing may be small.
        let storage = Storage { moments: MomentStorage::Both8, ..Storage::default() };
        self.device.backend(model, &Setup { needs, storage, ..self.setup_in_scene(model, near) })
    }

    fn setup_in_scene(&self, model: &Gaussians, near: f32) -> Setup {
        Setup { near, threads: self.threads, ..Setup::new(model.len().max(1)) }
    }
}

/// A model with the dataset it belongs to, ready to render.
pub struct Opened {
    pub dataset: Dataset,
    pub data: DataSpec,
    pub sh_degree: u8,
    pub backend: Box<dyn Backend>,
}

/// Whether a path is a model by itself: a file that is no archive of a dataset, or a folder of SOG.
pub fn is_model(path: &Path) -> bool {
    (path.is_file() && !is_archive(path)) || path.join("meta.json").is_file()
}

/// The iteration asked for, or the last one saved.
pub fn iteration(run: &Path, asked: Option<u32>) -> Result<u32, Failure> {
    let saved = saved_iterations(run).map_err(|error| match newest_step(run) {
        None => error.into(),
        Some(step) => {
            let run = run.display();
            Failure::input(format!(
                "{run} holds a run that was stopped before it saved a model, with a checkpoint of iteration {step}; \
                 `densify train --resume -o {run}` goes on from there, and saves its model at the end, or earlier \
                 with --save-iterations N"
            ))
        }
    })?;
    let last = saved[saved.len() - 1];
    match asked {
        None => Ok(last),
        Some(n) if saved.contains(&n) => Ok(n),
        Some(n) => {
            let list: Vec<String> = saved.iter().map(u32::to_string).collect();
            Err(Failure::input(format!(
                "--iteration {n}: {} has saved only {}",
                run.display(),
                list.join(", ")
            )))
        }
    }
}

/// The iteration asked for, or the last one saved, of a run that may be training: then says so. Also whether it
/// is.
pub fn iteration_so_far(
    run: &Path,
    asked: Option<u32>,
    observer: &dyn Observer,
) -> Result<(u32, bool), Failure> {
    let trains = is_in_use(run);
    if trains && saved_iterations(run).is_err() {
        let run = run.display();
        return Err(Failure::input(format!(
            "{run} is being trained and has saved no model yet; wait until it has, or train with \
             --save-iterations 1000,2000 to look at it before its end"
        )));
    }
    let iteration = iteration(run, asked)?;
    if trains {
        let run = run.display();
        observer.say(format_args!(
            "note: {run} is being trained; what is shown is its model of iteration {iteration}"
        ));
    }
    Ok((iteration, trains))
}

/// The last part of a path: what lies above is nobody's business.
pub fn name_of(path: &Path) -> String {
    names_of(&[path]).swap_remove(0)
}

/// The same of paths that are shown together, each with as much of what lies above as tells it from the others.
pub fn names_of(paths: &[&Path]) -> Vec<String> {
    let whole = |path: &&Path| path.canonicalize().unwrap_or_else(|_| path.to_path_buf());
    let whole: Vec<PathBuf> = paths.iter().map(whole).collect();
    let last = |path: &Path, parts: usize| -> PathBuf {
        let all: Vec<_> = path.components().collect();
        all[all.len().saturating_sub(parts)..].iter().collect()
    };
    let name = |path: &PathBuf| {
        let tells_apart = |parts: &usize| {
            let mut others = whole.iter().filter(|other| *other != path);
            others.all(|other| last(other, *parts) != last(path, *parts))
        };
        let most = path.components().count();
        let parts = (1..most).find(tells_apart).unwrap_or(most);
        files::one_line(&last(path, parts).to_string_lossy())
    };
    whole.iter().map(name).collect()
}

/// The file of what is named: a model, or a run's of the iteration asked for, or its last.
pub fn model_file(named: &Path, asked: Option<u32>) -> Result<PathBuf, Failure> {
    match is_model(named) {
        true if asked.is_some() => {
            Err(Failure::input("--iteration is for a run's folder; a file has only one model"))
        }
        true => Ok(named.to_owned()),
        false => Ok(model_path(named, iteration(named, asked)?)),
    }
}

/// Says what to do where the dataset of a run is no longer at `path`, which the user has not named.
pub fn or_moved(failure: Failure, path: &Path) -> Failure {
    match path.exists() || builtin::name(path).is_some() {
        true => failure,
        false => failure.and("if the dataset has moved, say where it is with --scene"),
    }
}

/// Opens the model of a run with its dataset, or with that dataset at `moved_to`, in a backend for
/// `needs`.
pub fn open_run(
    run: &Path,
    iteration: u32,
    moved_to: Option<PathBuf>,
    machine: Machine,
    needs: Needs,
    observer: &dyn Observer,
) -> Result<Opened, Failure> {
    let config = RunConfig::read(run)?;
    let was_moved = moved_to.is_some();
    let path = moved_to.unwrap_or_else(|| config.scene_path());
    let model = model_path(run, iteration);
    let near = config.spec.start.near.0;
    open(&model, &path, config.spec.data, (near, machine), needs, observer)
        .map_err(|failure| if was_moved { failure } else { or_moved(failure, &path) })
}

/// Opens a model, by whatever program, with a dataset. The near plane is a fraction of the extent.
pub fn open(
    model: &Path,
    dataset: &Path,
    data: DataSpec,
    (near, machine): (f64, Machine),
    needs: Needs,
    observer: &dyn Observer,
) -> Result<Opened, Failure> {
    let dataset = load(dataset, &data, observer)?;
    let model = read_model(model, observer)?;
    let sh_degree = model.sh_degree;
    let near = (near * dataset.extent()) as f32;
    let backend = machine.backend_for(&dataset, model, near, needs)?;
    Ok(Opened { sh_degree, backend, dataset, data })
}

/// Opens a model alone, for cameras that are in its own coordinates; also where it is, and its degree. The near plane
/// is a fraction of its extent.
pub fn open_alone(
    model: &Path,
    (near, machine): (f64, Machine),
    observer: &dyn Observer,
) -> Result<(Box<dyn Backend>, Normalisation, u8), Failure> {
    let model = read_model(model, observer)?;
    let normalisation = Normalisation::fit_model(&model);
    let model = normalisation.model_from_world(model);
    let near = (near * EXTENT) as f32;
    let backend = machine.device.backend(&model, &machine.setup_in_scene(&model, near))?;
    Ok((backend, normalisation, model.sh_degree))
}

/// Reads the dataset at `path`; says what there is to say.
pub fn load(path: &Path, data: &DataSpec, observer: &dyn Observer) -> Result<Dataset, Failure> {
    let dataset = Dataset::load(path, &data.load_options(false))?;
    for note in &dataset.notes {
        observer.say(format_args!("note: {note}"));
    }
    Ok(dataset)
}

/// Reads a file of Gaussian splats by any program, in its own coordinates; says what was wrong with it.
pub fn read_model(path: &Path, observer: &dyn Observer) -> Result<Gaussians, Failure> {
    let file = import::read_model(path)?;
    for (number, what) in [
        (file.dropped, "left out: a value is not finite"),
        (file.repaired, "with a zero quaternion, read as unrotated"),
    ] {
        if number > 0 {
            observer.say(format_args!("note: {}: {number} rows {what}", path.display()));
        }
    }
    Ok(file.gaussians)
}

impl Opened {
    /// Measures how the model sits on the known surface, as `views` show it; `None` where nothing is
    /// known of it.
    ///
    /// # Errors
    /// When the surface cannot be read, or as [`geometry::measure`], such as when `is_stopped`.
    pub fn geometry(
        &mut self,
        views: &DatasetViews,
        is_stopped: &dyn Fn() -> bool,
    ) -> Result<Option<Geometry>, Failure> {
        let Some(truth) = self.dataset.ground_truth()? else { return Ok(None) };
        let train = self.views(Split::Train)?;
        let ground = KnownScene {
            truth: &truth,
            normalisation: &self.dataset.normalisation,
            background: self.data.background.fixed(),
            sh_degree: self.sh_degree,
            is_stopped,
        };
        Ok(Some(geometry::measure(self.backend.as_mut(), &ground, &train, views)?))
    }

    /// The views of a split.
    pub fn views(&self, split: Split) -> Result<DatasetViews, Failure> {
        views_of(&self.dataset, split)
    }
}

/// The views of a split of a dataset.
pub fn views_of(dataset: &Dataset, split: Split) -> Result<DatasetViews, Failure> {
    let views: &[View] = match split {
        Split::Train => &dataset.train,
        Split::Test => &dataset.test,
    };
    if views.is_empty() {
        return Err(Failure::input(
            "no view was held out (a run holds views out with --eval or --test-every K); \
             use --split train",
        ));
    }
    Ok(DatasetViews::new(views.to_vec(), 0, 1))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn paths_are_called_by_as_little_as_tells_them_apart() {
        let of = |paths: &[&str]| names_of(&paths.iter().map(Path::new).collect::<Vec<_>>());
        assert_eq!(of(&["/home/me/out/a", "/home/me/out/b"]), ["a", "b"]);
        assert_eq!(of(&["/x/one/run", "/x/two/run", "/x/b"]), ["one/run", "two/run", "b"]);
        assert_eq!(of(&["/x/one/run", "/y/one/run"]), ["x/one/run", "y/one/run"]);
        assert_eq!(of(&["/run", "/x/run"]), ["/run", "x/run"]);
        // One that is named twice is the same.
        assert_eq!(of(&["/x/run", "/x/run"]), ["run", "run"]);
        assert_eq!(of(&["/x/a\u{1b}[1m"]), ["a\\u{1b}[1m"]);
    }
}
