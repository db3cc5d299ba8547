//! The plan of an event as a Python object. Rows are checked before the first edit of a call, and each call returns a
//! mask of the edits that the plan has accepted.

use std::sync::{Mutex, MutexGuard, TryLockError};

use densify_policies::plan::{Decay, EditPlan, NO_ROTATION, Refused, Reset, Seed, Update};
use densify_policies::policy::{Signal, SignalSet};
use numpy::{IntoPyArray, PyArray1};
use pyo3::exceptions::{PyRuntimeError, PyTypeError, PyValueError};
use pyo3::prelude::*;

use super::name_of;
use super::offspring::{Offsprings, Opacities, Scales, is_per_axis};
use crate::arrays::{PerRow, floats, rows};
use crate::errors::{Undeclared, in_use};

type Mask<'py> = Bound<'py, PyArray1<bool>>;

/// The edits of one event.
#[pyclass(module = "densify._densify", frozen)]
pub(crate) struct Plan(Mutex<Option<EditPlan>>);

/// True for an accepted edit, false for one without room or of a row that has an edit already.
fn is_accepted(done: Result<(), Refused>, place: usize) -> PyResult<bool> {
    match done {
        Ok(()) => Ok(true),
        Err(Refused::NoRoom | Refused::Taken) => Ok(false),
        Err(refused @ Refused::Undeclared) => Err(Undeclared::new_err(refused.to_string())),
        // Rows have been checked, so a missing row means a bad value, too.
        Err(refused) => Err(PyValueError::new_err(format!("entry {place}: {refused}"))),
    }
}

impl Plan {
    pub(super) fn new(plan: EditPlan) -> Self {
        Self(Mutex::new(Some(plan)))
    }

    fn lock(&self) -> PyResult<MutexGuard<'_, Option<EditPlan>>> {
        match self.0.try_lock() {
            Ok(guard) => Ok(guard),
            Err(TryLockError::Poisoned(poisoned)) => Ok(poisoned.into_inner()),
            Err(TryLockError::WouldBlock) => Err(in_use("the plan")),
        }
    }

    /// Ends the event.
    pub(super) fn take(&self) -> PyResult<EditPlan> {
        self.lock()?.take().ok_or_else(over)
    }

    fn with<T>(&self, work: impl FnOnce(&mut EditPlan) -> PyResult<T>) -> PyResult<T> {
        work(self.lock()?.as_mut().ok_or_else(over)?)
    }
}

fn over() -> PyErr {
    PyRuntimeError::new_err("the event of this plan is over; edit the plan of the next event")
}

#[pymethods]
impl Plan {
    /// Rows before the edit.
    #[getter]
    fn rows(&self) -> PyResult<usize> {
        self.with(|plan| Ok(plan.rows()))
    }

    /// Maximum number of rows of the model.
    #[getter]
    fn budget(&self) -> PyResult<usize> {
        self.with(|plan| Ok(plan.budget()))
    }

    /// Number of rows that may still be added.
    #[getter]
    fn room(&self) -> PyResult<usize> {
        self.with(|plan| Ok(plan.room()))
    }

    /// Rows pruned so far.
    #[getter]
    fn pruned(&self) -> PyResult<usize> {
        self.with(|plan| Ok(plan.pruned()))
    }

