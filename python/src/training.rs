//! Training: a whole run with all its files, or a trainer that is stepped from Python.

use std::path::PathBuf;
use std::sync::{Mutex, MutexGuard, TryLockError};

use densify_core::camera::Camera;
use densify_core::memory::Ledger;
use densify_data::views::ViewSource;
use densify_run::failure::Failure;
use densify_run::{Host, Occupied, Run, RunSpec, start};
use densify_train::output::RunFolder;
use pyo3::exceptions::PyRuntimeError;
use pyo3::prelude::*;

use crate::camera::{CameraParts, arrays, camera};
use crate::errors::{detached, in_use, raise};
use crate::follow::{Follower, Listener, Stop};
use crate::model::Model;
use crate::options;

/// The treatment of a run that is in the output folder.
fn occupied(resume: bool, overwrite: bool) -> Result<Occupied, Failure> {
    match (resume, overwrite) {
        (true, true) => {
            Err(Failure::input("resume= and overwrite= exclude each other; leave one out"))
        }
        (true, false) => Ok(Occupied::Resume),
        (false, true) => Ok(Occupied::Replace),
        (false, false) => Ok(Occupied::Refuse),
    }
}

/// Starts the measurement of this process's peak memory anew: what other runs and the user's program have used before
/// is not a part of this run.
fn restart_peak() {
    // Only Linux has this file; elsewhere the peak is not known either.
    let _ = std::fs::write("/proc/self/clear_refs", "5");
}

/// Trains a run and writes all its files; returns its folder.
#[pyfunction]
#[pyo3(signature = (options, *, resume, overwrite, listener, stop))]
pub(crate) fn train(
    py: Python<'_>,
    options: &str,
    resume: bool,
    overwrite: bool,
    listener: &Bound<'_, PyAny>,
    stop: &Bound<'_, Stop>,
) -> PyResult<PathBuf> {
    Listener::new(Some(listener), Some(stop))?.follow(py, |follower| {
        let occupied = occupied(resume, overwrite)?;
        let given = options::partial(options)?;
        let (spec, resumed) =
            if resume { start(given, follower)? } else { (given.describe()?, None) };
        if occupied != Occupied::Resume {
            RunFolder::check(&spec.output_folder()?, overwrite)?;
        }
        restart_peak();
        let run = Run::prepare_on(&spec, resumed, Host::new(follower))?;
        run.train(occupied, follower)
    })
}

/// Prepares a run, or one to resume, and writes nothing.
#[pyfunction]
#[pyo3(signature = (options, *, resume, listener))]
pub(crate) fn prepare(
    py: Python<'_>,
    options: &str,
    resume: bool,
    listener: &Bound<'_, PyAny>,
) -> PyResult<TrainerCore> {
    Listener::new(Some(listener), None)?.follow(py, |follower| {
        let given = options::partial(options)?;
        let is_named = given.get("output").is_some();
        let (spec, resumed) =
            if resume { start(given, follower)? } else { (given.describe()?, None) };
        // A folder that the user names is to hold checkpoints, so an occupied one is refused before any step.
        if is_named && !resume {
            RunFolder::check(&spec.output_folder()?, false)?;
        }
        restart_peak();
        let run = Run::prepare_on(&spec, resumed, Host::new(follower))?;
        let (last, ledger) = (run.last, run.ledger.clone());
        let state = State { run: Some(Box::new(run)), continues: resume, over: None };
        Ok(TrainerCore { state: Mutex::new(state), spec, last, ledger })
    })
}

/// A prepared run.
struct State {
    /// `None` once the run was trained to the end.
    run: Option<Box<Run>>,
    /// True if the files in the output folder are this run's own.
    continues: bool,
    /// The reason why there are no more steps, if a step has failed or the run was trained to the end.
    over: Option<&'static str>,
}

impl State {
    fn run(&mut self) -> PyResult<&mut Run> {
        self.run.as_deref_mut().ok_or_else(|| over(FINISHED))
    }
}

const FINISHED: &str = "it has been trained to the end";

fn over(why: &str) -> PyErr {
    PyRuntimeError::new_err(format!("this trainer cannot continue: {why}"))
}

/// A run that is stepped from Python.
#[pyclass(module = "densify._densify", frozen)]
pub(crate) struct TrainerCore {
    state: Mutex<State>,
    spec: RunSpec,
    last: u32,
    ledger: Ledger,
}

impl TrainerCore {
    fn lock(&self) -> PyResult<MutexGuard<'_, State>> {
        match self.state.try_lock() {
            Ok(guard) => Ok(guard),
            Err(TryLockError::Poisoned(poisoned)) => Ok(poisoned.into_inner()),
            Err(TryLockError::WouldBlock) => Err(in_use("the trainer")),
        }
    }

    /// Works on the run without the interpreter.
    fn with<T: Send>(
        &self,
        py: Python<'_>,
        work: impl FnOnce(&mut Run) -> Result<T, Failure> + Send,
    ) -> PyResult<T> {
        let mut state = self.lock()?;
        let run = state.run()?;
        detached(py, move || work(run))
    }
}

/// Fails for a camera with more pixels than the training views have: the backend would take more memory than promised.
fn check_size(run: &Run, camera: &Camera) -> Result<(), Failure> {
    let views = run.trainer.views();
    let sizes =
        (0..views.count()).map(|view| views.camera(view)).map(|view| (view.width, view.height));
    let fits = |(width, height): (u32, u32)| camera.width <= width && camera.height <= height;
    if sizes.clone().any(fits) {
        return Ok(());
    }
    let (width, height) = sizes
        .max_by_key(|&(width, height)| u64::from(width) * u64::from(height))
        .unwrap_or_default();
    Err(Failure::input(format!(
        "a camera of {}x{} pixels is larger than the training views ({width}x{height}), and would take more memory than \
         the run promises; render it with trainer.model().render(camera)",
        camera.width, camera.height
    )))
}

