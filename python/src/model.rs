//! Models as arrays.

use std::path::PathBuf;

use densify_core::antialiasing::Antialiasing;
use densify_core::gaussians::{Gaussians, MAX_SH_DEGREE, sh_coefficients};
use densify_data::models::{Coordinates, find, find_by_extension};
use densify_run::Silent;
use densify_run::failure::Failure;
use densify_run::finished::{Machine, model_file, open_loaded, read_model_as, write_model};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;

use crate::arrays::{floats, shaped};
use crate::camera::{CameraParts, arrays, camera};
use crate::errors::detached;
use crate::follow::Listener;
use crate::options;

/// A model: one entry per Gaussian in each array. All arrays are copies.
#[pyclass(module = "densify._densify", name = "ModelArrays", frozen)]
pub(crate) struct Model(pub(crate) Gaussians);

/// Values of an array of the shape `[rows, …]`, all finite.
fn checked(
    given: &Bound<'_, PyAny>,
    name: &str,
    rows: Option<usize>,
    rest: &[usize],
) -> PyResult<(Vec<f32>, usize)> {
    let (values, shape) = floats(given, name)?;
    let expected_rows = rows.or(shape.first().copied()).unwrap_or(0);
    if shape.len() != 1 + rest.len() || shape[0] != expected_rows || shape[1..] != *rest {
        let rows = rows.map_or_else(|| "rows".to_owned(), |rows| rows.to_string());
        let axes: Vec<String> =
            std::iter::once(rows).chain(rest.iter().map(usize::to_string)).collect();
        return Err(PyValueError::new_err(format!(
            "{name}: expected an array of shape [{}], found {shape:?}",
            axes.join(", ")
        )));
    }
    let width: usize = rest.iter().product();
    match values.iter().position(|value| !value.is_finite()) {
        None => Ok((values, shape[0])),
        Some(at) => Err(PyValueError::new_err(format!(
            "{name}: row {} has a value that is not finite: {}",
            at / width.max(1),
            values[at]
        ))),
    }
}

fn in_chunks<const WIDTH: usize>(values: &[f32]) -> Vec<[f32; WIDTH]> {
    values.as_chunks().0.to_vec()
}

pub(crate) fn antialiasing(name: Option<&str>) -> PyResult<Antialiasing> {
    let parsed = name.map_or(Ok(Antialiasing::None), str::parse);
    parsed.map_err(|error| PyValueError::new_err(format!("antialias: {error}")))
}

#[pymethods]
impl Model {
    #[new]
    #[pyo3(signature = (means, log_scales, quats, opacity_logits, sh, *, origin = [0.0; 3], antialias = None))]
    fn new(
        means: &Bound<'_, PyAny>,
        log_scales: &Bound<'_, PyAny>,
        quats: &Bound<'_, PyAny>,
        opacity_logits: &Bound<'_, PyAny>,
        sh: &Bound<'_, PyAny>,
        origin: [f64; 3],
        antialias: Option<&str>,
    ) -> PyResult<Self> {
        let (means, rows) = checked(means, "means", None, &[3])?;
        let (log_scales, _) = checked(log_scales, "log_scales", Some(rows), &[3])?;
        let (quats, _) = checked(quats, "quats", Some(rows), &[4])?;
        let (opacity_logits, _) = checked(opacity_logits, "opacity_logits", Some(rows), &[])?;
        let (_, shape) = floats(sh, "sh")?;
        let coefficients = shape.get(1).copied().unwrap_or(0);
        let degree = (0..=MAX_SH_DEGREE).find(|degree| sh_coefficients(*degree) == coefficients);
        let Some(sh_degree) = degree.filter(|_| shape.len() == 3) else {
            return Err(PyValueError::new_err(format!(
                "sh: expected an array of shape [{rows}, k, 3] with k = 1, 4, 9 or 16, found {shape:?}"
            )));
        };
        let (sh, _) = checked(sh, "sh", Some(rows), &[coefficients, 3])?;
        let quats: Vec<[f32; 4]> = in_chunks(&quats);
        if let Some(row) =
            quats.iter().position(|quat| !quat.iter().map(|q| q * q).sum::<f32>().is_normal())
        {
            return Err(PyValueError::new_err(format!(
                "quats: row {row} is not a rotation: {:?}",
                quats[row]
            )));
        }
        if !origin.iter().all(|axis| axis.is_finite()) {
            return Err(PyValueError::new_err("origin: a value is not finite"));
        }
        Ok(Self(Gaussians {
            sh_degree,
            antialiasing: antialiasing(antialias)?,
            origin,
            means: in_chunks(&means),
            log_scales: in_chunks(&log_scales),
            quats,
            opacity_logits,
            sh,
        }))
    }

