//! Numbers and rows from Python objects, with checks, and arrays for Python.

use numpy::{PyArray1, PyArrayDyn, PyArrayMethods, PyUntypedArray, PyUntypedArrayMethods};
use pyo3::exceptions::{PyIndexError, PyTypeError, PyValueError};
use pyo3::prelude::*;
use pyo3::types::PyDict;

/// Converts an object to a numpy array; `dtype` as numpy spells it.
fn as_array<'py>(
    given: &Bound<'py, PyAny>,
    dtype: Option<&str>,
) -> PyResult<Bound<'py, PyUntypedArray>> {
    let py = given.py();
    let options = PyDict::new(py);
    options.set_item("order", "C")?;
    if let Some(dtype) = dtype {
        options.set_item("dtype", dtype)?;
    }
    let numpy = py.import("numpy")?;
    // Other libraries' host arrays come through DLPack.
    let given = if given.is_instance_of::<PyUntypedArray>() || !given.hasattr("__dlpack__")? {
        given.clone()
    } else {
        numpy.call_method1("from_dlpack", (given,))?
    };
    Ok(numpy.getattr("asarray")?.call((given,), Some(&options))?.cast_into::<PyUntypedArray>()?)
}

fn kind(array: &Bound<'_, PyUntypedArray>) -> PyResult<String> {
    array.dtype().getattr("kind")?.extract()
}

/// Rows of a model with `count` rows: integers of any width, a mask of all rows, or a sequence of integers.
///
/// # Errors
/// `IndexError` when there is no such row; `ValueError` for a mask of another length; `TypeError` for other types.
pub(crate) fn rows(given: &Bound<'_, PyAny>, count: usize) -> PyResult<Vec<u32>> {
    let array = as_array(given, None)?;
    if array.ndim() != 1 {
        return Err(PyTypeError::new_err(format!(
            "rows: expected one dimension, found {}",
            array.ndim()
        )));
    }
    match kind(&array)?.as_str() {
        "b" => {
            let mask = array.cast::<PyArray1<bool>>()?.readonly();
            let mask = mask.as_slice()?;
            if mask.len() != count {
                return Err(PyValueError::new_err(format!(
                    "rows: the mask has {} entries, but there are {count} rows",
                    mask.len()
                )));
            }
            Ok((0..).zip(mask).filter(|(_, taken)| **taken).map(|(row, _)| row).collect())
        }
        "i" | "u" => {
            let wide = as_array(&array, Some("int64"))?;
            let wide = wide.cast::<PyArray1<i64>>()?.readonly();
            let checked = |&row: &i64| match u32::try_from(row) {
                Ok(index) if (index as usize) < count => Ok(index),
                _ => Err(PyIndexError::new_err(format!(
                    "there is no row {row}; there are {count} rows"
                ))),
            };
            wide.as_slice()?.iter().map(checked).collect()
        }
        _ if array.len() == 0 => Ok(Vec::new()),
        _ => Err(PyTypeError::new_err(format!(
            "rows: expected integers or a mask, found {}",
            array.dtype()
        ))),
    }
}

/// A float32 array of any shape, row-major, from floating-point numbers or integers.
pub(crate) fn floats(given: &Bound<'_, PyAny>, name: &str) -> PyResult<(Vec<f32>, Vec<usize>)> {
    let array = as_array(given, None)?;
    if !["f", "i", "u"].contains(&kind(&array)?.as_str()) {
        let dtype = array.dtype();
        return Err(PyTypeError::new_err(format!("{name}: expected numbers, found {dtype}")));
    }
    let array = as_array(&array, Some("float32"))?;
    let array = array.cast::<PyArrayDyn<f32>>()?.readonly();
    Ok((array.as_slice()?.to_vec(), array.shape().to_vec()))
}

/// Numbers for each of several rows: the same for all, or one each.
pub(crate) enum PerRow<const WIDTH: usize> {
    /// The same for all.
    Same([f32; WIDTH]),
    /// One per row.
    Each(Vec<[f32; WIDTH]>),
}

impl<const WIDTH: usize> PerRow<WIDTH> {
    /// Takes numbers for `count` rows.
    ///
    /// # Errors
    /// `ValueError` when the shape is wrong, `TypeError` when the type is.
    pub(crate) fn new(given: &Bound<'_, PyAny>, count: usize, name: &str) -> PyResult<Self> {
        let (values, shape) = floats(given, name)?;
        let (chunks, _) = values.as_chunks::<WIDTH>();
        let own: &[usize] = if WIDTH == 1 { &[] } else { &[WIDTH] };
        if shape == own || (WIDTH > 1 && shape == [1, WIDTH]) {
            return Ok(Self::Same(chunks[0]));
        }
        if shape.len() == own.len() + 1 && shape[0] == count && shape[1..] == *own {
            return Ok(Self::Each(chunks.to_vec()));
        }
        let one = if WIDTH == 1 { "a number".to_owned() } else { format!("{WIDTH} numbers") };
        Err(PyValueError::new_err(format!(
            "{name}: expected {one} for all rows or for each of {count}, found an array of shape {shape:?}"
        )))
    }

    /// The numbers of the row at this place of the list of rows.
    pub(crate) fn at(&self, place: usize) -> [f32; WIDTH] {
        match self {
            Self::Same(value) => *value,
            Self::Each(values) => values[place],
        }
    }
}

impl PerRow<1> {
    /// The number of the row at this place of the list of rows.
    pub(crate) fn number(&self, place: usize) -> f32 {
        self.at(place)[0]
    }
}

/// An array that cannot be written, of shape `[rows, width]`, or `[rows]` if `width` is 1.
pub(crate) fn frozen(py: Python<'_>, values: &[f32], width: usize) -> PyResult<Py<PyAny>> {
    let array = PyArray1::from_slice(py, values);
    array.readwrite().make_nonwriteable();
    if width == 1 {
        return Ok(array.into_any().unbind());
    }
    Ok(array.reshape([values.len() / width, width])?.into_any().unbind())
}

/// An array of this shape.
pub(crate) fn shaped<'py, const AXES: usize>(
    py: Python<'py>,
    values: Vec<f32>,
    shape: [usize; AXES],
) -> PyResult<Bound<'py, PyAny>> {
    Ok(PyArray1::from_vec(py, values).reshape(shape.to_vec())?.into_any())
}
