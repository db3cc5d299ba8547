//! From a description to a trainer. Everything that can fail for reasons of the user's making fails here,
//! before anything is written.

use std::path::Path;

use densify_policies::policy::DensityPolicy;

use super::Run;
use super::companion::Companion;
use super::config::{Resolved, RunConfig};
use super::observer::Observer;
use super::resolve::{self, DECODERS, Inputs, Size, TEST_DECODERS};
use super::resume::{self, Resumed};
use super::spec::RunSpec;
use super::start::{Start, behind_frozen, first_model, require_likeness};
use super::values::{Assignment, ImageCache, InitChoice, Rows, ShDegree, assignments};
use crate::failure::Failure;
use crate::memory::RunSize;
use densify_core::numbers::grouped;
use densify_data::dataset::PointCloud;
use densify_data::views::DatasetViews;
use densify_train::checkpoint::Fingerprint;
use densify_train::init::restart;
use densify_train::schedule::RateOptions;
use densify_train::trainer::{TrainOptions, Trainer};

/// Views announced ahead: enough that each decoder has one at work and one waiting.
const AHEAD: usize = 2 * DECODERS;

/// Prepares a run: a new one, or one that goes on.
pub(super) fn build(
    spec: &RunSpec,
    resumed: Option<Resumed>,
    companion: Option<Companion>,
    observer: &dyn Observer,
) -> Result<Run, Failure> {
    let last = resumed.as_ref().map_or(spec.schedule.iterations.0, |resumed| resumed.last);
    spec.check_iterations(last)?;
    let output = spec.output_folder()?;
    let saved = resumed.as_ref().map(|resumed| &resumed.config);
    let inputs = Inputs::load(spec, resumed.as_ref().map(Resumed::known), companion, observer)?;
    if !spec.output.test_iterations.is_empty() && inputs.dataset.test.is_empty() {
        return Err(Failure::input(
            "--test-iterations: no view is held out to measure; add --eval or --test-every K",
        ));
    }
    let size = match &resumed {
        // Solved when the run began; its configuration has the result.
        Some(_) => Size::as_given(&inputs)?,
        None => Size::choose(&inputs)?,
    };
    let setting = size.setting;
    resolve::check_grant(&inputs, &setting, resumed.is_some())?;
    let checkpoint = resumed.as_ref().and_then(|resumed| resumed.checkpoint.as_ref());
    let Start { mut model, init, points: init_points } = match checkpoint {
        None => first_model(&inputs, &setting, observer)?,
        Some(checkpoint) => Start {
            model: checkpoint.blank_model()?,
            init: inputs.init(),
            points: spec.start.init_points.map(|points| points.0),
        },
    };
    let file = init.file().map(Path::to_owned);
    let initial_rows =
        checkpoint.map_or(model.len(), |checkpoint| checkpoint.header().trainer.initial_rows);
    let scene = inputs.info(setting.rows, initial_rows)?;
    let policy = inputs.entry.build(&inputs.parameters, &scene)?;
    let declared = policy.needs(&scene);
    // A model keeps its opacities and sizes, whatever the policy's paper starts with.
    if checkpoint.is_none() && file.is_none() {
        restart(&mut model, &declared.start);
    }
    if checkpoint.is_none() {
        model = behind_frozen(&inputs, setting.sh_degree, model, observer)?;
    }
    let rates = spec.learning_rates(&declared.rates)?;
    let parameters = inputs.entry.effective(&inputs.parameters, &scene)?;
    let steps = steps(&inputs, &parameters);
    let mut config = decided(&inputs, setting, (init, init_points), rates, &parameters)?;
    config.resolved.sh_degree_lowered = match saved {
        Some(saved) => saved.resolved.sh_degree_lowered,
        None => size.is_lowered(&inputs),
    };
    config.resolved.extended_to = (last > spec.schedule.iterations.0).then_some(last);
    let fingerprint = Fingerprint::new(&inputs.dataset);
    if let Some(resumed) = &resumed {
        resume::check(&config, resumed, &fingerprint, &output)?;
    }
    for line in inputs.choices().chain(size.lines(&inputs)) {
        observer.say(format_args!("{line}"));
    }
    announce(&config, &output, inputs.entry.summary, observer);
    if !steps.is_empty() {
        observer.say(format_args!("steps    {steps}"));
    }
    let needs = inputs.backend_needs(policy.needs(&scene));
    let ledger = inputs.ledger(&setting, &needs);
    resolve::check(&inputs, &setting, &ledger)?;
    observer.say(format_args!("{}", inputs.promise(&ledger)));
    let measuring = inputs.measuring(&setting, inputs.threads());
    let mut backend = inputs.device.backend(&model, &inputs.backend_options(&setting, needs))?;
    drop(model);
    if let Some(file) = file.as_deref().filter(|_| checkpoint.is_none()) {
        let shown = (spec.data.background.fixed(), setting.sh_degree);
        require_likeness(file, &inputs, backend.as_mut(), shown, observer)?;
    }
    let options = train_options(&inputs, &setting, rates);
    let exposures = inputs.exposure.first(spec, &inputs.dataset);
    let (name, required) = (inputs.entry.name, inputs.required);
    let mut dataset = inputs.dataset;
    let views = DatasetViews::new(dataset.train.clone(), setting.image_cache, DECODERS);
    let test = DatasetViews::new(dataset.test.clone(), 0, TEST_DECODERS);
    // Training has made its rows of them.
    dataset.points =
        companion.map_or_else(PointCloud::default, |it| dataset.points.thinned(it.points));
    let policy: Box<dyn DensityPolicy> = policy;
    let trainer = Trainer::new(views, backend, (name, policy), scene, options)?;
    let mut trainer = trainer.with_auto_choices(required).with_exposures(exposures);
    let session = match resumed {
        Some(resumed) => resume::restore(resumed, &mut trainer, observer)?,
        None => None,
    };
    if companion.is_some() {
        trainer.record_history()?;
    }
    Ok(Run {
        config,
        output,
        trainer,
        test,
        dataset,
        ledger,
        measuring,
        fingerprint,
        last,
        session,
    })
}

