//! Functions that policies share: the largest rows, means over views, quantiles. Ties go to the lower row on every
//! machine, unlike in numpy.

use densify_policies::{adc, sample};
use numpy::{IntoPyArray, PyArray1};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;

use crate::arrays::{floats, rows};

fn one_axis(given: &Bound<'_, PyAny>, name: &str) -> PyResult<Vec<f32>> {
    let (values, shape) = floats(given, name)?;
    if shape.len() == 1 {
        return Ok(values);
    }
    Err(PyValueError::new_err(format!("{name}: expected one dimension, found the shape {shape:?}")))
}

/// The `k` rows with the largest values, largest first; of equal values the lower row first, NaN last.
#[pyfunction]
pub(crate) fn top_k<'py>(
    values: &Bound<'py, PyAny>,
    k: usize,
) -> PyResult<Bound<'py, PyArray1<u32>>> {
    let (py, values) = (values.py(), one_axis(values, "values")?);
    Ok(py.detach(|| sample::top_k(&values, k)).into_pyarray(py))
}

type Selection = fn(Vec<u32>, &[f32], usize) -> Vec<u32>;

fn select<'py>(
    chosen: &Bound<'py, PyAny>,
    values: &Bound<'py, PyAny>,
    k: usize,
    selection: Selection,
) -> PyResult<Bound<'py, PyArray1<u32>>> {
    let (py, values) = (values.py(), one_axis(values, "values")?);
    let chosen = rows(chosen, values.len())?;
    Ok(py.detach(|| selection(chosen, &values, k)).into_pyarray(py))
}

/// Of `rows`, the `k` with the largest values, largest first; of equal values the lower row first, NaN last.
#[pyfunction]
#[pyo3(signature = (rows, values, k))]
pub(crate) fn largest<'py>(
    rows: &Bound<'py, PyAny>,
    values: &Bound<'py, PyAny>,
    k: usize,
) -> PyResult<Bound<'py, PyArray1<u32>>> {
    select(rows, values, k, sample::largest)
}

/// Of `rows`, the `k` with the smallest values, smallest first; of equal values the lower row first, NaN last.
#[pyfunction]
#[pyo3(signature = (rows, values, k))]
pub(crate) fn smallest<'py>(
    rows: &Bound<'py, PyAny>,
    values: &Bound<'py, PyAny>,
    k: usize,
) -> PyResult<Bound<'py, PyArray1<u32>>> {
    select(rows, values, k, sample::smallest)
}

/// Divides a sum over views by the number of views; 0 where no view saw the row or the mean is not finite.
#[pyfunction]
#[pyo3(signature = (sum, views))]
pub(crate) fn mean_over_views<'py>(
    sum: &Bound<'py, PyAny>,
    views: &Bound<'py, PyAny>,
) -> PyResult<Bound<'py, PyArray1<f32>>> {
    let (py, sum, views) = (sum.py(), one_axis(sum, "sum")?, one_axis(views, "views")?);
    if sum.len() != views.len() {
        let (sum, views) = (sum.len(), views.len());
        return Err(PyValueError::new_err(format!("views: {views} numbers, but {sum} sums")));
    }
    Ok(py.detach(|| adc::mean_over_views(&sum, &views)).into_pyarray(py))
}

/// The rows, without the most opaque one if they are all rows: an empty model could never grow again.
#[pyfunction]
#[pyo3(name = "spare_one", signature = (rows, opacity))]
pub(crate) fn spare_one<'py>(
    rows: &Bound<'py, PyAny>,
    opacity: &Bound<'py, PyAny>,
) -> PyResult<Bound<'py, PyArray1<u32>>> {
    let (py, opacity) = (opacity.py(), one_axis(opacity, "opacity")?);
    let mut dead = crate::arrays::rows(rows, opacity.len())?;
    adc::spare_one(&mut dead, &opacity);
    Ok(dead.into_pyarray(py))
}

/// The linearly interpolated `share` quantile of the finite values; None if there are none.
#[pyfunction]
pub(crate) fn quantile(values: &Bound<'_, PyAny>, share: f64) -> PyResult<Option<f64>> {
    if !(0.0..=1.0).contains(&share) {
        return Err(PyValueError::new_err(format!("share is {share}; it must be from 0 to 1")));
    }
    let (py, values) = (values.py(), one_axis(values, "values")?);
    Ok(py.detach(|| sample::quantile(&values, share)))
}
