//! A start from a model that there is already, by whatever program.

use std::path::Path;

use glam::DVec3;
use rayon::prelude::*;

use crate::config::ModelSize;
use crate::failure::Failure;
use crate::finished::{model_file, read_model, views_of};
use crate::likeness::Likeness;
use crate::memory::RunSize;
use crate::observer::{Observer, Silent};
use crate::resolve::Inputs;
use crate::values::AbsolutePath;
use densify_core::gaussians::{Gaussians, sh_coefficients};
use densify_core::numbers::grouped;
use densify_data::dataset::Dataset;
use densify_data::dataset::normalise::EXTENT;
use densify_render::{Backend, MomentStorage, Setup, Storage};
use densify_train::evaluate::Split;
use densify_train::importance::{importance, largest, needs};

/// A model of which fewer Gaussians than this share lie in any training view is in other coordinates.
const LEAST_IN_VIEW: f64 = 0.1;
/// Extents of the scene beyond which nothing is counted as in view: some camera looks at whatever is far away.
const FARTHEST: f64 = 100.0;
/// Pairs per row while importance is measured; views with more are rendered in bands.
const PAIRS_PER_ROW: usize = 3;

/// How large the model of a file is. Reads it, to be sure that it is sound before anything is decided.
///
/// # Errors
/// When it is no model, or has no row. Names the flag.
pub(crate) fn size_of_model(
    flag: &str,
    file: &Path,
    observer: &dyn Observer,
) -> Result<ModelSize, Failure> {
    let model = read(flag, file, observer)?;
    if model.is_empty() {
        return Err(Failure::input(format!(
            "{flag} {}: the model has no Gaussian; give another one, or leave {flag} out",
            file.display()
        )));
    }
    Ok(ModelSize { rows: model.len(), sh_degree: model.sh_degree })
}

fn read(flag: &str, file: &Path, observer: &dyn Observer) -> Result<Gaussians, Failure> {
    read_model(file, observer).map_err(|failure| {
        let failure = Failure { message: format!("{flag}: {}", failure.message), ..failure };
        match model_file(file, None) {
            // The folder of a run.
            Ok(model) if model != file => failure.and(&format!("its model is {}", model.display())),
            _ => failure,
        }
    })
}

/// Bytes of a model's rows as they are read.
fn bytes_of(model: ModelSize) -> u64 {
    (model.rows * size_of::<f32>() * (11 + 3 * sh_coefficients(model.sh_degree))) as u64
}

/// Bytes that reading a model takes, into arrays that grow.
pub(crate) fn reading_bytes(model: ModelSize) -> u64 {
    3 * bytes_of(model)
}

/// Bytes that the model of `--init` takes before the run has its own rows: as it is read, or while its importance is
/// measured where it exceeds the budget.
pub(crate) fn first_bytes(
    model: ModelSize,
    inputs: &Inputs<'_>,
    setting: &RunSize,
    threads: usize,
) -> u64 {
    let reading = reading_bytes(model);
    if model.rows + inputs.frozen_rows() <= setting.rows {
        return reading;
    }
    let options = to_measure(model.rows, inputs, setting);
    let backend = inputs.device.promise(model.sh_degree, &options, threads).on_host();
    let [train, _] = inputs.images;
    let image = train.held(0) + train.decoding(1);
    // The model beside its copy in the backend, then beside the rows that are kept.
    reading.max(bytes_of(model) + backend + image + densify_train::importance::bytes(model.rows))
}

/// The backend that measures the importance of so many rows.
fn to_measure(rows: usize, inputs: &Inputs<'_>, setting: &RunSize) -> Setup {
    let needs = needs();
    let pairs = rows.saturating_mul(PAIRS_PER_ROW).min(inputs.device.most_pairs(&needs));
    Setup {
        budget: rows,
        frozen: 0,
        tile_cap: Some(pairs.max(rows)),
        // Nothing is differentiated, and no moment matters.
        record_cap: rows,
        storage: Storage { moments: MomentStorage::Both8, ..Storage::default() },
        ..inputs.backend_options(setting, needs)
    }
}