    /// A mask of the rows without an edit. Shape: [rows].
    #[getter]
    fn free<'py>(&self, py: Python<'py>) -> PyResult<Mask<'py>> {
        self.with(|plan| {
            let free = |row| plan.is_free(row);
            let free: Vec<bool> = (0..).take(plan.rows()).map(free).collect();
            Ok(free.into_pyarray(py))
        })
    }

    /// Removes rows; their slots can be reused within this plan.
    #[pyo3(signature = (rows))]
    fn prune<'py>(&self, rows: &Bound<'py, PyAny>) -> PyResult<Mask<'py>> {
        self.with(|plan| {
            let chosen = self::rows(rows, plan.rows())?;
            let edits = chosen.iter().enumerate();
            let done: PyResult<Vec<bool>> =
                edits.map(|(place, &row)| is_accepted(plan.prune(row), place)).collect();
            Ok(done?.into_pyarray(rows.py()))
        })
    }

    /// Clones or splits rows.
    #[pyo3(signature = (rows, offspring))]
    fn grow<'py>(
        &self,
        rows: &Bound<'py, PyAny>,
        offspring: &Bound<'py, PyAny>,
    ) -> PyResult<Mask<'py>> {
        self.with(|plan| {
            let chosen = self::rows(rows, plan.rows())?;
            let offspring = Offsprings::new(offspring, chosen.len())?;
            let mut done = Vec::new();
            for (place, &row) in chosen.iter().enumerate() {
                done.push(is_accepted(plan.grow(row, offspring.at(place)?), place)?);
            }
            Ok(done.into_pyarray(rows.py()))
        })
    }

    /// Rewrites rows in place.
    #[pyo3(signature = (rows, *, opacity = None, scale = None, position = None, colour = None, sh_degree = None, keep_moments = true))]
    #[expect(clippy::too_many_arguments, reason = "keyword arguments")]
    fn update<'py>(
        &self,
        rows: &Bound<'py, PyAny>,
        opacity: Option<&Bound<'py, PyAny>>,
        scale: Option<&Bound<'py, PyAny>>,
        position: Option<&Bound<'py, PyAny>>,
        colour: Option<&Bound<'py, PyAny>>,
        sh_degree: Option<u8>,
        keep_moments: bool,
    ) -> PyResult<Mask<'py>> {
        self.with(|plan| {
            let chosen = self::rows(rows, plan.rows())?;
            let count = chosen.len();
            let opacity = opacity.map(|given| Opacities::new(given, count)).transpose()?;
            let scale = scale.map(|given| Scales::new(given, count)).transpose()?;
            let position =
                position.map(|given| PerRow::new(given, count, "position")).transpose()?;
            let colour = colour.map(|given| PerRow::new(given, count, "colour")).transpose()?;
            let mut done = Vec::new();
            for (place, &row) in chosen.iter().enumerate() {
                let update = Update {
                    opacity: opacity.as_ref().map_or(Update::NONE.opacity, |rule| rule.at(place)),
                    scale: scale.as_ref().map_or(Update::NONE.scale, |rule| rule.at(place)),
                    position: position.as_ref().map(|position| position.at(place)),
                    colour: colour.as_ref().map(|colour| colour.at(place)),
                    sh_degree,
                    keep_moments,
                };
                done.push(is_accepted(plan.update(row, update), place)?);
            }
            Ok(done.into_pyarray(rows.py()))
        })
    }

    /// Adds rows without a parent, one for each position.
    #[pyo3(signature = (position, colour, scale, opacity, orientation = None))]
    fn append<'py>(
        &self,
        position: &Bound<'py, PyAny>,
        colour: &Bound<'py, PyAny>,
        scale: &Bound<'py, PyAny>,
        opacity: &Bound<'py, PyAny>,
        orientation: Option<&Bound<'py, PyAny>>,
    ) -> PyResult<Mask<'py>> {
        let (positions, shape) = floats(position, "position")?;
        if shape.len() != 2 || shape[1] != 3 {
            return Err(PyValueError::new_err(format!(
                "position: expected an array of shape [n, 3], found {shape:?}"
            )));
        }
        let count = shape[0];
        let colour = PerRow::<3>::new(colour, count, "colour")?;
        let is_per_axis = is_per_axis(scale, count)?;
        let axes = is_per_axis.then(|| PerRow::<3>::new(scale, count, "scale")).transpose()?;
        let round = (!is_per_axis).then(|| PerRow::<1>::new(scale, count, "scale")).transpose()?;
        let opacity = PerRow::<1>::new(opacity, count, "opacity")?;
        let orientation =
            orientation.map(|given| PerRow::<4>::new(given, count, "orientation")).transpose()?;
        self.with(|plan| {
            let mut done = Vec::new();
            for (place, &position) in positions.as_chunks().0.iter().enumerate() {
                let scales = match (&axes, &round) {
                    (Some(axes), _) => axes.at(place),
                    (None, Some(round)) => [round.number(place); 3],
                    (None, None) => [0.0; 3],
                };
                let seed = Seed {
                    position,
                    colour: colour.at(place),
                    scales,
                    orientation: orientation.as_ref().map_or(NO_ROTATION, |each| each.at(place)),
                    opacity: opacity.number(place),
                };
                done.push(is_accepted(plan.append(seed), place)?);
            }
            Ok(done.into_pyarray(position.py()))
        })
    }

    /// Reduces the opacities and scales of all rows, or of those that were visible.
    #[pyo3(signature = (*, opacity = 0.0, scale = 0.0, seen_only = false))]
    fn decay(&self, opacity: f32, scale: f32, seen_only: bool) -> PyResult<()> {
        self.with(|plan| is_accepted(plan.decay(Decay { opacity, scale, seen_only }), 0).map(drop))
    }

    /// Limits the opacity of all rows.
    #[pyo3(signature = (max))]
    fn clamp_opacity(&self, max: f32) -> PyResult<()> {
        self.with(|plan| is_accepted(plan.clamp_opacity(max), 0).map(drop))
    }

    /// Resets accumulators: "signals", "candidates", or a list of names of signals.
    #[pyo3(signature = (what = None))]
    fn reset(&self, what: Option<&Bound<'_, PyAny>>) -> PyResult<()> {
        let reset = match what {
            None => Reset::Signals,
            Some(what) => match what.extract::<String>() {
                Ok(word) if word == "signals" => Reset::Signals,
                Ok(word) if word == "candidates" => Reset::Candidates,
                Ok(word) => {
                    return Err(PyValueError::new_err(format!(
                        "reset: `{word}` is not one of signals, candidates; give single signals as a list"
                    )));
                }
                Err(_) => Reset::Only(signals_of(what)?),
            },
        };
        self.with(|plan| {
            plan.reset(reset);
            Ok(())
        })
    }

    /// Adds a reason for the event log.
    #[pyo3(signature = (tag))]
    fn cause(&self, tag: &str) -> PyResult<()> {
        self.with(|plan| {
            plan.cause(tag);
            Ok(())
        })
    }
}

fn signals_of(names: &Bound<'_, PyAny>) -> PyResult<SignalSet> {
    let names: Vec<String> = names.extract().map_err(|_| {
        PyTypeError::new_err("reset: expected a word, or a list of names of signals")
    })?;
    let signal = |name: &String| {
        let found = Signal::ALL.into_iter().find(|signal| name_of(signal) == *name);
        found.ok_or_else(|| PyValueError::new_err(format!("reset: there is no signal `{name}`")))
    };
    names.iter().map(signal).collect()
}
