//! Policies written in Python: registered by name, and called like those in Rust.

mod bridge;
mod edits;
mod factory;
mod needs;
mod now;
mod offspring;
mod rng;
mod select;

pub(crate) use edits::Plan;
pub(crate) use factory::{register, set_importer};
pub(crate) use now::{Now, Points, SceneView, View};
pub(crate) use rng::Rng;
pub(crate) use select::{largest, mean_over_views, quantile, smallest, spare_one, top_k};

use densify_policies::conformance;
use densify_policies::policy::{AuxColumn, Signal};
use densify_policies::registry;
use pyo3::prelude::*;
use serde::Serialize;

use crate::errors::{DensifyError, detached, keep};
use crate::options;

/// The name of a signal or a column in Python.
fn name_of(value: &impl Serialize) -> String {
    let name = serde_json::to_value(value).ok();
    name.and_then(|name| name.as_str().map(str::to_owned)).unwrap_or_default()
}

/// Names of all signals, with unit, numbers per row, true if it is reset by a plan, and meaning.
#[pyfunction]
pub(crate) fn signals() -> Vec<(String, &'static str, usize, bool, &'static str)> {
    let signal = |signal: &Signal| {
        let (unit, width) = (signal.unit(), signal.width());
        (name_of(signal), unit, width, signal.is_resettable(), signal.meaning())
    };
    Signal::ALL.iter().map(signal).collect()
}

/// Names of all columns of auxiliary views.
#[pyfunction]
pub(crate) fn columns() -> Vec<String> {
    AuxColumn::ALL.iter().map(name_of).collect()
}

/// All policies: name, summary, source, place, manual page, and parameters with their defaults as TOML.
#[pyfunction]
#[expect(clippy::type_complexity, reason = "the Python side makes objects of it")]
pub(crate) fn policies(
    py: Python<'_>,
) -> PyResult<Vec<(&'static str, &'static str, &'static str, String, String, Vec<(String, String)>)>>
{
    let all = detached(py, || Ok(registry::policies()?))?;
    let parameters = |entry: &registry::PolicyEntry| {
        entry.parameters().into_iter().map(|(name, value)| (name, value.to_string())).collect()
    };
    let row = |entry: &&registry::PolicyEntry| {
        let PolicyEntry { name, summary, source, .. } = **entry;
        (name, summary, source, entry.location(), entry.manual(), parameters(entry))
    };
    use registry::PolicyEntry;
    Ok(all.iter().map(row).collect())
}

/// Runs the conformance suite on a policy with some parameters set, and compares its manual page with it.
#[pyfunction]
pub(crate) fn check_policy(py: Python<'_>, name: &str, parameters: &str) -> PyResult<()> {
    let checked = detached(py, || {
        let entry = registry::find(name)?;
        let report = conformance::check_policy_with(entry, &options::table(parameters)?)
            .and_then(|()| conformance::check_manual(entry));
        Ok(report.map_err(|report| report.to_string()))
    })?;
    checked.map_err(DensifyError::new_err)
}

/// An exception of a policy as the error that ends the run.
fn failed(py: Python<'_>, error: PyErr) -> densify_policies::policy::PolicyError {
    densify_policies::policy::PolicyError::Other(keep(py, error))
}
