//! A finished run, or a model with its dataset, opened to render and measure it.

use std::ops::ControlFlow;
use std::path::PathBuf;
use std::sync::{Mutex, MutexGuard, TryLockError};

use densify_data::views::{DatasetViews, ViewSource};
use densify_run::RunConfig;
use densify_run::coordinate_check::CoordinateCheck;
use densify_run::failure::Failure;
use densify_run::finished::{
    Machine, Opened, is_model, iteration as saved_iteration, model_file, open, open_run,
};
use densify_train::evaluate::{Comparison, Mean, Split, evaluate};
use densify_train::metrics::Lpips;
use densify_train::metrics::geometry;
use densify_train::output::{write_geometry, write_scores};
use pyo3::prelude::*;

use crate::camera::{CameraParts, arrays, parts, photograph};
use crate::errors::{detached, in_use};
use crate::follow::{Listener, Stop};
use crate::{model, options};

/// A model with its dataset.
#[pyclass(module = "densify._densify", frozen)]
pub(crate) struct OpenedModel {
    opened: Mutex<Opened>,
    path: PathBuf,
    /// The configuration and the iteration of a run; `None` for a file.
    run: Option<(RunConfig, u32)>,
    /// True if measurements are written to the run's folder.
    writes: bool,
}

/// Opens the model of a run with its dataset, or a file with the dataset of the option `scene`.
#[pyfunction]
#[pyo3(signature = (path, options, *, iteration, antialias, listener))]
pub(crate) fn open_model(
    py: Python<'_>,
    path: PathBuf,
    options: &str,
    iteration: Option<u32>,
    antialias: Option<&str>,
    listener: &Bound<'_, PyAny>,
) -> PyResult<OpenedModel> {
    let antialias = antialias.map(|name| model::antialiasing(Some(name))).transpose()?;
    Listener::new(Some(listener), None)?.follow(py, move |follower| {
        let mut given = options::for_model(options, !is_model(&path), &[])?;
        let machine = Machine::open(&given.device, follower)?;
        if !is_model(&path) {
            let config = RunConfig::read(&path)?;
            let iteration = saved_iteration(&path, iteration)?;
            let how = (antialias, machine);
            let opened =
                open_run(&path, iteration, given.start.scene, how, geometry::needs(), follower)?;
            let run = Some((config, iteration));
            return Ok(OpenedModel {
                opened: Mutex::new(opened),
                path,
                run,
                writes: antialias.is_none(),
            });
        }
        let scene = given.start.scene.ok_or_else(|| {
            Failure::input(format!(
                "{} is a file, which has no cameras; name a dataset with scene=",
                path.display()
            ))
        })?;
        given.data.eval |= given.data.test_every.is_none();
        let file = model_file(&path, iteration)?;
        let how = (given.start.near, antialias, machine);
        let opened = open(&file, &scene, given.data, how, geometry::needs(), follower)?;
        Ok(OpenedModel { opened: Mutex::new(opened), path, run: None, writes: false })
    })
}

impl OpenedModel {
    fn lock(&self) -> PyResult<MutexGuard<'_, Opened>> {
        match self.opened.try_lock() {
            Ok(guard) => Ok(guard),
            Err(TryLockError::Poisoned(poisoned)) => Ok(poisoned.into_inner()),
            Err(TryLockError::WouldBlock) => Err(in_use("the model")),
        }
    }

    fn with<T: Send>(
        &self,
        py: Python<'_>,
        work: impl FnOnce(&mut Opened) -> Result<T, Failure> + Send,
    ) -> PyResult<T> {
        let mut guard = self.lock()?;
        let opened = &mut *guard;
        detached(py, move || work(opened))
    }
}

fn view_at(views: &DatasetViews, view: usize) -> Result<usize, Failure> {
    let count = views.count();
    if view < count {
        Ok(view)
    } else {
        Err(Failure::input(format!("there is no view {view} of {count}")))
    }
}

#[pymethods]
impl OpenedModel {
    /// Names and cameras of the views of a split, in the dataset's own coordinates.
    fn views(&self, py: Python<'_>, split: &str) -> PyResult<Vec<(String, CameraParts)>> {
        let split: Split = options::word("split", split)?;
        self.with(py, |opened| {
            let to_world = opened.dataset.normalisation;
            let views = opened.views(split)?;
            let view = |view| {
                let camera = to_world.world_from_scene_camera(views.camera(view));
                (views.name(view).to_owned(), parts(&camera))
            };
            Ok((0..views.count()).map(view).collect())
        })
    }

