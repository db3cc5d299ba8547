//! The Python package `densify`: the Rust part of it. The Python part is in `densify/`, whose `_densify.pyi` declares
//! what this module exports.
//!
//! Modules from bottom to top: errors, options, arrays, follow, camera, tools, model, training, opened, page, policy.

mod arrays;
mod camera;
mod errors;
mod follow;
mod model;
mod opened;
mod options;
mod page;
mod policy;
mod tools;
mod training;

use std::path::{Path, PathBuf};

use densify_data::dataset::builtin;
use densify_run::failure::Failure;
use densify_run::{OPTIONS, OnResume, RunConfig};
use densify_train::pictures::write_png;
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;

/// Tells densify how to start itself in another process, which file holds its code, and how to import policies.
#[pyfunction]
fn initialise(program: Vec<String>, file: PathBuf) {
    densify_launch::set_program(program);
    builtin::set_program_file(file);
    policy::set_importer();
}

/// Runs a command line that begins with the program's name; returns the exit code.
#[pyfunction]
fn main(py: Python<'_>, arguments: Vec<String>) -> u8 {
    py.detach(|| densify_cli::run_with(arguments))
}

/// Names of all options of a run, and whether a resumed run may change them.
#[pyfunction]
fn option_names() -> Vec<(&'static str, bool)> {
    OPTIONS.iter().map(|option| (option.name, option.on_resume != OnResume::Fixed)).collect()
}

/// Names and summaries of the built-in scenes.
#[pyfunction]
fn builtin_scenes() -> Vec<(&'static str, &'static str)> {
    densify_scenegen::PRESETS.iter().map(|preset| (preset.name, preset.summary)).collect()
}

/// The configuration of a run as JSON.
#[pyfunction]
fn run_config(py: Python<'_>, folder: PathBuf) -> PyResult<String> {
    errors::detached(py, || {
        let table = RunConfig::read(&folder)?.table()?;
        serde_json::to_string(&table).map_err(Failure::input)
    })
}

/// Writes 8-bit pixels as a PNG file. Shape: [height, width, 3] or [height, width, 4].
#[pyfunction]
fn write_image(
    py: Python<'_>,
    path: PathBuf,
    pixels: numpy::PyReadonlyArray3<'_, u8>,
) -> PyResult<()> {
    use numpy::PyUntypedArrayMethods;
    let shape = pixels.shape().to_vec();
    let side = |side: usize| u32::try_from(side).ok().filter(|side| (1..=65_535).contains(side));
    let (Some(height), Some(width), 3 | 4) = (side(shape[0]), side(shape[1]), shape[2]) else {
        return Err(PyValueError::new_err(format!(
            "image: expected an array of shape [height, width, 3] or [height, width, 4], found {shape:?}"
        )));
    };
    let bytes = pixels.as_slice()?.to_vec();
    errors::detached(py, || {
        let picture = if shape[2] == 4 {
            image::RgbaImage::from_raw(width, height, bytes).map(image::DynamicImage::from)
        } else {
            image::RgbImage::from_raw(width, height, bytes).map(image::DynamicImage::from)
        };
        let picture =
            picture.ok_or_else(|| Failure::input("image: the pixels do not fit the shape"))?;
        Ok(write_png(Path::new(&path), &picture)?)
    })
}

/// The Rust part of densify.
#[pymodule(gil_used = false)]
mod _densify {
    #[pymodule_export]
    use super::follow::Stop;
    #[pymodule_export]
    use super::model::Model;
    #[pymodule_export]
    use super::opened::{OpenedModel, open_model};
    #[pymodule_export]
    use super::page::{PageCore, serve};
    #[pymodule_export]
    use super::policy::{
        Now, Plan, Points, Rng, SceneView, View, check_policy, columns, largest, mean_over_views,
        policies, quantile, register, signals, smallest, spare_one, top_k,
    };
    #[pymodule_export]
    use super::tools::{
        compare, compress, parse_bytes, parse_rows, parse_target, plan, report, scenegen,
    };
    #[pymodule_export]
    use super::training::{TrainerCore, prepare, train};
    #[pymodule_export]
    use super::{builtin_scenes, initialise, main, option_names, run_config, write_image};

    /// Version of densify.
    #[pymodule_export]
    #[expect(non_upper_case_globals, reason = "the name that Python gives it")]
    const __version__: &str = env!("CARGO_PKG_VERSION");
}
