//! Trains a cleaned model further, without growth.

use densify_core::gaussians::Gaussians;
use densify_core::numbers::gaussians;
use densify_run::Observer;
use densify_run::failure::Failure;
use densify_run::refining::{Refinement, scratch_beside};

use super::Options;

/// Trains all Gaussians of a model.
///
/// # Errors
/// Errors of a run, and when the observer interrupts.
pub(super) fn train(
    model: Gaussians,
    options: &Options<'_>,
    observer: &dyn Observer,
) -> Result<Gaussians, Failure> {
    let refinement = Refinement {
        device: &options.device,
        rows: model.len(),
        iterations: options.refine,
        seed: options.seed,
        freezes_bands: false,
    };
    let (rows, iterations) = (gaussians(model.len()), options.refine);
    observer.say(format_args!("training {rows} for {iterations} iterations"));
    options.model.train(model, &refinement, &scratch_beside(options.output)?, observer)
}
