//! From arguments to a trainer: everything that can fail for reasons of the user's making does so
//! here, before anything is written.

use std::path::{Path, PathBuf};

use densify_policies::policy::{Needs, RateOverrides, SceneInfo};
use densify_policies::registry::{PolicyEntry, find};

use super::choices::{check_iterations, learning_rates, parameters};
use super::resume::{self, Resumed, output};
use super::tally::Kept;
use super::{DEFAULT_BUDGET, TrainArgs};
use crate::backend::Backend;
use crate::backend::cpu::{CpuBackend, CpuOptions};
use crate::backend::gpu::{GpuBackend, GpuDevice, GpuOptions};
use crate::checkpoint::{Checkpoint, Fingerprint};
use crate::cli::console::Console;
use crate::cli::failure::Failure;
use crate::cli::number::grouped;
use crate::cli::run_files::use_threads;
use crate::cli::scene;
use crate::dataset::Dataset;
use crate::gaussians::{Gaussians, sh_coefficients};
use crate::init::{initialise, random_points, restart};
use crate::memory::{Ledger, Section, resident};
use crate::metrics::scratch_bytes;
use crate::output::{InitChoice, PolicyConfig, RunConfig, RunFolder, TrainConfig};
use crate::schedule::Background;
use crate::trainer::{TrainOptions, Trainer, needs};
use crate::views::{DatasetViews, ViewSource};

/// Most points of a random initialisation, where none is given (Kerbl et al. 2023 use 100,000).
const RANDOM_POINTS: usize = 100_000;
/// Threads that decode images ahead of the trainer.
const DECODERS: usize = 2;
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
    let entry = find(&args.policy)?;
    let parameters = parameters(args, entry)?;
    // Before anything is loaded, so that a slip is told at once.
    learning_rates(&args.lr, args.iterations, &RateOverrides::default())?;
    check_iterations("--save-iterations", &args.save_iterations, last)?;
    check_iterations("--test-iterations", &args.test_iterations, last)?;
    let output = output(args);
    RunFolder::check(&output, args.overwrite || args.resume)?;
    let device = args.device.open(console)?;
    use_threads(args.threads);

    let scene_config = args.data.config(&args.scene);
    let mut dataset = scene::load(&args.scene, &scene_config, console)?;
    if !args.test_iterations.is_empty() && dataset.test.is_empty() {
        return Err(Failure::input(
            "--test-iterations: no view is held out to measure; add --eval or --test-every K",
        ));
    }
    console.say(scene::describe(&args.scene, &dataset));
    let budget = args.budget.unwrap_or(DEFAULT_BUDGET);
    let (mut model, init, init_points) = match &mut checkpoint {
        None => first_model(args, &dataset, budget, console)?,
        Some(checkpoint) => {
            let TrainConfig { init, init_points, .. } = checkpoint.header().config.train;
            (
                checkpoint.model()?,
                args.init.map_or(init, Into::into),
                args.init_points.or(init_points),
            )
        }
    };
    let scene = SceneInfo {
        extent: dataset.extent() as f32,
        train_views: u32::try_from(dataset.train.len())
            .map_err(|_| Failure::input("the scene has more than 4 billion views"))?,
        budget,
        initial_rows: (checkpoint.as_ref())
            .map_or(model.len(), |checkpoint| checkpoint.header().trainer.initial_rows),
        iterations: args.iterations,
        white_background: scene_config.background == Background::White,
    };
    let policy = entry.build(&parameters, &scene)?;
    let declared = policy.needs(&scene);
    if checkpoint.is_none() {
        restart(&mut model, &declared.start);
    }
    let rates = learning_rates(&args.lr, args.iterations, &declared.rates)?;
    let config = RunConfig {
        densify: env!("CARGO_PKG_VERSION").to_owned(),
        train: TrainConfig {
            budget,
            iterations: args.iterations,
            extended_to: (last > args.iterations).then_some(last),
            seed: args.seed,
            sh_degree: args.sh_degree,
            near: args.near,
            tile_cap: args.tile_cap,
            init,
            init_points,
            sh_every: args.sh_every,
            adapter: device.as_ref().map(|device| device.adapter().name.clone()),
            learning_rates: rates,
        },
        policy: PolicyConfig {
            name: entry.name.to_owned(),
            parameters: entry.effective(&parameters, &scene)?,
        },
        scene: scene_config,
    };
    let fingerprint = Fingerprint::of(&dataset);
    if let Some(checkpoint) = &checkpoint {
        resume::check(&config, checkpoint)?;
        check_dataset(checkpoint, &fingerprint)?;
    }
    announce(args, entry, &config, &output, console);

    let views = DatasetViews::new(dataset.train.clone(), args.data.image_cache, DECODERS);
    let test = DatasetViews::new(dataset.test.clone(), 0, 1);
    dataset.points = crate::dataset::PointCloud::default();
    let options = TrainOptions {
        iterations: args.iterations,
        seed: args.seed,
        sh_degree: args.sh_degree,
        background: config.scene.background,
        rates,
        sh_every: args.sh_every,
        prefetch: AHEAD,
        on_nan: args.on_nan.into(),
    };
    let needs = needs(policy.as_ref(), &scene, &options);
    let (backend, ledger) =
        backend(args, &config, &dataset, needs, &scene, (model, device), [&views, &test])?;
    console.say(format_args!("memory promised\n{ledger}"));
    let mut trainer = Trainer::new(views, backend, (entry.name, policy), scene, options)?;
    let kept = checkpoint.map(|checkpoint| go_on(checkpoint, &mut trainer, last, console));
    let kept = kept.transpose()?;
    Ok(Prepared { config, output, trainer, test, dataset, ledger, fingerprint, last, kept })
}

