//! From arguments to a trainer: everything that can fail for reasons of the user's making does so
//! here, before anything is written.

use std::path::{Path, PathBuf};

use densify_policies::policy::{Needs, RateOverrides};
use densify_policies::registry::{PolicyEntry, find};

use super::TrainArgs;
use super::choices::{check_iterations, learning_rates, parameters};
use super::demand::Survey;
use super::resume::{self, Resumed, output};
use super::size::{self, Size};
use super::tally::Kept;
use crate::backend::Backend;
use crate::backend::cpu::CpuBackend;
use crate::backend::gpu::GpuBackend;
use crate::checkpoint::{Checkpoint, Fingerprint};
use crate::cli::console::Console;
use crate::cli::failure::Failure;
use crate::cli::number::grouped;
use crate::dataset::Dataset;
use crate::gaussians::Gaussians;
use crate::init::{initialise, random_points, restart};
use crate::knobs::{self, DEFAULT_PRESET};
use crate::memory::{Ledger, Setting};
use crate::output::{InitChoice, PolicyConfig, RunConfig, RunFolder, SceneConfig, TrainConfig};
use crate::trainer::{TrainOptions, Trainer, needs};
use crate::views::DatasetViews;

/// Most points of a random initialisation, where none is given (Kerbl et al. 2023 use 100,000).
const RANDOM_POINTS: usize = 100_000;
/// Threads that decode images ahead of the trainer.
pub(super) const DECODERS: usize = 2;
/// And threads that decode views held out.
pub(super) const TEST_DECODERS: usize = 1;
/// Views announced ahead: enough that each decoder has one at work and one waiting.
const AHEAD: usize = 2 * DECODERS;

/// A run, ready to start.
pub(super) struct Prepared {
    pub(super) config: RunConfig,
    pub(super) output: PathBuf,
    pub(super) trainer: Trainer<DatasetViews>,
    /// The views held out.
    pub(super) test: DatasetViews,
    /// Everything of the dataset but its points.
    pub(super) dataset: Dataset,
    pub(super) ledger: Ledger,
    /// What the dataset is, for checkpoints.
    pub(super) fingerprint: Fingerprint,
    /// The step at which the run ends.
    pub(super) last: u32,
    /// What the session was, for a run that goes on.
    pub(super) kept: Option<Kept>,
}

