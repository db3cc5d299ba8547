//! The model that a run starts from.

mod model;

pub(super) use model::{
    behind_frozen, first_bytes, reading_bytes, require_likeness, size_of_model,
};

use super::observer::Observer;
use super::resolve::{Inputs, ignored, random_count};
use super::values::InitChoice;
use crate::failure::Failure;
use crate::memory::RunSize;
use densify_core::gaussians::Gaussians;
use densify_core::numbers::grouped;
use densify_train::init::{initialise, random_points};

/// A model in the coordinates of training, and how it was made.
pub(super) struct Start {
    pub(super) model: Gaussians,
    pub(super) init: InitChoice,
    /// Random points that were drawn for it.
    pub(super) points: Option<usize>,
}

/// The model that a new run starts from, without frozen rows.
pub(super) fn first_model(
    inputs: &Inputs<'_>,
    setting: &RunSize,
    observer: &dyn Observer,
) -> Result<Start, Failure> {
    let (init, given) = (inputs.init(), inputs.spec.start.init_points);
    let room = setting.rows - inputs.frozen_rows();
    if let Some(points) = given.filter(|_| init != InitChoice::Random) {
        return Err(Failure::input(format!(
            "--init-points {}: it is for a random start; leave it out, or use --init random",
            points.0
        )));
    }
    let (dataset, seed) = (&inputs.dataset, inputs.spec.schedule.seed);
    let random;
    let (points, count) = match &init {
        InitChoice::Model(file) => {
            let model = model::load(&file.0, inputs, setting, observer)?;
            return Ok(Start { model, init, points: None });
        }
        InitChoice::Points => (&dataset.points, None),
        InitChoice::Random => {
            let count = given.map_or_else(|| random_count(room), |points| points.0);
            let cameras: Vec<_> = dataset.train.iter().map(|view| view.camera).collect();
            let opaque = !dataset.train.iter().any(|view| view.source.header.has_alpha);
            random = random_points(count, &cameras, opaque, seed);
            (&random, Some(count))
        }
    };
    let (model, report) = initialise(points, room, setting.sh_degree, seed)?;
    for (number, reason) in [
        (report.unusable, "non-finite points ignored"),
        (report.duplicates, "duplicate points ignored"),
        (report.over_budget, "points beyond the budget left out, drawn by the seed"),
    ] {
        if number > 0 {
            observer.say(format_args!("{}", ignored(number, reason)));
        }
    }
    let source = if count.is_some() { "random points" } else { "points of the scene" };
    observer.say(format_args!(
        "start    {} Gaussians from {} {source}",
        grouped(model.len()),
        grouped(report.points)
    ));
    Ok(Start { model, init, points: count })
}
