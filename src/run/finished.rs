//! Finished runs and bare models, opened to render or measure them.

use std::path::{Path, PathBuf};

use densify_policies::policy::Needs;
use glam::DVec3;

use crate::failure::{Failure, ModelProblem, notes};
pub use crate::models::{
    is_model, iteration, iteration_so_far, model_file, name_of, names_of, read_model,
    read_model_as, say_unstated, write_in_frame, write_model,
};
use crate::near_plane::NearPlane;
use crate::observer::{Observer, say_notes};
use crate::resolved::RunConfig;
use crate::spec::{DataSpec, DeviceSpec, Fraction};
use densify_core::antialiasing::Antialiasing;
use densify_core::camera::Camera;
use densify_core::gaussians::Gaussians;
use densify_data::dataset::normalise::Normalisation;
use densify_data::dataset::{Dataset, SeenDepths, TrackReading, View, builtin};
use densify_data::views::DatasetViews;
use densify_render::{Backend, BackendError, Device, MomentStorage, Setup, Storage};
use densify_train::evaluate::Split;
use densify_train::metrics::geometry::{self, Geometry, KnownScene};
use densify_train::output::model_path;

/// A device that renders models, and the threads that it may use.
#[derive(Debug, Default)]
pub struct Machine {
    /// Number of processor threads; `None`: all.
    threads: Option<usize>,
    device: Device,
}

impl Machine {
    /// Opens the device that the options name, or else the default one.
    pub fn open(spec: &DeviceSpec, observer: &dyn Observer) -> Result<Self, Failure> {
        let device = Device::open_to_render(spec.backend, spec.gpu.as_deref())?;
        observer.say(format_args!("{}", notes::device(observer.spelling(), &device)));
        Ok(Self { threads: spec.threads.map(|threads| threads.0 as usize), device })
    }

    /// A backend with a model in the dataset's own coordinates, to render the dataset's views. `near` is a distance
    /// `[scene units]`.
    pub fn backend(
        &self,
        dataset: &Dataset,
        model: Gaussians,
        near: f32,
    ) -> Result<Box<dyn Backend>, Failure> {
        self.backend_for(dataset, model, near, Needs::default())
    }

    /// As [`backend`](Self::backend), to measure what these needs declare.
    pub fn backend_for(
        &self,
        dataset: &Dataset,
        model: Gaussians,
        near: f32,
        needs: Needs,
    ) -> Result<Box<dyn Backend>, Failure> {
        let model = dataset.normalisation.model_from_world(model);
        let setup = self.setup(&model, near);
        let setup = Setup { largest_image: dataset.largest_image(), needs, ..setup };
        Ok(self.device.backend(&model, &setup)?)
    }

    /// A backend that can only render, with a model in scene coordinates.
    pub fn backend_in_scene(
        &self,
        model: &Gaussians,
        near: f32,
        largest_image: (u32, u32),
    ) -> Result<Box<dyn Backend>, BackendError> {
        let setup = Setup { largest_image, only_renders: true, ..self.setup(model, near) };
        self.device.backend(model, &setup)
    }

    /// A backend with a model in scene coordinates, for measuring signals with steps that do not change the model.
    pub fn backend_to_measure(
        &self,
        model: &Gaussians,
        near: f32,
        needs: Needs,
    ) -> Result<Box<dyn Backend>, BackendError> {
        // Moments are never used, so they may be small.
        let storage = Storage { moments: MomentStorage::Both8, ..Storage::default() };
        self.device.backend(model, &Setup { needs, storage, ..self.setup(model, near) })
    }

    fn setup(&self, model: &Gaussians, near: f32) -> Setup {
        Setup { near, threads: self.threads, ..Setup::new(model.len().max(1)) }
    }
}

