//! Prepares a run: resolves it, makes the model that it starts from, and builds the trainer. Every error that the user
//! can fix is found here, before anything is written.

use std::path::Path;

use super::degree_trial;
use super::first_model::{append_to_frozen, check_coordinates, first_model};
use super::records::{SavedSession, Totals, Unwritten};
use super::resume::{self, Resumed};
use super::run::Run;
use crate::failure::{Failure, OptionProblem};
use crate::host::Host;
use crate::observer::Observer;
use crate::resolved::{DECODERS, Init, ResolvedRun, ResolvedTraining, RunConfig, TEST_DECODERS};
use crate::spec::RunSpec;
use densify_core::gaussians::Gaussians;
use densify_core::memory::Bytes;
use densify_core::numbers::grouped;
use densify_data::dataset::PointCloud;
use densify_data::views::{DatasetViews, ViewSource};
use densify_render::Backend;
use densify_train::checkpoint::{Fingerprint, newest_step};
use densify_train::init::apply_start_rule;
use densify_train::schedule::RateOptions;
use densify_train::trainer::{TrainOptions, Trainer};

/// Number of views to prefetch: for each decoder, one being decoded and one waiting.
const AHEAD: usize = 2 * DECODERS;

/// Prepares a new run, or a resumed one.
pub(super) fn prepare(
    spec: &RunSpec,
    resumed: Option<Resumed>,
    host: Host<'_>,
) -> Result<Run, Failure> {
    let Host { observer, process, companion } = host;
    let last = resumed.as_ref().map_or(spec.schedule.iterations.0, |resumed| resumed.last);
    spec.check_iterations(last)?;
    let output = spec.output_folder()?;
    let checkpoint = resumed.as_ref().and_then(|resumed| resumed.checkpoint.as_ref());
    let run = match &resumed {
        None => ResolvedRun::for_new_run(spec, host)?,
        Some(resumed) => {
            ResolvedRun::from_saved(spec, &resumed.config, checkpoint.is_some(), host)?
        }
    };
    if !spec.output.test_iterations.is_empty() && run.case.inputs.dataset.test.is_empty() {
        return Err(OptionProblem::NothingToTest.into());
    }
    run.check_grant(process, resumed.is_some())?;
    let (run, spent) = match resumed {
        None => degree_trial::decide(run, host)?,
        Some(_) => (run, None),
    };
    let (model, training) = match checkpoint {
        None => start(&run, observer)?,
        Some(checkpoint) => {
            let mut model = checkpoint.blank_model()?;
            model.antialiasing = run.case.choices.antialiasing;
            (model, ResolvedTraining::new(&run, checkpoint.header().trainer.initial_rows)?)
        }
    };
    let config = RunConfig::new(&run, &training, last)?;
    let fingerprint = Fingerprint::new(&run.case.inputs.dataset);
    if let Some(resumed) = &resumed {
        resume::check(&config, resumed, &fingerprint, &output)?;
        resume::note_provenance(&config, resumed, observer);
    }
    announce(&run, &training, &output, observer);
    let ResolvedRun { case, size, .. } = &run;
    let ledger = case.ledger(size, &case.backend_needs(training.declared.clone()));
    run.check_memory(&ledger)?;
    let total = Bytes(ledger.total());
    observer.say(format_args!("memory   {total} promised in all"));
    observer.detail(format_args!("{}", case.memory_table(&ledger, observer.spelling())));
    let geometry_measurement = case.geometry_measurement(size, case.choices.threads);
    let views = DatasetViews::new(case.inputs.dataset.train.clone(), size.image_cache, DECODERS);
    views.check_visible(&case.inputs.dataset.root)?;
    let mut trainer = trainer(&run, model, training, views, |backend| match &run.init {
        Init::Model(file) if checkpoint.is_none() => {
            check_coordinates(&file.0, &run, backend, observer)
        }
        _ => Ok(()),
    })?;
    let mut dataset = run.case.inputs.into_owned().dataset;
    let test = DatasetViews::new(dataset.test.clone(), 0, TEST_DECODERS);
    // Once the first rows are made, training needs no points.
    dataset.points = companion
        .map_or_else(PointCloud::default, |companion| dataset.points.thinned(companion.points));
    let session = match resumed {
        Some(resumed) => resume::restore(resumed, &mut trainer, observer)?,
        None => None,
    };
    if companion.is_some() {
        trainer.record_history()?;
    }
    let checkpoint = session.as_ref().map(|_| trainer.steps_done());
    let (totals, logs) = match session {
        Some(SavedSession { totals, logs }) => (totals, Some(logs)),
        None => (Totals::after(spent), None),
    };
    let newest_checkpoint = checkpoint.and_then(|_| newest_step(&output));
    Ok(Run {
        spec: spec.clone(),
        config,
        output,
        trainer,
        test,
        dataset,
        ledger,
        geometry_measurement,
        fingerprint,
        last,
        totals,
        unwritten: Unwritten::default(),
        logs,
        checkpoint,
        newest_checkpoint,
        process,
    })
}

