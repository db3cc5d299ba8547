//! Trains a cleaned model further, without growth.

use std::path::Path;

use densify_core::files::{FileError, folder_of, write_atomically};
use densify_core::gaussians::Gaussians;
use densify_core::numbers::gaussians;
use densify_data::models::{Coordinates, PLY};
use densify_run::failure::Failure;
use densify_run::{
    AbsolutePath, Assignment, Budget, InitChoice, Observer, Run, RunSpec, ShDegree, Whole,
};
use densify_train::exposure::ExposureChoice;

use super::Options;

/// With the settings below, this policy neither adds nor prunes rows.
const POLICY: &str = "vanilla";
const POLICY_SETTINGS: [&str; 3] =
    ["vanilla.grow_every=0", "vanilla.reset_every=0", "vanilla.white_reset_at=0"];

/// Trains all Gaussians of a model.
///
/// # Errors
/// Errors of a run, and when the observer interrupts.
pub(super) fn train(
    model: Gaussians,
    options: &Options<'_>,
    observer: &dyn Observer,
) -> Result<Gaussians, Failure> {
    let iterations = options.refine;
    observer.say(format_args!("training {} for {iterations} iterations", gaussians(model.len())));
    let folder = folder_of(options.output);
    let made = std::fs::create_dir_all(folder)
        .and_then(|()| tempfile::NamedTempFile::with_prefix_in(".densify-", folder));
    let scratch = made.map_err(FileError::io("write to the folder", folder))?.into_temp_path();
    write_atomically(&scratch, |out| PLY.write(&model, out))?;
    let spec = describe_run(&model, options, &scratch)?;
    let origin = model.origin;
    drop(model);
    let trained = Run::prepare(&spec)?.model_after_training(observer)?;
    Ok(trained.with_origin(origin))
}

fn describe_run(
    model: &Gaussians,
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
    spec.size.budget = Some(Budget::Rows(model.len()));
    spec.size.sh_degree = Some(ShDegree::Fixed(model.sh_degree));
    POLICY.clone_into(&mut spec.density.policy);
    let assignment = |text: &str| text.parse::<Assignment>().map_err(Failure::input);
    spec.density.policy_set =
        POLICY_SETTINGS.into_iter().map(assignment).collect::<Result<_, _>>()?;
    spec.schedule.iterations = Whole(options.refine);
    spec.schedule.seed = options.seed;
    if let Some(exposure_model) = options.exposure {
        spec.schedule.exposure = ExposureChoice::On;
        spec.schedule.exposure_model = exposure_model;
    }
    spec.output.coordinates =
        if model.is_local() { Coordinates::Local } else { Coordinates::World };
    Ok(spec)
}