/// A model with the dataset it belongs to, ready to render.
pub struct Opened {
    /// The dataset.
    pub dataset: Dataset,
    /// Options with which the dataset was read.
    pub data: DataSpec,
    /// True for the model of a run that was trained on given depth.
    pub trained_on_depth: bool,
    /// Spherical-harmonic degree of the model.
    pub sh_degree: u8,
    /// The backend, which contains the model.
    pub backend: Box<dyn Backend>,
}

/// Adds a remedy to a failure if there is no dataset at `path`, the path in the run's configuration.
pub fn or_moved(failure: Failure, path: &Path) -> Failure {
    if path.exists() || builtin::name(path).is_some() {
        failure
    } else {
        failure.with(ModelProblem::DatasetMoved)
    }
}

/// Opens the model of a run with its dataset, or with the dataset at `moved_to`, in a backend for `needs`.
///
/// # Errors
/// When the run, its dataset or the device cannot be opened.
pub fn open_run(
    run: &Path,
    iteration: u32,
    moved_to: Option<PathBuf>,
    (antialias, machine): (Option<Antialiasing>, Machine),
    needs: Needs,
    observer: &dyn Observer,
) -> Result<Opened, Failure> {
    let config = RunConfig::read(run)?;
    let was_moved = moved_to.is_some();
    let path = moved_to.unwrap_or_else(|| config.scene_path());
    let model = model_path(run, iteration);
    let near = |dataset: &Dataset| near_plane_of_run(&config, dataset, observer);
    let data = config.spec.data.clone();
    let opened = open_with(&model, &path, data, &near, (antialias, machine), needs, observer)
        .map_err(|failure| if was_moved { failure } else { or_moved(failure, &path) })?;
    Ok(Opened { trained_on_depth: config.resolved.depth.is_some(), ..opened })
}

/// Opens a model, written by any program, with a dataset. Without `near`, the near plane is [chosen](NearPlane) for the
/// dataset. Without `antialias`, the model is rendered as its file states.
///
/// # Errors
/// When the model, the dataset or the device cannot be opened.
pub fn open(
    model: &Path,
    dataset: &Path,
    data: DataSpec,
    (near, antialias, machine): (Option<Fraction>, Option<Antialiasing>, Machine),
    needs: Needs,
    observer: &dyn Observer,
) -> Result<Opened, Failure> {
    let near = |dataset: &Dataset| near_plane(near, dataset, observer);
    open_with(model, dataset, data, &near, (antialias, machine), needs, observer)
}

fn open_with(
    model: &Path,
    dataset: &Path,
    data: DataSpec,
    near: &dyn Fn(&Dataset) -> f32,
    (antialias, machine): (Option<Antialiasing>, Machine),
    needs: Needs,
    observer: &dyn Observer,
) -> Result<Opened, Failure> {
    let dataset = load(dataset, &data, observer)?;
    let model = read_model_as(model, antialias, observer)?;
    let sh_degree = model.sh_degree;
    let near = near(&dataset);
    let backend = machine.backend_for(&dataset, model, near, needs)?;
    Ok(Opened { sh_degree, backend, dataset, data, trained_on_depth: false })
}

/// Opens a model without a dataset, for cameras in its own coordinates. Also returns its normalisation and degree.
/// Without `near`, the near plane follows from the Gaussians of opacity above 0.5 that the cameras see; without
/// `antialias`, the model is rendered as its file states.
///
/// # Errors
/// When the model or the device cannot be opened.
pub fn open_alone(
    model: &Path,
    (near, antialias, machine): (Option<Fraction>, Option<Antialiasing>, Machine),
    cameras: &[Camera],
    observer: &dyn Observer,
) -> Result<(Box<dyn Backend>, Normalisation, u8), Failure> {
    open_loaded(read_model_as(model, antialias, observer)?, (near, machine), cameras, observer)
}