/// The first model of a new run, and its training.
///
/// # Errors
/// When a model or a parameter is unsuitable.
pub(super) fn start(
    run: &ResolvedRun<'_>,
    observer: &dyn Observer,
) -> Result<(Gaussians, ResolvedTraining), Failure> {
    let mut model = first_model(run, observer)?;
    model.antialiasing = run.case.choices.antialiasing;
    let training = ResolvedTraining::new(run, model.len())?;
    // A given model keeps its opacities and scales, even if the policy prescribes initial ones.
    if !matches!(run.init, Init::Model(_)) {
        apply_start_rule(&mut model, &training.declared.start);
    }
    Ok((append_to_frozen(run, model, observer)?, training))
}

/// The trainer of a run that starts with `model`. `check` receives the backend before it trains.
///
/// # Errors
/// When the device or `check` fails.
pub(super) fn trainer<V: ViewSource>(
    run: &ResolvedRun<'_>,
    model: Gaussians,
    training: ResolvedTraining,
    views: V,
    check: impl FnOnce(&mut dyn Backend) -> Result<(), Failure>,
) -> Result<Trainer<V>, Failure> {
    let ResolvedRun { case, size, .. } = run;
    let ResolvedTraining { policy, scene, declared, rates, .. } = training;
    let setup = case.backend_setup(size, case.backend_needs(declared));
    let mut backend = case.inputs.device.backend(&model, &setup)?;
    drop(model);
    check(backend.as_mut())?;
    let (choices, dataset) = (&case.choices, &case.inputs.dataset);
    let poses = choices.poses.initial(case.spec, dataset, scene.extent);
    let policy = (choices.entry.name, policy);
    let trainer = Trainer::new(views, backend, policy, scene, train_options(run, rates))?;
    Ok(trainer
        .with_auto_choices(choices.automatic)
        .with_exposures(choices.exposure.initial(case.spec, dataset))
        .with_vignettes(choices.vignette.initial(dataset))
        .with_poses(poses))
}

fn train_options(run: &ResolvedRun<'_>, rates: RateOptions) -> TrainOptions {
    let ResolvedRun { case, size, .. } = run;
    let RunSpec { schedule, data, depth, .. } = case.spec;
    TrainOptions {
        iterations: schedule.iterations.0,
        seed: schedule.seed,
        sh_degree: size.sh_degree,
        frozen: case.budget(size.rows).frozen,
        // A trained model uses all of its colour bands from the start.
        has_all_bands: case.inputs.init_model.is_some() || case.inputs.frozen_model.is_some(),
        background: data.background,
        rates,
        prefetch: AHEAD,
        on_nan: schedule.on_nan,
        depth: case.inputs.dataset.depth.as_ref().and_then(|_| depth.training()),
        distortion: depth.distortion(),
        removes_floaters: depth.remove_floaters,
    }
}

/// Tells the user which choices were made.
fn announce(
    run: &ResolvedRun<'_>,
    training: &ResolvedTraining,
    output: &Path,
    observer: &dyn Observer,
) {
    for line in &run.reasons {
        observer.say(format_args!("{line}"));
    }
    let RunSpec { density, schedule, data, .. } = run.case.spec;
    let summary = run.case.choices.entry.summary;
    observer.say(format_args!("policy   {}: {summary}", density.policy));
    let antialiasing = run.case.choices.antialiasing;
    let kernel = if antialiasing.is_on() {
        format!(", antialiasing {antialiasing} px²")
    } else {
        String::new()
    };
    observer.say(format_args!(
        "run      {} iterations, seed {}, degree {}, background {}{kernel}",
        grouped(schedule.iterations.0 as usize),
        schedule.seed,
        run.size.sh_degree,
        data.background
    ));
    observer.say(format_args!("output   {}", output.display()));
    let steps = training.steps(run);
    if !steps.is_empty() {
        observer.say(format_args!("steps    {steps}"));
    }
}