/// What the trainer acts on.
fn train_options(inputs: &Inputs<'_>, setting: &RunSize, rates: RateOptions) -> TrainOptions {
    let RunSpec { schedule, data, .. } = inputs.spec;
    TrainOptions {
        iterations: schedule.iterations.0,
        seed: schedule.seed,
        sh_degree: setting.sh_degree,
        frozen: inputs.frozen_rows(),
        // Models that are trained already show all that they have.
        has_all_bands: inputs.init_model.is_some() || inputs.frozen.is_some(),
        background: data.background,
        rates,
        prefetch: AHEAD,
        on_nan: schedule.on_nan,
    }
}

/// The run with nothing open that was open in its description.
fn decided(
    inputs: &Inputs<'_>,
    setting: RunSize,
    (init, init_points): (InitChoice, Option<usize>),
    rates: RateOptions,
    parameters: &toml::Table,
) -> Result<RunConfig, Failure> {
    let mut spec = inputs.spec.clone();
    // It is where the file is.
    spec.output.output = None;
    let name = inputs.entry.name;
    let budget = spec.size.budget.unwrap_or(super::Budget::Rows(setting.rows));
    spec.size.budget = Some(budget.limited_to(setting.rows));
    spec.size.sh_degree = Some(match spec.size.sh_degree {
        Some(ShDegree::Auto(_)) => ShDegree::Auto(Some(setting.sh_degree)),
        _ => ShDegree::Fixed(setting.sh_degree),
    });
    // The knob says it otherwise.
    spec.size.tile_cap = inputs.knobs.pairs_per_row.is_none().then_some(Rows(setting.tile_cap));
    spec.size.image_cache = Some(ImageCache::Bytes(setting.image_cache));
    spec.device.backend = inputs.device.kind().choice();
    spec.device.gpu = inputs.device.adapter().map(str::to_owned);
    spec.start.init = Some(init);
    spec.start.init_points = init_points.map(Rows);
    spec.schedule.lr =
        assignments(&as_written(toml::Table::try_from(rates).map_err(Failure::input)?));
    spec.schedule.knob = assignments(&inputs.knobs.table());
    // Those of other policies stay, as one file may serve several.
    spec.density.policy_set.retain(|setting| setting.path.first().is_none_or(|it| it != name));
    spec.density.policy_set.extend(assignments(parameters).into_iter().map(|setting| {
        let path = std::iter::once(name.to_owned()).chain(setting.path).collect();
        Assignment { path, value: setting.value }
    }));
    let scene = spec.start.scene.as_ref();
    let resolved = Resolved {
        working_directory: std::env::current_dir()
            .ok()
            // A name that is not UTF-8 cannot be in the file.
            .filter(|folder| folder.to_str().is_some())
            .filter(|_| scene.is_some_and(|scene| scene.is_relative())),
        adapter: inputs.device.adapter().map(str::to_owned),
        accumulation: inputs.device.accumulation().map(|way| way.name().to_owned()),
        sh_degree_from: inputs.degree.source,
        init_model: inputs.init_model,
        frozen: inputs.frozen,
        exposure_from: inputs.exposure.source,
        has_exposures: inputs.exposure.is_on,
        ..Resolved::default()
    };
    Ok(RunConfig { densify: env!("CARGO_PKG_VERSION").to_owned(), spec, resolved })
}

/// Numbers that are an `f32` as people write them: 0.005 rather than 0.004999999888241291.
fn as_written(mut table: toml::Table) -> toml::Table {
    for value in table.iter_mut().map(|(_, value)| value) {
        if let toml::Value::Float(number) = value
            && f64::from(*number as f32).total_cmp(number).is_eq()
        {
            *number = (*number as f32).to_string().parse().unwrap_or(*number);
        }
    }
    table
}

/// The policy's parameters that are steps, as this run has them.
fn steps(inputs: &Inputs<'_>, parameters: &toml::Table) -> String {
    let names = inputs.entry.step_parameters().iter().map(|step| step.name());
    let said = names.filter_map(|name| Some(format!("{name} {}", parameters.get(name)?)));
    said.collect::<Vec<_>>().join(", ")
}

fn announce(config: &RunConfig, output: &Path, summary: &str, observer: &dyn Observer) {
    let RunSpec { density, schedule, data, .. } = &config.spec;
    observer.say(format_args!("policy   {}: {summary}", density.policy));
    observer.say(format_args!(
        "run      {} iterations, seed {}, degree {}, background {}",
        grouped(schedule.iterations.0 as usize),
        schedule.seed,
        config.sh_degree(),
        data.background
    ));
    observer.say(format_args!("output   {}", output.display()));
}