pub(super) fn prepare(
    args: &TrainArgs,
    resumed: Option<Resumed>,
    console: &Console,
) -> Result<Prepared, Failure> {
    let last = resumed.as_ref().map_or(args.iterations, |resumed| resumed.last);
    let mut checkpoint = resumed.map(|resumed| resumed.checkpoint);
    // Before anything is loaded, so that a slip is told at once.
    parameters(args, find(&args.policy)?)?;
    learning_rates(&args.lr, args.iterations, &RateOverrides::default())?;
    check_iterations("--save-iterations", &args.save_iterations, last)?;
    check_iterations("--test-iterations", &args.test_iterations, last)?;
    let output = output(args);
    RunFolder::check(&output, args.overwrite || args.resume)?;

    let saved = checkpoint.as_ref().map(|checkpoint| checkpoint.header().config.clone());
    let survey = Survey::of(args, saved.as_ref(), console)?;
    if !args.test_iterations.is_empty() && survey.dataset.test.is_empty() {
        return Err(Failure::input(
            "--test-iterations: no view is held out to measure; add --eval or --test-every K",
        ));
    }
    let size = match &checkpoint {
        // Solved when the run began; its options say what came of it.
        Some(_) => Size::as_given(args, &survey)?,
        None => Size::choose(args, &survey)?,
    };
    let setting = size.setting;
    let needed = survey.needs(args, setting.rows)?;
    size::check_grant(args, &survey.ledger(args, &setting, &needed, size::threads(args)))?;
    let (mut model, init, init_points) = match &mut checkpoint {
        None => first_model(args, &survey, &setting, console)?,
        Some(checkpoint) => {
            let TrainConfig { init, init_points, .. } = checkpoint.header().config.train;
            (
                checkpoint.blank_model()?,
                args.init.map_or(init, Into::into),
                args.init_points.or(init_points),
            )
        }
    };
    let initial_rows = (checkpoint.as_ref())
        .map_or(model.len(), |checkpoint| checkpoint.header().trainer.initial_rows);
    let scene = survey.info(args, setting.rows, initial_rows)?;
    let (entry, parameters) = (survey.entry, &survey.parameters);
    let policy = entry.build(parameters, &scene)?;
    let declared = policy.needs(&scene);
    if checkpoint.is_none() {
        restart(&mut model, &declared.start);
    }
    let rates = learning_rates(&args.lr, args.iterations, &declared.rates)?;
    let adapter = survey.device.as_ref().map(|device| device.adapter().name.clone());
    let config = RunConfig {
        densify: env!("CARGO_PKG_VERSION").to_owned(),
        train: TrainConfig {
            budget: setting.rows,
            budget_auto: survey.required.rows,
            memory: args.memory,
            iterations: args.iterations,
            extended_to: (last > args.iterations).then_some(last),
            seed: args.seed,
            sh_degree: setting.sh_degree,
            sh_degree_from: survey.degree.choice,
            sh_degree_lowered: match &saved {
                Some(saved) => saved.train.sh_degree_lowered,
                None => size.is_lowered(&survey),
            },
            full: args.full,
            near: args.near,
            tile_cap: match &size.solved {
                Some(_) => Some(setting.tile_cap),
                None => args.tile_cap,
            },
            init,
            init_points,
            sh_every: args.sh_every,
            adapter,
            learning_rates: rates,
        },
        policy: PolicyConfig {
            name: entry.name.to_owned(),
            parameters: entry.effective(parameters, &scene)?,
        },
        scene: SceneConfig { image_cache: setting.image_cache, ..survey.scene.clone() },
        knobs: survey.settings.clone(),
    };
    let fingerprint = Fingerprint::of(&survey.dataset);
    if let Some(checkpoint) = &checkpoint {
        resume::check(&config, checkpoint)?;
        check_dataset(checkpoint, &fingerprint)?;
    }
    for line in survey.degree.line().into_iter().chain(size.lines(args, &survey)) {
        console.say(line);
    }
    announce(args, entry, &config, &output, console);
    // A run that goes on has the knobs that it began with.
    let default = checkpoint.is_none().then_some(DEFAULT_PRESET);
    if let Some(name) = args.preset.as_deref().or(default) {
        let preset = knobs::preset(name).map_err(Failure::input)?;
        let iterations = args.iterations.to_string();
        match preset.levels.iter().find(|(knob, _)| *knob == "iterations") {
            // What it was measured to cost and buy is another run's.
            Some((_, own)) if *own != iterations => console.say(format_args!(
                "preset   none: --iterations {iterations} is given, and {name} is {own} iterations"
            )),
            _ => console.say(format_args!("preset   {preset}")),
        }
    }

    let needs = survey.backend_needs(needs(policy.as_ref(), &scene, args.sh_every));
    let ledger = survey.ledger(args, &setting, &needs, size::threads(args));
    size::check(args, &survey, &ledger)?;
    console.say(format_args!("memory promised\n{ledger}"));
    let backend = backend(args, &survey, &setting, needs, model)?;
    let Survey { mut dataset, required, .. } = survey;
    let views = DatasetViews::new(dataset.train.clone(), setting.image_cache, DECODERS);
    let test = DatasetViews::new(dataset.test.clone(), 0, TEST_DECODERS);
    dataset.points = crate::dataset::PointCloud::default();
    let options = TrainOptions {
        iterations: args.iterations,
        seed: args.seed,
        sh_degree: setting.sh_degree,
        background: config.scene.background,
        rates,
        sh_every: args.sh_every,
        prefetch: AHEAD,
        on_nan: args.on_nan.into(),
        savings: config.knobs.savings(),
    };
    let trainer = Trainer::new(views, backend, (entry.name, policy), scene, options)?;
    let mut trainer = trainer.requiring(required);
    let kept = checkpoint.map(|checkpoint| go_on(checkpoint, &mut trainer, last, console));
    let kept = kept.transpose()?;
    Ok(Prepared { config, output, trainer, test, dataset, ledger, fingerprint, last, kept })
}

