//! Prunes a model in stages and trains the remaining Gaussians.

use std::path::Path;

use super::colour::reduce;
use super::{Options, Target, fit};
use densify_core::files::write_atomically;
use densify_core::gaussians::Gaussians;
use densify_core::numbers::gaussians;
use densify_data::models::{Coordinates, Format, PLY};
use densify_run::failure::Failure;
use densify_run::finished::read_model;
use densify_run::{
    AbsolutePath, Assignment, Budget, InitChoice, Observer, Run, RunSpec, ShDegree, Silent, Whole,
};
use densify_train::exposure::ExposureChoice;

/// With the settings below, this policy neither adds nor prunes rows.
const POLICY: &str = "vanilla";
const POLICY_SETTINGS: [&str; 3] =
    ["vanilla.grow_every=0", "vanilla.reset_every=0", "vanilla.white_reset_at=0"];

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
        let setting = (budget, iterations - adaptation_steps);
        model = train(model, setting, false, options, scratch, observer)?;
        if adaptation_steps > 0 {
            model = reduce(model, u8::MAX); // Keeps the degree.
            write_atomically(scratch, |out| format.write(&model, out))?;
            let origin = model.origin;
            // The temporary file has no sidecar.
            model = Gaussians { origin, ..read_model(scratch, &Silent)? };
            let setting = (model.len(), adaptation_steps);
            model = train(model, setting, true, options, scratch, observer)?;
        }
    }
    Ok(model)
}

/// Trains the model with a budget and a number of iterations.
fn train(
    model: Gaussians,
    setting: (usize, u32),
    freezes_sh: bool,
    options: &Options<'_>,
    scratch: &Path,
    observer: &dyn Observer,
) -> Result<Gaussians, Failure> {
    write_atomically(scratch, |out| PLY.write(&model, out))?;
    let mut spec = describe_run(&model, setting, options, scratch)?;
    if freezes_sh {
        spec.schedule.lr = vec![assignment("sh_rest=0")?];
    }
    let origin = model.origin;
    spec.output.coordinates =
        if model.is_local() { Coordinates::Local } else { Coordinates::World };
    drop(model);
    let tuned = Run::prepare(&spec)?.model_after_training(observer)?;
    Ok(tuned.with_origin(origin))
}

fn assignment(text: &str) -> Result<Assignment, Failure> {
    text.parse().map_err(Failure::input)
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

/// Describes the run of a stage.
pub(super) fn describe_run(
    model: &Gaussians,
    (budget, iterations): (usize, u32),
    options: &Options<'_>,
    scratch: &Path,
) -> Result<RunSpec, Failure> {
    let mut spec =
        RunSpec { data: options.data.clone(), depth: options.depth.clone(), ..RunSpec::default() };
    spec.device = options.device.clone();
    spec.start.scene = Some(options.scene.to_owned());
    let file = std::path::absolute(scratch).map_err(Failure::input)?;
    spec.start.init = Some(InitChoice::Model(AbsolutePath(file)));
    spec.start.near = options.near;
    spec.size.budget = Some(Budget::Rows(budget));
    spec.size.sh_degree = Some(ShDegree::Fixed(model.sh_degree));
    POLICY.clone_into(&mut spec.density.policy);
    spec.density.policy_set =
        POLICY_SETTINGS.into_iter().map(assignment).collect::<Result<_, _>>()?;
    spec.schedule.iterations = Whole(iterations);
    spec.schedule.seed = options.seed;
    if let Some(exposure_model) = options.exposure {
        spec.schedule.exposure = ExposureChoice::On;
        spec.schedule.exposure_model = exposure_model;
    }
    Ok(spec)
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
