//! What the other commands do, as functions: they return data, and report to a Python object.

use std::path::PathBuf;

use densify_compress as compressing;
use densify_core::numbers;
use densify_data::dataset::builtin;
use densify_data::models::{compress_formats, find, find_by_extension};
use densify_report::ReportOptions;
use densify_run::Host;
use densify_run::failure::Failure;
use densify_run::finished::{is_model, model_file};
use densify_run::refining::TrainedModel;
use densify_scenegen::{self as generator, Scene, Source};
use densify_study::{Comparison, Decide, EngineArgs, Limit, SceneLimit};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;

use crate::follow::{Listener, Stop};
use crate::training::ledger_lines;
use crate::{model, options};

type Alternatives = (u64, Vec<(u32, (u32, u32))>, Vec<Vec<Option<usize>>>);
type PlanParts = (Vec<(&'static str, String, u64)>, u64, Vec<String>, Alternatives);

/// The memory of a run: buffers, total, text, and other sizes that fit the same memory.
#[pyfunction]
#[pyo3(signature = (options, *, listener))]
pub(crate) fn plan(
    py: Python<'_>,
    options: &str,
    listener: &Bound<'_, PyAny>,
) -> PyResult<PlanParts> {
    Listener::new(Some(listener), None)?.follow(py, |follower| {
        let plan = densify_run::plan(&options::spec(options)?, Host::new(follower))?;
        let densify_run::Alternatives { memory, images, rows } = plan.alternatives;
        let total = plan.ledger.total();
        Ok((ledger_lines(&plan.ledger), total, plan.lines, (memory, images, rows)))
    })
}

/// Reduces a model or its file; returns the file, and each attempt: kind, rows, degree, format, bytes, PSNR of training
/// and test views.
#[pyfunction]
#[pyo3(signature = (model, output, options, *, to_rows, to_bytes, format, iterations, seed, iteration, overwrite, antialias, listener, stop))]
#[expect(clippy::too_many_arguments, clippy::type_complexity, reason = "keyword arguments")]
pub(crate) fn compress(
    py: Python<'_>,
    model: PathBuf,
    output: PathBuf,
    options: &str,
    to_rows: Option<usize>,
    to_bytes: Option<u64>,
    format: Option<&str>,
    iterations: u32,
    seed: u64,
    iteration: Option<u32>,
    overwrite: bool,
    antialias: Option<&str>,
    listener: &Bound<'_, PyAny>,
    stop: &Bound<'_, Stop>,
) -> PyResult<(PathBuf, Vec<(&'static str, usize, u8, &'static str, u64, f64, Option<f64>)>)> {
    let antialias = antialias.map(|name| model::antialiasing(Some(name))).transpose()?;
    Listener::new(Some(listener), Some(stop))?.follow(py, move |follower| {
        let given = options::for_model(options, !is_model(&model), &[])?;
        let formats = match format {
            Some("any") => compress_formats(),
            Some(name) => {
                vec![find(name).map_err(|e| Failure::input(format!("format: {e}, any")))?]
            }
            None => vec![find_by_extension(&output)?],
        };
        for format in &formats {
            options::check_output(&compressing::file(&output, &formats, format), overwrite)?;
        }
        let to = match (to_rows, to_bytes) {
            (Some(rows), None) if rows > 0 => compressing::Target::Rows(rows),
            (None, Some(bytes)) if bytes > 0 => compressing::Target::Bytes(bytes),
            _ => {
                return Err(Failure::input(
                    "to: give a number of Gaussians, or a size such as \"5MiB\"",
                ));
            }
        };
        let file = model_file(&model, iteration)?;
        let of_file = (given.data, given.depth, given.start.near);
        let trained = TrainedModel::find(&model, file, given.start.scene, of_file, "scene=")?;
        let done = compressing::compress(
            &compressing::Options {
                model: trained,
                antialias,
                device: given.device,
                to,
                iterations: iterations.max(1),
                seed,
                formats: &formats,
                output: &output,
            },
            follower,
        )?;
        let row = |kind: &'static str, attempt: &compressing::Attempt| {
            let compressing::Attempt { rows, sh_degree, format, bytes, train_psnr, test_psnr } =
                *attempt;
            (kind, rows, sh_degree, format, bytes, train_psnr, test_psnr)
        };
        let mut attempts = vec![row("whole", &done.whole)];
        attempts.extend(done.stages.iter().map(|stage| row("stage", stage)));
        attempts.extend(done.attempts.iter().enumerate().map(|(place, attempt)| {
            row(if place == done.best { "written" } else { "tried" }, attempt)
        }));
        Ok((done.file, attempts))
    })
}

/// Ray-traces a mesh, or the built-in scene `scene:NAME`; returns the numbers of views and of points.
#[pyfunction]
#[pyo3(signature = (source, output, options, *, overwrite, listener))]
pub(crate) fn scenegen(
    py: Python<'_>,
    source: PathBuf,
    output: PathBuf,
    options: &str,
    overwrite: bool,
    listener: &Bound<'_, PyAny>,
) -> PyResult<(usize, usize)> {
    Listener::new(Some(listener), None)?.follow(py, move |follower| {
        use densify_run::Observer;
        let given: serde_json::Map<String, serde_json::Value> =
            serde_json::from_str(options).map_err(Failure::input)?;
        let defaults =
            serde_json::to_value(generator::Options::default()).map_err(Failure::input)?;
        let options = overlay(defaults, given)?;
        let options = serde_json::from_value(options)
            .map_err(|error| Failure::input(format!("an option of the scene: {error}")))?;
        let source = match builtin::name(&source) {
            Some(name) => Source::Preset(name.to_owned()),
            None => Source::File(source),
        };
        generator::check_target(&output, overwrite)?;
        let scene = Scene::prepare(&source, &options)?;
        for note in &scene.model.notes {
            follower.say(format_args!("note: {note}"));
        }
        let written = generator::write(&scene, &output, overwrite, |_| {})?;
        Ok((written.views, written.points))
    })
}

/// Lays options over defaults, also within the group of points.
fn overlay(
    mut defaults: serde_json::Value,
    given: serde_json::Map<String, serde_json::Value>,
) -> Result<serde_json::Value, Failure> {
    for (name, value) in given {
        let Some(known) = defaults.get_mut(&name) else {
            let names =
                defaults.as_object().into_iter().flat_map(|all| all.keys().map(String::as_str));
            let nearest = densify_policies::parameters::nearest(&name, names);
            let hint =
                nearest.map_or_else(String::new, |name| format!(" (did you mean `{name}`?)"));
            return Err(Failure::input(format!("scenegen has no option `{name}`{hint}")));
        };
        *known = match value {
            serde_json::Value::Object(members) if known.is_object() => {
                overlay(known.take(), members)?
            }
            value => value,
        };
    }
    Ok(defaults)
}

/// Parses a number of bytes: "512MiB".
#[pyfunction]
pub(crate) fn parse_bytes(text: &str) -> PyResult<u64> {
    numbers::bytes(text).map_err(PyValueError::new_err)
}

/// Compares policies; returns the summary and the file of the report.
#[pyfunction]
#[pyo3(signature = (scenes, policies, budgets, memory, options, *, seeds, until_decided, max_seeds, hours, iterations, output, listener, stop))]
#[expect(clippy::too_many_arguments, reason = "keyword arguments")]
pub(crate) fn compare(
    py: Python<'_>,
    scenes: Vec<PathBuf>,
    policies: Vec<String>,
    budgets: Vec<(Option<String>, usize)>,
    memory: Vec<(Option<String>, u64)>,
    options: &str,
    seeds: u32,
    until_decided: Option<&str>,
    max_seeds: u32,
    hours: Option<f64>,
    iterations: u32,
    output: PathBuf,
    listener: &Bound<'_, PyAny>,
    stop: &Bound<'_, Stop>,
) -> PyResult<(String, PathBuf)> {
    let until_decided = match until_decided {
        Some("scenes") => Some(Decide::Scenes),
        Some("mean") => Some(Decide::Mean),
        Some(other) => {
            let message = format!("until_decided: `{other}` is neither \"scenes\" nor \"mean\"");
            return Err(PyValueError::new_err(message));
        }
        None => None,
    };
    Listener::new(Some(listener), Some(stop))?.follow(py, move |follower| {
        let within = |range: std::ops::RangeInclusive<u32>, name: &str, value: u32| {
            if range.contains(&value) {
                return Ok(());
            }
            Err(Failure::input(format!(
                "{name}= must be from {} to {}",
                range.start(),
                range.end()
            )))
        };
        within(1..=1000, "seeds", seeds)?;
        within(3..=12, "max_seeds", max_seeds)?;
        within(1..=u32::MAX, "iterations", iterations)?;
        let has_limit = !budgets.is_empty() || !memory.is_empty();
        if scenes.is_empty() || policies.is_empty() || !has_limit {
            return Err(Failure::input(
                "name at least one scene, one policy, and one budget or memory",
            ));
        }
        let rows = |(scene, rows)| SceneLimit { scene, limit: Limit::Rows(rows) };
        let bytes = |(scene, bytes)| SceneLimit { scene, limit: Limit::Memory(bytes) };
        let comparison = Comparison {
            scenes,
            policies,
            budget: budgets.into_iter().map(rows).collect(),
            memory: memory.into_iter().map(bytes).collect(),
            seeds,
            until_decided,
            max_seeds,
            iterations,
            output,
            train: Vec::new(),
            engine: EngineArgs { hours, ..EngineArgs::default() },
        };
        let finished = comparison.run(options::partial(options)?, follower)?;
        let finished = finished.ok_or_else(|| Failure::input("the comparison is not finished"))?;
        Ok((finished.summary, finished.report))
    })
}

/// Writes the report on runs as one HTML file.
#[pyfunction]
#[pyo3(signature = (runs, output, options, *, iteration, overwrite, listener))]
pub(crate) fn report(
    py: Python<'_>,
    runs: Vec<PathBuf>,
    output: PathBuf,
    options: &str,
    iteration: Option<u32>,
    overwrite: bool,
    listener: &Bound<'_, PyAny>,
) -> PyResult<()> {
    Listener::new(Some(listener), None)?.follow(py, move |follower| {
        let spec = options::spec(options)?;
        options::check_output(&output, overwrite)?;
        let options = ReportOptions {
            runs: &runs,
            iteration,
            dataset: spec.start.scene.as_deref(),
            device: &spec.device,
        };
        densify_report::write(&options, &output, follower)
    })
}

/// A size to reach: a number of Gaussians, or the bytes of a file.
#[pyfunction]
pub(crate) fn parse_target(text: &str) -> PyResult<(Option<usize>, Option<u64>)> {
    let wrong = |error: String| {
        PyValueError::new_err(format!(
            "to: {error}; give a size such as \"5MiB\", or a number of Gaussians such as \"20k\""
        ))
    };
    if text.trim_end().ends_with(['b', 'B']) {
        return Ok((None, Some(numbers::bytes(text).map_err(wrong)?)));
    }
    Ok((Some(numbers::rows(text).map_err(wrong)?), None))
}

/// A number of rows, such as "5k".
#[pyfunction]
pub(crate) fn parse_rows(text: &str) -> PyResult<usize> {
    numbers::rows(text).map_err(|error| PyValueError::new_err(format!("budget: {error}")))
}
