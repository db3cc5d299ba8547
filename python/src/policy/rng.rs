//! Random numbers of a policy's event, which depend only on seed, step, row and the calls before.

use std::sync::atomic::{AtomicU32, Ordering};

use densify_policies::rng::{PolicyRng, Purpose};
use densify_policies::sample;
use numpy::{IntoPyArray, PyArray1};
use pyo3::exceptions::{PyRuntimeError, PyValueError};
use pyo3::prelude::*;
use pyo3::types::PyDict;

use crate::arrays::{floats, shaped};

/// Counter of the draw that seeds numpy's generator; draws of rows use lower ones.
const GENERATOR: u32 = 0xffff;
/// Calls of an event that draw new numbers: the hash takes counters of 16 bits.
const MAX_CALLS: u32 = 1 << 16;

/// Random numbers of one event.
#[pyclass(module = "densify._densify", frozen)]
pub(crate) struct Rng {
    rng: PolicyRng,
    rows: usize,
    /// Calls so far of the methods that draw new numbers each time.
    calls: AtomicU32,
}

impl Rng {
    pub(super) fn new(rng: PolicyRng, rows: usize) -> Self {
        Self { rng, rows, calls: AtomicU32::new(0) }
    }

    /// The counter of a call: numbers of different calls are independent.
    fn next_call(&self) -> PyResult<u32> {
        let call = self.calls.fetch_add(1, Ordering::Relaxed);
        if call < MAX_CALLS {
            return Ok(call);
        }
        Err(PyRuntimeError::new_err(format!(
            "an event has at most {MAX_CALLS} calls of uniform and normal; use rng.generator()"
        )))
    }

    fn count(&self, given: Option<u32>) -> u32 {
        given.unwrap_or_else(|| u32::try_from(self.rows).unwrap_or(u32::MAX))
    }
}

fn weights_of(given: &Bound<'_, PyAny>) -> PyResult<Vec<f32>> {
    let (weights, shape) = floats(given, "weights")?;
    if shape.len() == 1 {
        return Ok(weights);
    }
    Err(PyValueError::new_err(format!(
        "weights: expected one dimension, found the shape {shape:?}"
    )))
}

#[pymethods]
impl Rng {
    /// Numbers in (0, 1): one per row, or `count`. Each call of an event gives new ones.
    #[pyo3(signature = (count = None))]
    fn uniform<'py>(
        &self,
        py: Python<'py>,
        count: Option<u32>,
    ) -> PyResult<Bound<'py, PyArray1<f32>>> {
        let (rng, count, call) = (self.rng, self.count(count), self.next_call()?);
        let draw = |row| rng.uniform_at(row, Purpose::Own, call);
        let drawn: Vec<f32> = py.detach(|| (0..count).map(draw).collect());
        Ok(drawn.into_pyarray(py))
    }

    /// Three standard normal numbers per row, or for each of `count`. Shape: [rows, 3]. Each call of an
    /// event gives new ones.
    #[pyo3(signature = (count = None))]
    fn normal<'py>(&self, py: Python<'py>, count: Option<u32>) -> PyResult<Bound<'py, PyAny>> {
        let (rng, count, call) = (self.rng, self.count(count), self.next_call()?);
        let draw = |row| rng.normal3(row, Purpose::Own, call);
        let drawn: Vec<f32> = py.detach(|| (0..count).flat_map(draw).collect());
        shaped(py, drawn, [count as usize, 3])
    }

    /// Draws `k` distinct rows, each with a probability proportional to its weight among those that remain; fewer if
    /// fewer weights are positive. The draw is that of policies in Rust, the same in every call of an event.
    fn choice<'py>(
        &self,
        weights: &Bound<'py, PyAny>,
        k: usize,
    ) -> PyResult<Bound<'py, PyArray1<u32>>> {
        let (values, rng) = (weights_of(weights)?, self.rng);
        let py = weights.py();
        Ok(py.detach(|| sample::weighted(&values, k, &rng)).into_pyarray(py))
    }

    /// Draws `k` rows with replacement; returns the rows, ascending, and how often each was drawn. The draw is that of
    /// policies in Rust, the same in every call of an event.
    #[expect(clippy::type_complexity, reason = "two arrays")]
    fn draw<'py>(
        &self,
        weights: &Bound<'py, PyAny>,
        k: usize,
    ) -> PyResult<(Bound<'py, PyArray1<u32>>, Bound<'py, PyArray1<u32>>)> {
        let (values, rng) = (weights_of(weights)?, self.rng);
        let py = weights.py();
        let drawn = py.detach(|| sample::with_replacement(&values, k, &rng));
        let (rows, counts): (Vec<u32>, Vec<u32>) = drawn.into_iter().unzip();
        Ok((rows.into_pyarray(py), counts.into_pyarray(py)))
    }

    /// A numpy generator, the same in every call of an event.
    fn generator<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        let [a, b, c, d] = self.rng.bits(0, Purpose::Draw, GENERATOR).map(u64::from);
        let options = PyDict::new(py);
        let random = py.import("numpy.random")?;
        let key =
            py.import("numpy")?.call_method1("array", ([a << 32 | b, c << 32 | d], "uint64"))?;
        options.set_item("key", key)?;
        random.call_method1("Generator", (random.call_method("Philox", (), Some(&options))?,))
    }
}