    /// Reads a model: a file of Gaussian splats in any format, or the folder of a run.
    #[staticmethod]
    #[pyo3(signature = (path, *, iteration = None, antialias = None, listener = None))]
    fn load(
        py: Python<'_>,
        path: PathBuf,
        iteration: Option<u32>,
        antialias: Option<&str>,
        listener: Option<&Bound<'_, PyAny>>,
    ) -> PyResult<Self> {
        let antialias = antialias.map(|name| antialiasing(Some(name))).transpose()?;
        Listener::new(listener, None)?.follow(py, move |follower| {
            let file = model_file(&path, iteration)?;
            Ok(Self(read_model_as(&file, antialias, follower)?))
        })
    }

    /// Writes the model; the extension or `format` selects the format.
    #[pyo3(signature = (path, *, format = None, coordinates = "auto", overwrite = false, listener = None))]
    fn save(
        &self,
        py: Python<'_>,
        path: PathBuf,
        format: Option<&str>,
        coordinates: &str,
        overwrite: bool,
        listener: Option<&Bound<'_, PyAny>>,
    ) -> PyResult<()> {
        let coordinates: Coordinates = options::word("coordinates", coordinates)?;
        Listener::new(listener, None)?.follow(py, move |follower| {
            options::check_output(&path, overwrite)?;
            let format = match format {
                Some(name) => {
                    find(name).map_err(|error| Failure::input(format!("format: {error}")))?
                }
                None => find_by_extension(&path)?,
            };
            write_model(format, &path, &self.0, coordinates, follower)
        })
    }

    /// Renders the model from cameras in its own coordinates.
    #[pyo3(signature = (cameras, background, device))]
    #[expect(clippy::type_complexity, reason = "three arrays per view")]
    fn render(
        &self,
        py: Python<'_>,
        cameras: Vec<CameraParts>,
        background: [f32; 3],
        device: &str,
    ) -> PyResult<Vec<(Py<PyAny>, Py<PyAny>, Py<PyAny>)>> {
        let cameras = cameras.into_iter().map(camera).collect::<PyResult<Vec<_>>>()?;
        let (renderings, normalisation) = detached(py, || {
            let spec = options::spec(device)?;
            let machine = Machine::open(&spec.device, &Silent)?;
            let (mut backend, normalisation, degree) =
                open_loaded(self.0.clone(), (spec.start.near, machine), &cameras, &Silent)?;
            let mut renderings = Vec::new();
            for camera in &cameras {
                let camera = normalisation.scene_from_world_camera(camera);
                renderings.push(backend.render(&camera, background, degree)?);
            }
            Ok((renderings, normalisation))
        })?;
        renderings.into_iter().map(|rendering| arrays(py, rendering, &normalisation)).collect()
    }

    fn __len__(&self) -> usize {
        self.0.len()
    }

    /// Means, relative to `origin`. Shape: [rows, 3].
    #[getter]
    fn means<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        shaped(py, self.0.means.as_flattened().to_vec(), [self.0.len(), 3])
    }

    /// Natural logarithms of the standard deviations. Shape: [rows, 3].
    #[getter]
    fn log_scales<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        shaped(py, self.0.log_scales.as_flattened().to_vec(), [self.0.len(), 3])
    }

    /// Orientations (w, x, y, z). Shape: [rows, 4].
    #[getter]
    fn quats<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        shaped(py, self.0.quats.as_flattened().to_vec(), [self.0.len(), 4])
    }

    /// Opacity logits. Shape: [rows].
    #[getter]
    fn opacity_logits<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        shaped(py, self.0.opacity_logits.clone(), [self.0.len()])
    }

    /// Spherical-harmonic coefficients. Shape: [rows, (degree + 1)², 3].
    #[getter]
    fn sh<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        shaped(py, self.0.sh.clone(), [self.0.len(), sh_coefficients(self.0.sh_degree), 3])
    }

    /// The point from which means are measured.
    #[getter]
    fn origin(&self) -> [f64; 3] {
        self.0.origin
    }

    /// Spherical-harmonic degree.
    #[getter]
    fn sh_degree(&self) -> u8 {
        self.0.sh_degree
    }

    /// The kernel of the antialiasing, such as "0.3", or "none".
    #[getter]
    fn antialias(&self) -> &'static str {
        self.0.antialiasing.name()
    }
}