/// Gives the trainer, which holds the model of the checkpoint, all else that is in it.
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

/// The renderer with the model, and the ledger of the whole run.
fn backend(
    args: &TrainArgs,
    config: &RunConfig,
    dataset: &Dataset,
    needs: Needs,
    scene: &SceneInfo,
    (model, device): (Gaussians, Option<GpuDevice>),
    [views, test]: [&DatasetViews; 2],
) -> Result<(Box<dyn Backend>, Ledger), Failure> {
    let mut before = resident();
    let signals = needs.signals.iter().count() as u64;
    let candidates = needs.candidates.map_or(0, |request| request.capacity);
    // One auxiliary view's columns, and as many that a policy makes of them; all views' points.
    let aux = needs.aux.as_ref();
    let columns = aux.map_or(0, |request| 2 * request.columns.len()) as u64;
    let points = aux.map_or(0, |r| u64::from(r.points) * u64::from(scene.train_views));
    let near = (config.train.near * f64::from(scene.extent)) as f32;
    let largest_image = scene::largest_image(dataset);
    let backend: Box<dyn Backend> = match device {
        Some(device) => {
            let tile_cap = args.tile_cap;
            let options = GpuOptions { budget: scene.budget, near, tile_cap, largest_image, needs };
            let backend = GpuBackend::new(&model, &options, &device)?;
            // A driver and its compiled kernels are part of the program.
            before = resident();
            Box::new(backend)
        }
        None => {
            let mut options = CpuOptions::new(scene.budget);
            options.near = near;
            options.tile_cap = args.tile_cap.unwrap_or(options.tile_cap);
            options.threads = args.threads.map(usize::from);
            options.largest_image = largest_image;
            options.needs = needs;
            Box::new(CpuBackend::new(&model, &options)?)
        }
    };
    drop(model);

    let mut ledger = backend.ledger().clone();
    let cache = views.cache();
    ledger.add_to(Section::Images, "decoded training views", cache.held_bytes());
    ledger.add_to(Section::Images, "decoding", cache.decode_bytes());
    let budget = scene.budget as u64;
    let float = size_of::<f32>() as u64;
    // Signals and candidates on the host; fates, families and slots of the plan.
    let candidate = size_of::<densify_policies::policy::Candidate>() as u64;
    let seed = size_of::<densify_policies::plan::Seed>() as u64;
    // A point is kept by the policy, becomes a seed, and is compiled.
    let plan = budget * ((signals + columns) * float + 64)
        + candidates as u64 * candidate
        + points * (candidate + 3 * seed);
    ledger.add_to(Section::Passing, "a policy's event", plan);
    // The model as downloaded and as exported.
    let row = float * (11 + 3 * sh_coefficients(config.train.sh_degree) as u64);
    ledger.add_to(Section::Passing, "export of the model, checkpoint", 2 * budget * row);
    if test.count() > 0 {
        let (width, height) = largest_image;
        let rendering = u64::from(width) * u64::from(height) * 5 * float;
        ledger.add_to(
            Section::Passing,
            "measuring a test view",
            rendering
                + test.cache().bytes_needed()
                + scratch_bytes(width, rayon::current_num_threads()),
        );
    }
    if let Some(bytes) = before {
        ledger.add_to(Section::Process, "program and dataset", bytes);
    }
    Ok((backend, ledger))
}

/// The initial model in the coordinates of training, and how it was made.
fn first_model(
    args: &TrainArgs,
    dataset: &Dataset,
    budget: usize,
    console: &Console,
) -> Result<(Gaussians, InitChoice, Option<usize>), Failure> {
    let choice = match args.init {
        Some(init) => init.into(),
        None if dataset.points.is_empty() || args.init_points.is_some() => InitChoice::Random,
        None => InitChoice::Points,
    };
    let random;
    let (points, count) = match choice {
        InitChoice::Points if args.init_points.is_some() => {
            return Err(Failure::input(
                "--init-points is for a random start; leave it out, or use --init random",
            ));
        }
        InitChoice::Points => (&dataset.points, None),
        InitChoice::Random => {
            let count = args.init_points.unwrap_or((budget / 2).clamp(1, RANDOM_POINTS));
            let cameras: Vec<_> = dataset.train.iter().map(|view| view.camera).collect();
            let opaque = !dataset.train.iter().any(|view| view.source.header.has_alpha);
            random = random_points(count, &cameras, opaque, args.seed);
            (&random, Some(count))
        }
    };
    let (model, report) = initialise(points, budget, args.sh_degree, args.seed)?;
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
    let default = if args.budget.is_none() { " (default; choose with --budget)" } else { "" };
    console.say(format_args!("budget   {} rows{default}", grouped(config.train.budget)));
    console.say(format_args!("policy   {}: {}", entry.name, entry.summary));
    console.say(format_args!(
        "run      {} iterations, seed {}, degree {}, background {}",
        grouped(args.iterations as usize),
        args.seed,
        args.sh_degree,
        config.scene.background
    ));
    console.say(format_args!("output   {}", output.display()));
}
