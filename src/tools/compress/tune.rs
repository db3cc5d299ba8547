//! Prunes a model step by step, and trains what is left.

use std::path::Path;

use super::colour::reduced;
use super::{Options, Target, fit};
use densify_core::files::write_atomically;
use densify_core::gaussians::Gaussians;
use densify_data::models::{Format, PLY};
use densify_run::failure::Failure;
use densify_run::finished::read_model;
use densify_run::{
    AbsolutePath, Assignment, Budget, InitChoice, Observer, Run, RunSpec, ShDegree, Whole,
};
use densify_train::exposure::ExposureChoice;

/// A policy that, set so, neither adds nor prunes.
const POLICY: &str = "vanilla";
const STILL: [&str; 3] =
    ["vanilla.grow_every=0", "vanilla.reset_every=0", "vanilla.white_reset_at=0"];

/// About so many rows of the model, those that show most, trained on. How many fit a file is estimated once more before
/// the last stage, as training changes how well rows pack; and where the format rounds, the last half of that stage
/// trains what a file has made of the model, with its colour by direction as it is there: what the file rounds off most,
/// the rest can mend. `after_stage` is shown the model after each stage but the last.
///
/// # Errors
/// As a run's, and when the observer asks to stop.
pub(super) fn tune(
    mut model: Gaussians,
    (format, rows): (&Format, usize),
    options: &Options<'_>,
    scratch: &Path,
    observer: &dyn Observer,
    after_stage: &mut dyn FnMut(&Gaussians) -> Result<(), Failure>,
) -> Result<Gaussians, Failure> {
    let least = if matches!(options.to, Target::Bytes(_)) { 2 } else { 1 };
    let rounds = format.is_lossy();
    let stages = stages((model.len(), rows), options.iterations, least);
    for (stage, &(mut budget, iterations)) in stages.iter().enumerate() {
        if stage > 0 {
            after_stage(&model)?;
        }
        if stage > 0 && stage + 1 == stages.len() {
            model = reduced(model, u8::MAX);
            budget = fit::rows(options.to, format, &model)?.unwrap_or(1);
        }
        observer.say(format_args!(
            "training {budget} Gaussians of degree {} for {iterations} iterations ({} of {})",
            model.sh_degree,
            stage + 1,
            stages.len()
        ));
        let settling = if rounds && stage + 1 == stages.len() { iterations / 2 } else { 0 };
        let setting = (budget, iterations - settling);
        model = train(model, setting, Colour::Steps, options, scratch, observer)?;
        if settling > 0 {
            model = reduced(model, u8::MAX);
            write_atomically(scratch, |out| format.write(&model, out))?;
            model = read_model(scratch, observer)?;
            let setting = (model.len(), settling);
            model = train(model, setting, Colour::Stays, options, scratch, observer)?;
        }
    }
    Ok(model)
}

/// Whether the bands of colour above 0 are trained.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Colour {
    Steps,
    Stays,
}

/// The model after so many iterations with room for so many rows.
fn train(
    model: Gaussians,
    setting: (usize, u32),
    colour: Colour,
    options: &Options<'_>,
    scratch: &Path,
    observer: &dyn Observer,
) -> Result<Gaussians, Failure> {
    write_atomically(scratch, |out| PLY.write(&model, out))?;
    let mut spec = described(&model, setting, options, scratch)?;
    if colour == Colour::Stays {
        // The least rate there is: no value of a band that shows changes by it.
        spec.schedule.lr = vec![text("sh_rest=1e-30")?];
    }
    drop(model);
    Run::prepare(&spec)?.model_after_training(observer)
}

fn text(assignment: &str) -> Result<Assignment, Failure> {
    assignment.parse().map_err(Failure::input)
}

/// Bounds, at least `least`, each at least half of the one before, and the training steps under each; the last has two
/// shares.
fn stages((whole, rows): (usize, usize), iterations: u32, least: u32) -> Vec<(usize, u32)> {
    let ratio = whole as f64 / rows.max(1) as f64;
    let count = (ratio.log2().ceil() as u32).max(least).min(iterations);
    let share = iterations / (count + 1);
    let stage = |number: u32| match number == count {
        true => (rows, iterations - share * (count - 1)),
        false => {
            ((whole as f64 / ratio.powf(f64::from(number) / f64::from(count))) as usize, share)
        }
    };
    (1..=count).map(stage).filter(|(_, steps)| *steps > 0).collect()
}

/// The description of a stage.
fn described(
    model: &Gaussians,
    (budget, iterations): (usize, u32),
    options: &Options<'_>,
    scratch: &Path,
) -> Result<RunSpec, Failure> {
    let mut spec = RunSpec { data: options.data.clone(), ..RunSpec::default() };
    spec.device = options.device.clone();
    spec.start.scene = Some(options.scene.to_owned());
    let file = std::path::absolute(scratch).map_err(Failure::input)?;
    spec.start.init = Some(InitChoice::Model(AbsolutePath(file)));
    spec.start.near = options.near;
    spec.size.budget = Some(Budget::Rows(budget));
    spec.size.sh_degree = Some(ShDegree::Fixed(model.sh_degree));
    POLICY.clone_into(&mut spec.density.policy);
    spec.density.policy_set = STILL.into_iter().map(text).collect::<Result<_, _>>()?;
    spec.schedule.iterations = Whole(iterations);
    spec.schedule.seed = options.seed;
    if let Some(model) = options.exposure {
        spec.schedule.exposure = ExposureChoice::On;
        spec.schedule.exposure_model = model;
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