    /// Renders a view of a split: colour, alpha, depth, and the photograph.
    #[expect(clippy::type_complexity, reason = "four arrays")]
    fn render(
        &self,
        py: Python<'_>,
        split: &str,
        view: usize,
    ) -> PyResult<((Py<PyAny>, Py<PyAny>, Py<PyAny>), Py<PyAny>)> {
        let split: Split = options::word("split", split)?;
        let (rendering, image, normalisation) = self.with(py, |opened| {
            let views = opened.views(split)?;
            let view = view_at(&views, view)?;
            let background = opened.data.background.fixed();
            let degree = opened.sh_degree;
            let rendering = opened.backend.render(views.camera(view), background, degree)?;
            let image = views.image(view).map_err(Failure::input)?;
            Ok((rendering, image, opened.dataset.normalisation))
        })?;
        Ok((arrays(py, rendering, &normalisation)?, photograph(py, &image)?))
    }

    /// Measures the views of a split, and the geometry if it is known: scores by view, their mean, and the geometry, as
    /// JSON. Those of a run are written to its folder.
    #[pyo3(signature = (split, *, lpips, fit_exposure, listener, stop))]
    fn evaluate(
        &self,
        py: Python<'_>,
        split: &str,
        lpips: Option<PathBuf>,
        fit_exposure: bool,
        listener: &Bound<'_, PyAny>,
        stop: &Bound<'_, Stop>,
    ) -> PyResult<String> {
        let split: Split = options::word("split", split)?;
        let mut guard = self.lock()?;
        let opened = &mut *guard;
        Listener::new(Some(listener), Some(stop))?.follow(py, move |follower| {
            use densify_run::Observer;
            let lpips = lpips.as_deref().map(Lpips::open).transpose();
            let lpips = lpips.map_err(|error| Failure::input(format!("lpips: {error}")))?;
            let views = opened.views(split)?;
            let background = opened.data.background.fixed();
            let has_exposures =
                self.run.as_ref().is_some_and(|(config, _)| config.resolved.has_exposures);
            let comparison = Comparison {
                lpips: lpips.as_ref(),
                fits_exposure: fit_exposure || has_exposures,
                fits_pose: false,
            };
            let mut check = CoordinateCheck::new(views.count());
            let (backend, degree) = (opened.backend.as_mut(), opened.sh_degree);
            let stopped = || {
                let stop = follower.interrupt();
                stop.map(|stop| Failure::new(stop.exit_code, format!("stopped by {}", stop.name)))
            };
            let scores = evaluate(backend, &views, background, degree, comparison, |evaluated| {
                check.add(evaluated.view, evaluated.rendering, evaluated.image, background);
                follower.interrupt().map_or(ControlFlow::Continue(()), |_| ControlFlow::Break(()))
            });
            let scores = match (scores, stopped()) {
                (Ok(scores), None) => scores,
                (_, Some(failure)) => return Err(failure),
                (Err(error), None) => return Err(error.into()),
            };
            check.note(None, &self.path, follower);
            let written = self.run.as_ref().filter(|_| self.writes);
            if let Some((_, iteration)) = written {
                write_scores(&self.path, split, *iteration, &scores)?;
            }
            let geometry = opened
                .geometry(&views, &|| follower.interrupt().is_some())
                .map_err(|failure| stopped().unwrap_or(failure))?;
            if let (Some((_, iteration)), Some(measured)) = (written, &geometry) {
                write_geometry(&self.path, split, *iteration, measured)?;
            }
            let mean = Mean::over(&scores);
            let by_view: Vec<_> = scores
                .iter()
                .map(|score| (&score.name, score.psnr, score.ssim, score.flip, score.lpips))
                .collect();
            serde_json::to_string(&(by_view, mean, geometry)).map_err(Failure::input)
        })
    }

    /// The iteration of the model of a run.
    #[getter]
    fn iteration(&self) -> Option<u32> {
        self.run.as_ref().map(|(_, iteration)| *iteration)
    }
}
