//! Prunes a model in stages and trains the remaining Gaussians.

use std::path::Path;

use super::colour::reduce;
use super::{Options, Target, fit};
use densify_core::files::write_atomically;
use densify_core::gaussians::Gaussians;
use densify_core::numbers::gaussians;
use densify_data::models::Format;
use densify_run::failure::Failure;
use densify_run::finished::read_model;
use densify_run::refining::Refinement;
use densify_run::{Observer, Silent};

/// Prunes the model to about its `rows` most important rows, and trains them. Training changes the compression ratio,
/// so the number of rows that fit is estimated again before the last stage. If the format is lossy, the second half of
/// the last stage starts from the decoded file and freezes the view-dependent colour, which is quantised most, so that
/// the other parameters compensate its errors. `after_stage` receives the model after each stage but the last.
///
/// # Errors
/// Errors of a run, and when the observer interrupts.
pub(super) fn tune(
    mut model: Gaussians,
    (format, rows): (&Format, usize),
    options: &Options<'_>,
    scratch: &Path,
    observer: &dyn Observer,
    after_stage: &mut dyn FnMut(&Gaussians) -> Result<(), Failure>,
) -> Result<Gaussians, Failure> {
    let least_stages = if matches!(options.to, Target::Bytes(_)) { 2 } else { 1 };
    let stages = stages((model.len(), rows), options.iterations, least_stages);
    for (stage, &(mut budget, iterations)) in stages.iter().enumerate() {
        if stage > 0 {
            after_stage(&model)?;
        }
        if stage > 0 && stage + 1 == stages.len() {
            model = reduce(model, u8::MAX); // Keeps the degree.
            budget = fit::rows_that_fit(options.to, format, &model)?.unwrap_or(1);
        }
        observer.say(format_args!(
            "training {} of degree {} for {iterations} iterations (stage {} of {})",
            gaussians(budget),
            model.sh_degree,
            stage + 1,
            stages.len()
        ));
        let is_last = stage + 1 == stages.len();
        let adaptation_steps = if format.is_lossy() && is_last { iterations / 2 } else { 0 };
        let refinement = Refinement {
            device: &options.device,
            rows: budget,
            iterations: iterations - adaptation_steps,
            seed: options.seed,
            freezes_bands: false,
        };
        model = options.model.train(model, &refinement, scratch, observer)?;
        if adaptation_steps > 0 {
            model = reduce(model, u8::MAX); // Keeps the degree.
            write_atomically(scratch, |out| format.write(&model, out))?;
            let origin = model.origin;
            // The temporary file has no sidecar.
            model = Gaussians { origin, ..read_model(scratch, &Silent)? };
            let refinement = Refinement {
                rows: model.len(),
                iterations: adaptation_steps,
                freezes_bands: true,
                ..refinement
            };
            model = options.model.train(model, &refinement, scratch, observer)?;
        }
    }
    Ok(model)
}

/// The budget and the iterations of each stage. There are at least `least_stages` stages, each budget is at least half
/// of the one before, and the last stage is twice as long as the others.
fn stages((whole, rows): (usize, usize), iterations: u32, least_stages: u32) -> Vec<(usize, u32)> {
    let ratio = whole as f64 / rows.max(1) as f64;
    let count = (ratio.log2().ceil() as u32).max(least_stages).min(iterations);
    let share = iterations / (count + 1);
    let stage = |number: u32| {
        if number == count {
            return (rows, iterations - share * (count - 1));
        }
        ((whole as f64 / ratio.powf(f64::from(number) / f64::from(count))) as usize, share)
    };
    (1..=count).map(stage).filter(|(_, steps)| *steps > 0).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_stage_prunes_more_than_half() {
        assert_eq!(stages((1_000, 1_000), 300, 1), [(1_000, 300)]);
        assert_eq!(stages((1_000, 640), 300, 1), [(640, 300)]);
        assert_eq!(stages((1_000, 640), 300, 2), [(800, 100), (640, 200)]);
        assert_eq!(stages((1_000, 250), 300, 1), [(500, 100), (250, 200)]);
        for (whole, rows, iterations) in [(90_000, 1_000, 2_000), (7, 3, 10), (8, 1, 4), (5, 1, 1)]
        {
            let stages = stages((whole, rows), iterations, 1);
            assert_eq!(stages.last().map(|stage| stage.0), Some(rows));
            assert_eq!(stages.iter().map(|stage| stage.1).sum::<u32>(), iterations);
            let bounds = [whole].into_iter().chain(stages.iter().map(|stage| stage.0));
            let bounds: Vec<usize> = bounds.collect();
            assert!(
                iterations < 3 || bounds.windows(2).all(|w| w[0] <= 2 * w[1] + 1),
                "{bounds:?}"
            );
        }
    }
}