/// The model of `--init` in the coordinates of training, with at most the rows that the run has for it and with its
/// degree.
///
/// # Errors
/// When the file cannot be read, the device fails, or no training view shows the model.
pub(super) fn load(
    file: &Path,
    inputs: &Inputs<'_>,
    setting: &RunSize,
    observer: &dyn Observer,
) -> Result<Gaussians, Failure> {
    let dataset = &inputs.dataset;
    // What is wrong with it was said when it was found.
    let model = read("--init", file, &Silent)?;
    let mut model = dataset.normalisation.model_from_world(model);
    let seen = in_view(&model, dataset);
    if (seen as f64) < LEAST_IN_VIEW * model.len() as f64 {
        return Err(Failure::input(format!(
            "--init {}: only {} of its {} Gaussians lie in any training view; it must be in the coordinates of \
             the dataset: export it untransformed, or transform it back",
            file.display(),
            grouped(seen),
            grouped(model.len())
        )));
    }
    let (whole, room) = (model.len(), setting.rows - inputs.frozen_rows());
    if whole > room {
        let views = views_of(dataset, Split::Train)?;
        let options = to_measure(whole, inputs, setting);
        let mut backend = inputs.device.backend(&model, &options)?;
        let background = inputs.spec.data.background.fixed();
        let importance = importance(backend.as_mut(), &views, background, model.sh_degree)?;
        drop(backend);
        model = model.gather(&largest(&importance, room));
    }
    observer.say(format_args!("start    {} Gaussians of {}", grouped(whole), file.display()));
    if whole > room {
        observer.say(format_args!(
            "note: {} Gaussians beyond the budget left out: those with the least blend weight in the training views",
            grouped(whole - room)
        ));
    }
    Ok(with_degree(model, setting.sh_degree, observer))
}

/// Cuts colours, and says so, or gives them room.
fn with_degree(model: Gaussians, degree: u8, observer: &dyn Observer) -> Gaussians {
    let own = model.sh_degree;
    if own > degree {
        observer.say(format_args!(
            "note: colours of degree {own} are cut to {degree}; --sh-degree {own} keeps them"
        ));
    }
    model.with_degree(degree)
}

/// The model behind that of `--freeze`, if there is one: in the coordinates of training, with the degree of the run.
///
/// # Errors
/// When the file cannot be read, or is not what it was, or no training view shows the model.
pub(crate) fn behind_frozen(
    inputs: &Inputs<'_>,
    sh_degree: u8,
    others: Gaussians,
    observer: &dyn Observer,
) -> Result<Gaussians, Failure> {
    let Some(AbsolutePath(file)) = &inputs.spec.start.freeze else {
        return Ok(others);
    };
    let model = read("--freeze", file, &Silent)?;
    let mut model = inputs.dataset.normalisation.model_from_world(model);
    let (rows, expected) = (model.len(), inputs.frozen_rows());
    if rows != expected {
        return Err(Failure::input(format!(
            "--freeze {}: it has {} Gaussians, but had {} before; begin a new run",
            file.display(),
            grouped(rows),
            grouped(expected)
        )));
    }
    if in_view(&model, &inputs.dataset) == 0 {
        return Err(Failure::input(format!(
            "--freeze {}: none of its {} Gaussians lies in any training view; it must be in the coordinates of the \
             dataset: export it untransformed, or transform it back",
            file.display(),
            grouped(rows)
        )));
    }
    observer.say(format_args!("frozen   {} Gaussians of {}", grouped(rows), file.display()));
    model = with_degree(model, sh_degree, observer);
    model.append(others);
    Ok(model)
}

/// How many rows have their centre in a training view.
fn in_view(model: &Gaussians, dataset: &Dataset) -> usize {
    let shows = |mean: &[f32; 3]| {
        let point = DVec3::from(mean.map(f64::from));
        dataset.train.iter().any(|view| {
            let depth = view.camera.depth_in_image(point, 0.0);
            depth.is_some_and(|depth| depth < FARTHEST * EXTENT)
        })
    };
    model.means.par_iter().filter(|mean| shows(mean)).count()
}

/// Fails where the model of `--init` shows nothing of the photographs, as one in other coordinates does. Beside frozen
/// Gaussians it may be a small part of what is seen: then says so.
///
/// # Errors
/// Then, and when a view cannot be read or rendered.
pub(crate) fn require_likeness(
    file: &Path,
    inputs: &Inputs<'_>,
    backend: &mut dyn Backend,
    shown: ([f32; 3], u8),
    observer: &dyn Observer,
) -> Result<(), Failure> {
    let likeness = Likeness::of(backend, &views_of(&inputs.dataset, Split::Train)?, shown)?;
    let named = format_args!("--init {}", file.display());
    if inputs.frozen.is_some() {
        likeness.note(named, observer);
        return Ok(());
    }
    likeness.require(named, observer)
}
