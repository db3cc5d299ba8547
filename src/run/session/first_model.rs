//! The model that a run starts from, in normalised scene coordinates.

use std::path::Path;

use glam::DVec3;
use rayon::prelude::*;

use crate::coordinate_check::CoordinateCheck;
use crate::failure::{Failure, ModelProblem, OptionProblem, notes};
use crate::finished::views_of;
use crate::models::override_antialiasing;
use crate::observer::{Observer, Silent};
use crate::resolved::{Init, ResolvedRun, importance_setup, random_points, read};
use crate::spec::AbsolutePath;
use densify_core::gaussians::Gaussians;
use densify_core::numbers::{gaussians, grouped};
use densify_data::dataset::Dataset;
use densify_data::dataset::normalise::EXTENT;
use densify_render::Backend;
use densify_train::evaluate::Split;
use densify_train::importance::{importance, largest};
use densify_train::init::initialise;

/// Minimum share of a model's Gaussians that must lie in training views; below it, the model counts as being in other
/// coordinates.
const LEAST_IN_VIEW: f64 = 0.1;
/// Depth `[extents of the scene]` beyond which nothing counts as in view, because far away every point is in front of
/// some camera.
const FARTHEST: f64 = 100.0;

/// The model that a new run starts from, without frozen rows.
///
/// # Errors
/// When a model cannot be read or rendered, or no point is usable.
pub(super) fn first_model(
    run: &ResolvedRun<'_>,
    observer: &dyn Observer,
) -> Result<Gaussians, Failure> {
    let ResolvedRun { case, size, init, .. } = run;
    let room = case.budget(size.rows).trainable();
    let given = case.spec.start.init_points;
    if let Some(points) = given.filter(|_| !matches!(init, Init::Random(_))) {
        return Err(OptionProblem::UnusedInitPoints { points: points.0 }.into());
    }
    let (dataset, seed) = (&case.inputs.dataset, case.spec.schedule.seed);
    let random;
    let (points, source) = match init {
        Init::Model(file) => return load(&file.0, run, observer),
        Init::Points => (&dataset.points, "points of the scene"),
        Init::Random(count) => {
            random = random_points(case, *count);
            (&random, "random points")
        }
    };
    let (model, report) = initialise(points, room, size.sh_degree, seed)?;
    for (number, reason) in [
        (report.unusable, "non-finite points ignored"),
        (report.duplicates, "duplicate points ignored"),
        (report.over_budget, "points beyond the budget left out at random"),
    ] {
        if number > 0 {
            observer.say(format_args!("note: {} {reason}", grouped(number)));
        }
    }
    observer.say(format_args!(
        "start    {} from {} {source}",
        gaussians(model.len()),
        grouped(report.points)
    ));
    Ok(model)
}

/// The model of `--init`, converted to the degree of the run and reduced to its budget.
///
/// # Errors
/// When the file cannot be read, the device fails, or too little of the model lies in the training views.
fn load(file: &Path, run: &ResolvedRun<'_>, observer: &dyn Observer) -> Result<Gaussians, Failure> {
    let ResolvedRun { case, size, .. } = run;
    let dataset = &case.inputs.dataset;
    // Problems with the file were reported when its size was read.
    let model = read("init", file, &Silent)?;
    let mut model = dataset.normalisation.model_from_world(model);
    override_antialiasing(&mut model, run.case.choices.antialiasing, file, observer);
    let seen = in_view(&model, dataset);
    if (seen as f64) < LEAST_IN_VIEW * model.len() as f64 {
        let (file, rows) = (file.to_owned(), model.len());
        return Err(ModelProblem::InitOutOfView { file, seen, rows }.into());
    }
    let (whole, room) = (model.len(), case.budget(size.rows).trainable());
    if whole > room {
        let views = views_of(dataset, Split::Train)?;
        let setup = importance_setup(whole, case, size);
        let mut backend = case.inputs.device.backend(&model, &setup)?;
        let background = case.spec.data.background.fixed();
        let importance = importance(backend.as_mut(), &views, background, model.sh_degree)?;
        drop(backend);
        model = model.gather(&largest(&importance, room));
    }
    observer.say(format_args!("start    {} of {}", gaussians(whole), file.display()));
    if whole > room {
        observer.say(format_args!(
            "note: {} beyond the budget left out: those with the least blend weight in the training views",
            gaussians(whole - room)
        ));
    }
    Ok(with_degree(model, size.sh_degree, observer))
}

/// Truncates colours to a lower degree, with a note, or extends them to a higher one.
fn with_degree(model: Gaussians, degree: u8, observer: &dyn Observer) -> Gaussians {
    let own = model.sh_degree;
    if own > degree {
        observer.say(format_args!("{}", notes::degree_cut(observer.spelling(), own, degree)));
    }
    model.with_degree(degree)
}

/// Appends `others` to the model of `--freeze`, if there is one.
///
/// # Errors
/// When the file cannot be read or has changed, or its model lies in no training view.
pub(super) fn append_to_frozen(
    run: &ResolvedRun<'_>,
    others: Gaussians,
    observer: &dyn Observer,
) -> Result<Gaussians, Failure> {
    let ResolvedRun { case, size, .. } = run;
    let Some(AbsolutePath(file)) = &case.inputs.frozen_file else {
        return Ok(others);
    };
    let model = read("freeze", file, &Silent)?;
    let mut model = case.inputs.dataset.normalisation.model_from_world(model);
    override_antialiasing(&mut model, run.case.choices.antialiasing, file, observer);
    let (rows, expected) = (model.len(), case.budget(size.rows).frozen);
    if rows != expected {
        let file = file.clone();
        return Err(ModelProblem::FreezeChanged { file, rows, expected }.into());
    }
    if in_view(&model, &case.inputs.dataset) == 0 {
        return Err(ModelProblem::FreezeOutOfView { file: file.clone(), rows }.into());
    }
    observer.say(format_args!("frozen   {} of {}", gaussians(rows), file.display()));
    model = with_degree(model, size.sh_degree, observer);
    model.append(others);
    Ok(model)
}

/// The number of rows with their centre in a training view.
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

/// Fails if the model of `--init` is in other coordinates than the dataset. If there are frozen Gaussians, the model
/// may be a small part of the scene, so the user is only told.
///
/// # Errors
/// When the model is in other coordinates, or a view cannot be read or rendered.
pub(super) fn check_coordinates(
    file: &Path,
    run: &ResolvedRun<'_>,
    backend: &mut dyn Backend,
    observer: &dyn Observer,
) -> Result<(), Failure> {
    let ResolvedRun { case, size, .. } = run;
    let views = views_of(&case.inputs.dataset, Split::Train)?;
    let shown = (case.spec.data.background.fixed(), size.sh_degree);
    let check = CoordinateCheck::measure(backend, &views, shown)?;
    if case.inputs.frozen_model.is_some() {
        check.note(Some("init"), file, observer);
        return Ok(());
    }
    check.require(Some("init"), file, observer)
}