#[pymethods]
impl TrainerCore {
    /// One iteration: step, index of the view, name of the view, loss, L1, SSIM, rows, and the edits as JSON.
    #[expect(clippy::type_complexity, reason = "the Python side makes an object of it")]
    fn step(&self, py: Python<'_>) -> PyResult<(u32, usize, String, f32, f32, f32, usize, String)> {
        let mut state = self.lock()?;
        if let Some(why) = state.over {
            return Err(over(why));
        }
        let run = state.run()?;
        if run.trainer.steps_done() >= self.last {
            return Err(over(FINISHED));
        }
        let done = detached(py, move || {
            let report = run.step()?;
            let name = run.trainer.views().name(report.view).to_owned();
            // Edits are plain numbers and text.
            let events = serde_json::to_string(&report.events).unwrap_or_default();
            let output = report.output;
            Ok((
                report.step,
                report.view,
                name,
                output.loss,
                output.l1,
                output.ssim,
                report.rows,
                events,
            ))
        });
        // The model that was trained so far remains.
        if done.is_err() {
            state.over = Some("a step has failed");
        }
        done
    }

    /// Trains to the end and writes all files of the run; returns its folder.
    #[pyo3(signature = (*, overwrite, listener, stop))]
    fn finish(
        &self,
        py: Python<'_>,
        overwrite: bool,
        listener: &Bound<'_, PyAny>,
        stop: &Bound<'_, Stop>,
    ) -> PyResult<PathBuf> {
        let folder = self.spec.output_folder().map_err(|failure| raise(py, &failure))?;
        let listener = Listener::new(Some(listener), Some(stop))?;
        let (run, occupied) = {
            let mut state = self.lock()?;
            if let Some(why) = state.over {
                return Err(over(why));
            }
            let continues = state.continues;
            let occupied = occupied(continues, overwrite).map_err(|failure| raise(py, &failure))?;
            let run = state.run()?;
            detached(py, move || {
                RunFolder::check(&folder, continues || overwrite)?;
                run.check_continued()
            })?;
            state.over = Some(FINISHED);
            (state.run.take(), occupied)
        };
        let run = run.ok_or_else(|| over(FINISHED))?;
        listener.follow(py, |follower: &Follower| run.train(occupied, follower))
    }

    /// Writes a checkpoint into the output folder; returns the folder.
    fn save_checkpoint(&self, py: Python<'_>) -> PyResult<PathBuf> {
        let mut state = self.lock()?;
        if let Some(why) = state.over {
            return Err(over(why));
        }
        let run = state.run()?;
        let folder = detached(py, move || run.save_checkpoint())?;
        state.continues = true;
        Ok(folder)
    }

    /// The model in the dataset's own coordinates.
    fn model(&self, py: Python<'_>) -> PyResult<Model> {
        self.with(py, |run| {
            let to_world = run.dataset.normalisation;
            let origin = if to_world.is_remote() { to_world.local_origin() } else { [0.0; 3] };
            Ok(Model(to_world.world_from_model(run.trainer.model()?, origin)))
        })
    }

    /// Renders a camera in the dataset's own coordinates.
    fn render(
        &self,
        py: Python<'_>,
        view: CameraParts,
        background: [f32; 3],
    ) -> PyResult<(Py<PyAny>, Py<PyAny>, Py<PyAny>)> {
        let camera = camera(view)?;
        let (rendering, normalisation) = self.with(py, |run| {
            let to_world = run.dataset.normalisation;
            let camera = to_world.scene_from_world_camera(&camera);
            check_size(run, &camera)?;
            let backend = run.trainer.backend_and_history().0;
            let degree = backend.sh_degree();
            Ok((backend.render(&camera, background, degree)?, to_world))
        })?;
        arrays(py, rendering, &normalisation)
    }

    /// Steps done.
    #[getter]
    fn steps_done(&self, py: Python<'_>) -> PyResult<u32> {
        self.with(py, |run| Ok(run.trainer.steps_done()))
    }

    /// Current number of rows.
    #[getter]
    fn rows(&self, py: Python<'_>) -> PyResult<usize> {
        self.with(py, |run| Ok(run.trainer.rows()))
    }

    /// Length of the run in steps.
    #[getter]
    fn last(&self) -> u32 {
        self.last
    }

    /// Planned memory: section, contents and bytes of each buffer.
    #[getter]
    fn ledger(&self) -> Vec<(&'static str, String, u64)> {
        ledger_lines(&self.ledger)
    }

    /// Planned memory in total [bytes].
    #[getter]
    fn total_bytes(&self) -> u64 {
        self.ledger.total()
    }

    /// The run with every choice made, as JSON.
    fn config(&self, py: Python<'_>) -> PyResult<String> {
        self.with(py, |run| serde_json::to_string(&run.config.table()?).map_err(Failure::input))
    }
}

/// The buffers of a ledger: section, contents, bytes.
pub(crate) fn ledger_lines(ledger: &Ledger) -> Vec<(&'static str, String, u64)> {
    ledger.lines.iter().map(|line| (line.section.name(), line.what.clone(), line.bytes)).collect()
}