/// Gives the trainer, which holds as many rows as the checkpoint, all that is in it.
fn go_on(
    mut checkpoint: Checkpoint,
    trainer: &mut Trainer<DatasetViews>,
    last: u32,
    console: &Console,
) -> Result<Kept, Failure> {
    checkpoint.restore(trainer.backend())?;
    let header = checkpoint.header();
    let fail =
        |problem: String| Failure::input(format!("{}: {problem}", checkpoint.path().display()));
    let state = header.trainer.clone();
    let step = state.step;
    trainer.resume(state).map_err(|error| fail(error.to_string()))?;
    let kept = serde_json::from_value(header.session.clone());
    let kept = kept.map_err(|error| fail(format!("its session: {error}")))?;
    let length = header.config.train.iterations;
    console.say(format_args!("resume   from step {step}, {}", checkpoint.path().display()));
    if last > length {
        console.say(format_args!(
            "note: extended from {length} to {last} iterations; all schedules stay those of {length}, \
             beyond which step sizes no longer fall"
        ));
    }
    if step >= last {
        console.say(format_args!(
            "note: all {last} iterations are done; --iterations with a larger number extends the run"
        ));
    }
    let version = env!("CARGO_PKG_VERSION");
    if header.densify != version {
        console.say(format_args!(
            "note: the checkpoint was written by densify {}, this is {version}; the result may differ \
             from that of a run that was not interrupted",
            header.densify
        ));
    }
    Ok(kept)
}

/// Fails unless the dataset is the one that the run began with.
fn check_dataset(checkpoint: &Checkpoint, now: &Fingerprint) -> Result<(), Failure> {
    let Some(difference) = checkpoint.header().dataset.difference(now) else {
        return Ok(());
    };
    Err(Failure::input(format!(
        "--resume: this is not the dataset of {}: {difference}; give the dataset of that run, or begin \
         a new run without --resume",
        checkpoint.path().display()
    )))
}

/// The renderer with the model.
fn backend(
    args: &TrainArgs,
    survey: &Survey,
    setting: &Setting,
    needs: Needs,
    model: Gaussians,
) -> Result<Box<dyn Backend>, Failure> {
    Ok(match &survey.device {
        Some(device) => {
            Box::new(GpuBackend::new(&model, &survey.gpu(args, setting, needs), device)?)
        }
        None => Box::new(CpuBackend::new(&model, &survey.cpu(args, setting, needs))?),
    })
}

/// Rows of a random start within a budget, where no number is given.
pub(super) fn random_count(budget: usize) -> usize {
    (budget / 2).clamp(1, RANDOM_POINTS)
}

/// The initial model in the coordinates of training, and how it was made.
fn first_model(
    args: &TrainArgs,
    survey: &Survey,
    setting: &Setting,
    console: &Console,
) -> Result<(Gaussians, InitChoice, Option<usize>), Failure> {
    let choice = survey.init(args);
    let dataset = &survey.dataset;
    let random;
    let (points, count) = match choice {
        InitChoice::Points if args.init_points.is_some() => {
            return Err(Failure::input(
                "--init-points is for a random start; leave it out, or use --init random",
            ));
        }
        InitChoice::Points => (&dataset.points, None),
        InitChoice::Random => {
            let count = args.init_points.unwrap_or_else(|| random_count(setting.rows));
            let cameras: Vec<_> = dataset.train.iter().map(|view| view.camera).collect();
            let opaque = !dataset.train.iter().any(|view| view.source.header.has_alpha);
            random = random_points(count, &cameras, opaque, args.seed);
            (&random, Some(count))
        }
    };
    let (model, report) = initialise(points, setting.rows, setting.sh_degree, args.seed)?;
    let left_out = [
        (report.unusable, "not finite"),
        (report.duplicates, "at the place of another"),
        (report.over_budget, "beyond the budget; which ones follows from the seed"),
    ];
    for (number, why) in left_out.into_iter().filter(|(number, _)| *number > 0) {
        console.say(format_args!("note: {} points left out: {why}", grouped(number)));
    }
    let what = if count.is_some() { "random points" } else { "points of the scene" };
    console.say(format_args!(
        "start    {} rows from {} {what}",
        grouped(model.len()),
        grouped(report.points)
    ));
    Ok((model, choice, count))
}

fn announce(
    args: &TrainArgs,
    entry: &PolicyEntry,
    config: &RunConfig,
    output: &Path,
    console: &Console,
) {
    console.say(format_args!("policy   {}: {}", entry.name, entry.summary));
    console.say(format_args!(
        "run      {} iterations, seed {}, degree {}, background {}",
        grouped(args.iterations as usize),
        args.seed,
        config.train.sh_degree,
        config.scene.background
    ));
    console.say(format_args!("output   {}", output.display()));
}
