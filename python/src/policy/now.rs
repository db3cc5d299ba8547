//! The inputs of a policy at an event: signals as arrays that cannot be written, the scene, candidates, and the columns
//! of auxiliary views. All are copies, so a policy may keep them.

use densify_policies::parameters::nearest;
use densify_policies::policy::{
    AuxColumn, AuxView, Candidate, SceneInfo, Signal, SignalSet, Snapshot,
};
use pyo3::exceptions::PyKeyError;
use pyo3::prelude::*;

use super::name_of;
use crate::arrays::frozen;

/// The scene and the run, as known before the first step.
#[pyclass(module = "densify._densify", name = "Scene", frozen)]
pub(crate) struct SceneView {
    /// Size of the scene [scene units], > 0.
    #[pyo3(get)]
    extent: f64,
    /// Number of training views.
    #[pyo3(get)]
    train_views: u32,
    /// Maximum number of rows.
    #[pyo3(get)]
    budget: usize,
    /// Rows after initialisation.
    #[pyo3(get)]
    initial_rows: usize,
    /// Length of the run in steps.
    #[pyo3(get)]
    iterations: u32,
    /// True if images are composited on white.
    #[pyo3(get)]
    white_background: bool,
}

impl SceneView {
    pub(super) fn new(scene: &SceneInfo) -> Self {
        let SceneInfo { extent, train_views, budget, initial_rows, iterations, white_background } =
            *scene;
        Self {
            extent: extent.into(),
            train_views,
            budget,
            initial_rows,
            iterations,
            white_background,
        }
    }
}

/// Surface points: candidates for new rows, or points of an auxiliary view.
#[pyclass(module = "densify._densify", frozen)]
pub(crate) struct Points {
    /// Positions [scene units]. Shape: [n, 3].
    #[pyo3(get)]
    position: Py<PyAny>,
    /// Colours of the photograph in [0, 1]. Shape: [n, 3].
    #[pyo3(get)]
    colour: Py<PyAny>,
    /// Width of a pixel at the point [scene units]. Shape: [n].
    #[pyo3(get)]
    pixel_size: Py<PyAny>,
    /// Error of the pixel; for points of an auxiliary view its accumulated alpha. Shape: [n].
    #[pyo3(get)]
    error: Py<PyAny>,
    count: usize,
}

#[pymethods]
impl Points {
    fn __len__(&self) -> usize {
        self.count
    }
}

impl Points {
    fn new(py: Python<'_>, points: &[Candidate]) -> PyResult<Self> {
        let flat =
            |part: fn(&Candidate) -> [f32; 3]| points.iter().flat_map(part).collect::<Vec<f32>>();
        let each = |part: fn(&Candidate) -> f32| points.iter().map(part).collect::<Vec<f32>>();
        Ok(Self {
            position: frozen(py, &flat(|point| point.position), 3)?,
            colour: frozen(py, &flat(|point| point.colour), 3)?,
            pixel_size: frozen(py, &each(|point| point.pixel_size), 1)?,
            error: frozen(py, &each(|point| point.error), 1)?,
            count: points.len(),
        })
    }
}

/// The model at an event. `now["opacity"]` is the signal of that name.
#[pyclass(module = "densify._densify", frozen)]
pub(crate) struct Now {
    /// Iteration just finished, 1-based.
    #[pyo3(get)]
    step: u32,
    /// Current number of rows.
    #[pyo3(get)]
    rows: usize,
    /// The scene and the run.
    #[pyo3(get)]
    scene: Py<SceneView>,
    /// Candidates for new rows, in the order in which they were found.
    #[pyo3(get)]
    candidates: Py<Points>,
    columns: Vec<(Signal, Py<PyAny>)>,
}

#[pymethods]
impl Now {
    fn __getitem__(&self, py: Python<'_>, key: &str) -> PyResult<Py<PyAny>> {
        find(py, &self.columns, Signal::ALL, "signal", key)
    }
}

impl Now {
    /// Shows the declared signals only, even if there are others.
    pub(super) fn new(py: Python<'_>, now: &Snapshot<'_>, declared: SignalSet) -> PyResult<Self> {
        let given = declared
            .iter()
            .filter_map(|signal| now.signals.get(signal).map(|values| (signal, values)));
        let column =
            |(signal, values): (Signal, &[f32])| Ok((signal, frozen(py, values, signal.width())?));
        Ok(Self {
            step: now.step,
            rows: now.rows(),
            scene: Py::new(py, SceneView::new(now.scene))?,
            candidates: Py::new(py, Points::new(py, now.candidates)?)?,
            columns: given.map(column).collect::<PyResult<_>>()?,
        })
    }
}

/// One auxiliary view. `view["map_sum"]` is the column of that name.
#[pyclass(module = "densify._densify", frozen)]
pub(crate) struct View {
    /// Iteration just finished, 1-based.
    #[pyo3(get)]
    step: u32,
    /// Current number of rows.
    #[pyo3(get)]
    rows: usize,
    /// 0.8·L1 + 0.2·(1 − SSIM) of the view.
    #[pyo3(get)]
    loss: f32,
    /// Surface points, in the order in which their pixels were sampled.
    #[pyo3(get)]
    points: Py<Points>,
    columns: Vec<(AuxColumn, Py<PyAny>)>,
}

#[pymethods]
impl View {
    fn __getitem__(&self, py: Python<'_>, key: &str) -> PyResult<Py<PyAny>> {
        find(py, &self.columns, AuxColumn::ALL, "column", key)
    }
}

impl View {
    pub(super) fn new(
        py: Python<'_>,
        view: &AuxView<'_>,
        declared: &[AuxColumn],
    ) -> PyResult<Self> {
        let given = view.columns.iter().filter(|(column, _)| declared.contains(column));
        let column =
            |(column, values): &(AuxColumn, Vec<f32>)| Ok((*column, frozen(py, values, 1)?));
        Ok(Self {
            step: view.step,
            rows: view.rows,
            loss: view.loss,
            points: Py::new(py, Points::new(py, view.points)?)?,
            columns: given.map(column).collect::<PyResult<_>>()?,
        })
    }
}

fn find<T: serde::Serialize>(
    py: Python<'_>,
    columns: &[(T, Py<PyAny>)],
    all: impl IntoIterator<Item = T>,
    what: &str,
    key: &str,
) -> PyResult<Py<PyAny>> {
    if let Some((_, values)) = columns.iter().find(|(name, _)| name_of(name) == key) {
        return Ok(values.clone_ref(py));
    }
    let names: Vec<String> = all.into_iter().map(|name| name_of(&name)).collect();
    Err(PyKeyError::new_err(if names.iter().any(|name| name == key) {
        format!("{what} {key} was read but not declared; list it in `needs`")
    } else {
        let nearest = nearest(key, names.iter().map(String::as_str));
        let hint = nearest.map_or_else(String::new, |name| format!(" (did you mean `{name}`?)"));
        format!("there is no {what} `{key}`{hint}")
    }))
}
