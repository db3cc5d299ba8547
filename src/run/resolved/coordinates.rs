//! Tells the user before training if f32 will be too coarse for the world coordinates of the Gaussians.

use super::case::{Case, Init};
use super::models::read;
use crate::failure::notes;
use crate::observer::Silent;
use densify_core::spelling::Spelling;
use densify_data::dataset::PointCloud;
use densify_data::models::{Coarseness, Coordinates};
use densify_train::init;

/// Size of a trained Gaussian relative to its size if as many Gaussians were spread evenly over the same surfaces.
const TRAINED_SIZE: f64 = 0.5;
/// Maximum number of points from which sizes are estimated; more points would not change the estimate much.
const MOST_POINTS: usize = 200_000;

/// Random points that the training views see, for a run that starts from random points.
pub(crate) fn random_points(case: &Case<'_>, count: usize) -> PointCloud {
    let train = &case.inputs.dataset.train;
    let cameras: Vec<_> = train.iter().map(|view| view.camera).collect();
    let is_opaque = !train.iter().any(|view| view.source.header.has_alpha);
    init::random_points(count, &cameras, is_opaque, case.spec.schedule.seed)
}

/// A line about the coordinates of saved models; `None` if f32 is fine enough for world coordinates. A model
/// that cannot be read is reported elsewhere.
pub(super) fn line(
    case: &Case<'_>,
    budget: usize,
    init: &Init,
    spelling: Spelling,
) -> Option<String> {
    let to_world = &case.inputs.dataset.normalisation;
    let coordinates = case.spec.output.coordinates;
    if !to_world.is_remote() || matches!(coordinates, Coordinates::Local | Coordinates::Double) {
        return None;
    }
    let random;
    let points = match init {
        Init::Model(file) => Err(file),
        Init::Points => Ok(&case.inputs.dataset.points),
        Init::Random(count) => {
            random = random_points(case, (*count).min(MOST_POINTS));
            Ok(&random)
        }
    };
    let mut coarseness = Coarseness::default();
    let origin = to_world.local_origin();
    let world = match points {
        Err(file) => read("init", &file.0, &Silent).ok()?,
        Ok(points) => {
            let (mut model, _) = init::initialise(points, MOST_POINTS, 0, 0).ok()?;
            // As many Gaussians as the budget allows share the surfaces that the points lie on.
            let share = (model.len() as f64 / budget.max(1) as f64).min(1.0).sqrt();
            let smaller = (TRAINED_SIZE * share).ln() as f32;
            model.log_scales.as_flattened_mut().iter_mut().for_each(|log| *log += smaller);
            to_world.world_from_model(model, origin)
        }
    };
    coarseness.add(&world, to_world.centre.to_array(), 1.0 / to_world.scale);
    let is_automatic = coordinates == Coordinates::Auto;
    coarseness
        .is_noted()
        .then(|| notes::expected_coarse(spelling, &coarseness, origin, is_automatic))
}