/// Opens a model in memory as [`open_alone`] opens one in a file.
///
/// # Errors
/// When the device cannot be opened.
pub fn open_loaded(
    model: Gaussians,
    (near, machine): (Option<Fraction>, Machine),
    cameras: &[Camera],
    observer: &dyn Observer,
) -> Result<(Box<dyn Backend>, Normalisation, u8), Failure> {
    let normalisation = Normalisation::fit_model(&model);
    let model = normalisation.model_from_world(model);
    let near = say_near_plane(
        NearPlane::from_depths(near, &seen_depths(&model, &normalisation, cameras)),
        observer,
    );
    let backend = machine.device.backend(&model, &machine.setup(&model, near))?;
    Ok((backend, normalisation, model.sh_degree))
}

/// The depths at which cameras in a model's own coordinates see its Gaussians of opacity above 0.5, in a normalised
/// scene.
fn seen_depths(model: &Gaussians, normalisation: &Normalisation, cameras: &[Camera]) -> SeenDepths {
    let rows = model.means.iter().zip(&model.opacity_logits);
    let opaque = rows.filter(|(_, logit)| **logit > 0.0);
    let centres: Vec<_> = opaque.map(|(mean, _)| DVec3::from(mean.map(f64::from))).collect();
    let to_scene = |camera| normalisation.scene_from_world_camera(camera);
    SeenDepths::measure(&centres, &cameras.iter().map(to_scene).collect::<Vec<_>>())
}

/// The [near plane](NearPlane) of a model in a dataset `[scene units]`; tells the user if it is unusual or hides
/// points.
pub fn near_plane(given: Option<Fraction>, dataset: &Dataset, observer: &dyn Observer) -> f32 {
    say_near_plane(NearPlane::choose(given, dataset), observer)
}

/// The near plane that a run was trained with `[scene units]`.
pub fn near_plane_of_run(config: &RunConfig, dataset: &Dataset, observer: &dyn Observer) -> f32 {
    let known = config.spec.start.near.map(NearPlane::distance_of);
    known.unwrap_or_else(|| near_plane(None, dataset, observer))
}

fn say_near_plane(near: NearPlane, observer: &dyn Observer) -> f32 {
    if let Some(line) = near.line(observer.spelling()) {
        observer.say(format_args!("{line}"));
    }
    near.distance()
}

/// Reads the dataset at `path` and passes its notes to the observer.
///
/// # Errors
/// When the dataset cannot be read.
pub fn load(path: &Path, data: &DataSpec, observer: &dyn Observer) -> Result<Dataset, Failure> {
    let dataset = Dataset::load(path, &data.load_options(TrackReading::Nothing))?;
    say_notes(observer, &dataset.notes);
    Ok(dataset)
}

impl Opened {
    /// Measures the model against the known surface in `views`; `None` if no surface is known.
    ///
    /// # Errors
    /// When the surface cannot be read or `is_stopped` returns true, and as [`geometry::measure`].
    pub fn geometry(
        &mut self,
        views: &DatasetViews,
        is_stopped: &dyn Fn() -> bool,
    ) -> Result<Option<Geometry>, Failure> {
        let Some(truth) = self.dataset.ground_truth()? else { return Ok(None) };
        let train = self.views(Split::Train)?;
        let scene = KnownScene {
            truth: &truth,
            normalisation: &self.dataset.normalisation,
            background: self.data.background.fixed(),
            sh_degree: self.sh_degree,
            is_stopped,
        };
        Ok(Some(geometry::measure(self.backend.as_mut(), &scene, &train, views)?))
    }

    /// The views of a split.
    ///
    /// # Errors
    /// When the split has none.
    pub fn views(&self, split: Split) -> Result<DatasetViews, Failure> {
        views_of(&self.dataset, split)
    }
}

/// The views of a split of a dataset.
///
/// # Errors
/// When the split has none.
pub fn views_of(dataset: &Dataset, split: Split) -> Result<DatasetViews, Failure> {
    let views: &[View] = match split {
        Split::Train => &dataset.train,
        Split::Test => &dataset.test,
    };
    if views.is_empty() {
        return Err(ModelProblem::NoTestViews.into());
    }
    Ok(DatasetViews::new(views.to_vec(), 0, 1))
}
