//! Sizes of the models that a run starts from, and the memory that reading them takes.

use std::path::Path;

use super::case::Case;
use super::config::ModelSize;
use super::fit::RunSize;
use crate::failure::{Failure, ModelProblem};
use crate::models::{is_model, iteration_so_far, read_model};
use crate::observer::Observer;
use crate::spec::AbsolutePath;
use densify_core::gaussians::{Gaussians, sh_coefficients};
use densify_core::memory::{Ledger, Section};
use densify_render::{MomentStorage, Setup, Storage};
use densify_train::importance::needs;
use densify_train::output::{CONFIG_FILE, model_path, saved_iterations};

/// Pairs per row while importance is measured; views with more are rendered in bands.
const PAIRS_PER_ROW: usize = 3;

/// The file of the model that an option names: for the folder of a run, its last model.
///
/// # Errors
/// When the run has saved no model. Names the option.
pub(super) fn file_of(
    option: &'static str,
    named: &AbsolutePath,
    observer: &dyn Observer,
) -> Result<AbsolutePath, Failure> {
    let AbsolutePath(path) = named;
    let is_run = path.join(CONFIG_FILE).is_file() || saved_iterations(path).is_ok();
    if is_model(path) || !is_run {
        return Ok(named.clone());
    }
    let iteration = iteration_so_far(path, None, observer);
    let (iteration, _) = iteration.map_err(|failure| failure.within_option(option, None))?;
    Ok(AbsolutePath(model_path(path, iteration)))
}

/// The size of the model in a file. Reads the whole file, so that damage is found before anything is decided.
///
/// # Errors
/// When the file holds no model, or one without rows. Names the option.
pub(super) fn size_of_model(
    option: &'static str,
    file: &Path,
    observer: &dyn Observer,
) -> Result<ModelSize, Failure> {
    let model = read(option, file, observer)?;
    if model.is_empty() {
        return Err(ModelProblem::EmptyModel { option, file: file.to_owned() }.into());
    }
    let (rows, sh_degree) = (model.len(), model.sh_degree);
    Ok(ModelSize { rows, sh_degree, antialiasing: model.antialiasing })
}

/// Reads the model that an option names; errors name the option.
pub(crate) fn read(
    option: &'static str,
    file: &Path,
    observer: &dyn Observer,
) -> Result<Gaussians, Failure> {
    read_model(file, observer).map_err(|failure| failure.within_option(option, None))
}

/// Bytes of a model's rows in memory, at the degree of its file.
fn bytes_of(model: ModelSize) -> u64 {
    (model.rows * size_of::<f32>() * (11 + 3 * sh_coefficients(model.sh_degree))) as u64
}

/// Bytes for reading a model into growing arrays.
pub(super) fn reading_bytes(model: ModelSize) -> u64 {
    3 * bytes_of(model)
}

/// Adds the memory for the model of `--init` before training.
pub(super) fn add_first_model(
    ledger: &mut Ledger,
    model: ModelSize,
    case: &Case<'_>,
    size: &RunSize,
    threads: usize,
) {
    let bytes = first_bytes(model, case, size, threads);
    ledger.add_to(Section::Before, "the model it starts from", bytes);
    let bytes = first_bytes_on_device(model, case, size, threads);
    if bytes > 0 {
        ledger.add_on_device(Section::Before, "importance of its rows", bytes);
    }
}

/// Peak bytes for the model of `--init` before training: while it is read, or, if it exceeds the budget, while its
/// importance is measured.
fn first_bytes(model: ModelSize, case: &Case<'_>, size: &RunSize, threads: usize) -> u64 {
    let reading = reading_bytes(model);
    if model.rows <= case.budget(size.rows).trainable() {
        return reading;
    }
    let backend = importance_ledger(model, case, size, threads).on_host();
    let [train, _] = case.inputs.images;
    let image = train.held(0) + train.decoding(1);
    // While importance is measured, the model and its copy in the backend exist; the rows that are then kept take less
    // than that copy.
    reading.max(bytes_of(model) + backend + image + densify_train::importance::bytes(model.rows))
}

/// The memory of the backend that measures the importance of a model.
fn importance_ledger(model: ModelSize, case: &Case<'_>, size: &RunSize, threads: usize) -> Ledger {
    let setup = importance_setup(model.rows, case, size);
    case.inputs.device.memory_plan(model.sh_degree, &setup, threads)
}

/// Bytes on the device while the importance of the model of `--init` is measured; 0 if it is within the budget.
fn first_bytes_on_device(model: ModelSize, case: &Case<'_>, size: &RunSize, threads: usize) -> u64 {
    if model.rows <= case.budget(size.rows).trainable() {
        return 0;
    }
    importance_ledger(model, case, size, threads).on_device()
}

/// The setup of the backend that measures the importance of this many rows.
pub(crate) fn importance_setup(rows: usize, case: &Case<'_>, size: &RunSize) -> Setup {
    let needs = needs();
    let pairs =
        rows.saturating_mul(PAIRS_PER_ROW).min(case.inputs.device.most_pairs(&needs, false));
    Setup {
        budget: rows.into(),
        tile_cap: Some(pairs.max(rows)),
        // No gradient is computed, and moments are unused.
        record_cap: rows,
        storage: Storage { moments: MomentStorage::Both8, ..Storage::default() },
        depth: false,
        ..case.backend_setup(size, needs)
    }
}
