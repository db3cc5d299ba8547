//! What a run takes, buffer by buffer, for any size of it, before anything of it is allocated. The
//! ledger of a run and that of `densify plan` are made here, so that they cannot disagree.

use densify_policies::plan::BYTES_PER_ROW;
use densify_policies::policy::{Needs, SceneInfo, SignalSet};
use densify_policies::registry::{PolicyEntry, find};
use glam::DVec3;
use toml::Table;

use super::TrainArgs;
use super::choices::parameters;
use super::degree::{Degree, ShDegree, check_full};
use super::setup::{DECODERS, random_count};
use super::size::Budget;
use crate::backend::ROWS_AT_A_TIME;
use crate::backend::cpu::{CpuBackend, CpuOptions};
use crate::backend::gpu::{Accumulation, GpuBackend, GpuDevice, GpuOptions, KeptPhotographs};
use crate::cli::console::Console;
use crate::cli::failure::Failure;
use crate::cli::run_files::use_threads;
use crate::cli::scene;
use crate::dataset::images::ImageDemand;
use crate::dataset::{Dataset, Tracks, View};
use crate::export::{PLY, Shape};
use crate::gaussians::sh_coefficients;
use crate::init::usable_points;
use crate::knobs::Settings;
use crate::memory::{IMAGES, Ledger, Section, Setting, peak_resident, resident};
use crate::metrics::scratch_bytes;
use crate::output::{InitChoice, RunConfig, SceneConfig};
use crate::schedule::Background;
use crate::trainer::{Required, growth_signals, needs};

/// What the program takes for itself: its code as far as it runs, and the stacks of its threads.
/// Measured at 10 to 13 MiB.
const PROGRAM: u64 = 14 << 20;
/// A program that takes more, such as one with a driver in it, is taken at what it has, in these
/// steps: what is promised should not change from call to call.
const PROGRAM_STEP: u64 = 8 << 20;
/// What the system's allocator keeps between two uses of a piece. Measured at up to 5 MiB.
const KEPT: u64 = 6 << 20;
/// What a policy makes of its signals for each row before it plans: means, orders, sums of weights
/// and draws. Those that make more of auxiliary views' columns have these counted twice.
const PLANNING: u64 = 20;
/// A point with its colour.
const POINT: u64 = (size_of::<DVec3>() + 3) as u64;

/// What is known of a run before its size is.
pub(super) struct Survey {
    pub(super) entry: &'static PolicyEntry,
    /// The policy's parameters as set.
    pub(super) parameters: Table,
    pub(super) settings: Settings,
    pub(super) device: Option<GpuDevice>,
    pub(super) scene: SceneConfig,
    pub(super) dataset: Dataset,
    pub(super) degree: Degree,
    /// What the run is to find out by itself.
    pub(super) required: Required,
    /// The budget of a run that goes on.
    pub(super) most_rows: Option<usize>,
    /// What training and test images take.
    images: [ImageDemand; 2],
    /// Rows that a start on the dataset's points would have, were there no limit.
    usable: usize,
    /// Resident memory when the dataset was loaded, and the most until then.
    resident: Option<u64>,
    peak: Option<u64>,
}

impl Survey {
    /// Loads the dataset and opens the device. `saved` is the configuration of a run that goes on.
    pub(super) fn of(
        args: &TrainArgs,
        saved: Option<&RunConfig>,
        console: &Console,
    ) -> Result<Self, Failure> {
        let entry = find(&args.policy)?;
        let parameters = parameters(args, entry)?;
        let knob = |error| Failure::input(format!("--knob: {error}"));
        let mut settings = Settings::of(&args.knob).map_err(knob)?;
        check_full(args)?;
        let device = args.device.open(accumulation(args, &settings)?, console)?;
        settings.check_backend(device.is_some()).map_err(knob)?;
        if let Some(device) = &device {
            let taken = device.accumulation();
            settings.take_accumulation(taken);
            let note = match taken.is_deterministic() {
                true => "the same bytes every time",
                false => "the last bits are chance; --deterministic for the same bytes every time",
            };
            console.say(format_args!("sums     accumulation={taken}: {note}"));
        }
        use_threads(args.threads);
        let scene = args.data.config(&args.scene);
        let with_tracks = saved.is_none() && args.sh_degree == Some(ShDegree::Auto);
        let mut dataset = scene::load(&args.scene, &scene, with_tracks, console)?;
        console.say(scene::describe(&args.scene, &dataset));
        let usable = usable_points(&dataset.points);
        let images = images(&dataset);
        let (resident, peak) = (resident(), peak_resident());
        let degree = Degree::decide(args, saved, &dataset)?;
        dataset.tracks = Tracks::default();
        let required = Required {
            rows: args.budget == Some(Budget::Auto)
                || saved.is_some_and(|saved| saved.train.budget_auto),
            scored_views: !args.full,
        };
        let most_rows = saved.map(|saved| saved.train.budget);
        Ok(Self {
            entry,
            parameters,
            settings,
            device,
            scene,
            dataset,
            degree,
            required,
            most_rows,
            images,
            usable,
            resident,
            peak,
        })
    }

    /// The same with images of another size; `None` where there are none of it.
    pub(super) fn at_resolution(&self, args: &TrainArgs, resolution: u32) -> Option<Self> {
        let scene = SceneConfig { resolution: Some(resolution), ..self.scene.clone() };
        let dataset = scene::read(&args.scene, &scene, false).ok()?;
        let parameters = self.parameters.clone();
        let (settings, device) = (self.settings.clone(), self.device.clone());
        let (degree, images) = (self.degree.clone(), images(&dataset));
        Some(Self { dataset, images, scene, parameters, settings, device, degree, ..*self })
    }

    /// How the first rows are placed, unless a checkpoint says.
    pub(super) fn init(&self, args: &TrainArgs) -> InitChoice {
        match args.init {
            Some(init) => init.into(),
            None if self.dataset.points.is_empty() || args.init_points.is_some() => {
                InitChoice::Random
            }
            None => InitChoice::Points,
        }
    }

    /// Rows that the scene starts with, were there no limit; `None` where the limit decides.
    pub(super) fn start(&self, args: &TrainArgs) -> Option<usize> {
        match self.init(args) {
            InitChoice::Points => Some(self.usable),
            InitChoice::Random => args.init_points,
        }
    }

    fn initial_rows(&self, args: &TrainArgs, budget: usize) -> usize {
        self.start(args).unwrap_or_else(|| random_count(budget)).min(budget)
    }

    /// The scene as policies see it.
    pub(super) fn info(
        &self,
        args: &TrainArgs,
        budget: usize,
        initial_rows: usize,
    ) -> Result<SceneInfo, Failure> {
        Ok(SceneInfo {
            extent: self.dataset.extent() as f32,
            train_views: u32::try_from(self.dataset.train.len())
                .map_err(|_| Failure::input("the scene has more than 4 billion views"))?,
            budget,
            initial_rows,
            iterations: args.iterations,
            white_background: self.scene.background == Background::White,
        })
    }

    /// What a run with so many rows needs of its backend.
    pub(super) fn needs(&self, args: &TrainArgs, rows: usize) -> Result<Needs, Failure> {
        let scene = self.info(args, rows, self.initial_rows(args, rows))?;
        let policy = self.entry.build(&self.parameters, &scene)?;
        Ok(self.backend_needs(needs(policy.as_ref(), &scene, args.sh_every)))
    }

    /// The needs of a policy, and what the trainer needs beside them.
    pub(super) fn backend_needs(&self, needs: Needs) -> Needs {
        let signals = match self.required.rows {
            true => growth_signals().iter().fold(needs.signals, SignalSet::with),
            false => needs.signals,
        };
        Needs { signals, ..needs }
    }

    /// How the native backend is made.
    pub(super) fn cpu(&self, args: &TrainArgs, setting: &Setting, needs: Needs) -> CpuOptions {
        CpuOptions {
            budget: setting.rows,
            near: self.near(args),
            tile_cap: setting.tile_cap,
            record_cap: self.record_cap(setting),
            threads: args.threads.map(usize::from),
            largest_image: scene::largest_image(&self.dataset),
            storage: self.settings.storage(),
            needs,
            shortcuts: self.settings.shortcuts(),
            ..CpuOptions::new(setting.rows)
        }
    }

    /// How the GPU backend is made.
    pub(super) fn gpu(&self, args: &TrainArgs, setting: &Setting, needs: Needs) -> GpuOptions {
        GpuOptions {
            budget: setting.rows,
            near: self.near(args),
            tile_cap: Some(setting.tile_cap),
            largest_image: scene::largest_image(&self.dataset),
            photographs: self.kept_photographs(args, setting),
            needs,
            shortcuts: self.settings.shortcuts(),
        }
    }

    /// Gradient records for two pairs in five, where pairs are counted; else for all.
    fn record_cap(&self, setting: &Setting) -> usize {
        match self.settings.pairs_per_row() {
            Some(_) => (setting.tile_cap / 5 * 2).max(1),
            None => usize::MAX,
        }
    }

    /// What of the training images stays on a GPU: as much as decoded images may take on the host, and
    /// no more than their share of the device's memory.
    fn kept_photographs(&self, args: &TrainArgs, setting: &Setting) -> KeptPhotographs {
        let train = &self.dataset.train;
        let with_masks = train.iter().any(|view| view.source.mask.is_some());
        let one = KeptPhotographs::bytes(scene::largest_image(&self.dataset), with_masks);
        let room = args.memory.map_or(u64::MAX, |memory| memory / IMAGES).min(setting.image_cache);
        let count = usize::try_from(room / one.iter().sum::<u64>().max(1)).unwrap_or(usize::MAX);
        KeptPhotographs { count: count.min(train.len()), with_masks }
    }

    fn near(&self, args: &TrainArgs) -> f32 {
        (args.near * self.dataset.extent()) as f32
    }

    /// Everything that a run takes with these needs, on so many threads.
    pub(super) fn ledger(
        &self,
        args: &TrainArgs,
        setting: &Setting,
        needs: &Needs,
        threads: usize,
    ) -> Ledger {
        let degree = setting.sh_degree;
        let mut ledger = match &self.device {
            Some(device) => {
                GpuBackend::promise(degree, &self.gpu(args, setting, needs.clone()), device)
            }
            None => CpuBackend::promise(degree, &self.cpu(args, setting, needs.clone()), threads),
        };
        let [train, test] = self.images;
        let held = train.held(setting.image_cache);
        ledger.add_to(Section::Images, "decoded training views", held);
        ledger.add_to(Section::Images, "decoding", train.decoding(DECODERS));
        let budget = setting.rows as u64;
        let float = size_of::<f32>() as u64;
        let row = float * (11 + 3 * sh_coefficients(degree) as u64);
        if self.degree.bytes > 0 {
            let bytes = self.degree.bytes + train.held(0) + train.decoding(1);
            ledger.add_to(Section::Before, "colours of tracks", bytes);
        }
        let mut pass = |what: &str, bytes| ledger.add_to(Section::Passing, what, bytes);
        // Points, their order, neighbours in f64, and the rows before the backend has them.
        let first = self.initial_rows(args, setting.rows) as u64;
        let points = args.init_points.unwrap_or(self.dataset.points.len()) as u64;
        pass("first rows", points.max(first) * (POINT + 16) + first * (row + 96));
        pass("a policy's event", self.event_bytes(setting, needs));
        // So many rows, as much again because allocators keep some freed arrays for a while, and
        // what the writer holds.
        let piece = budget.min(ROWS_AT_A_TIME as u64);
        let held = PLY.held_bytes(Shape { rows: setting.rows, sh_degree: degree });
        pass("export of the model, checkpoint", 2 * piece * row + held);
        let measures_test = !self.dataset.test.is_empty();
        if measures_test || self.required != Required::default() {
            let (width, height) = scene::largest_image(&self.dataset);
            let rendering = u64::from(width) * u64::from(height) * 5 * float;
            let image = if measures_test { test.held(0) + test.decoding(1) } else { 0 };
            // While it is asked which rows are missed: their order, and their opacities twice or, when
            // that is done, a plan.
            let row = float + (2 * float).max(BYTES_PER_ROW as u64);
            let asked = if self.required.rows { budget * row } else { 0 };
            pass("measuring a view", rendering + image + scratch_bytes(width, threads) + asked);
        }
        let process = self.process_bytes();
        if let Some(beyond) = self.peak.and_then(|peak| peak.checked_sub(process)) {
            ledger.add_to(Section::Before, "loading the scene", beyond);
        }
        ledger.add_to(Section::Process, "program and dataset", process);
        ledger
    }

    /// Signals on the host, the plan, and what the policy makes of the former.
    fn event_bytes(&self, setting: &Setting, needs: &Needs) -> u64 {
        let float = size_of::<f32>() as u64;
        let candidate = size_of::<densify_policies::policy::Candidate>() as u64;
        let seed = size_of::<densify_policies::plan::Seed>() as u64;
        // The native backend has room for them.
        let signals = if self.device.is_some() { needs.signals.count() as u64 } else { 0 };
        // One auxiliary view's columns, and as many that a policy makes of them; all views' points.
        let aux = needs.aux.as_ref();
        let columns = aux.map_or(0, |request| 2 * request.columns.len()) as u64;
        let points = aux.map_or(0, |request| u64::from(request.points));
        // A point is kept by the policy, becomes a seed, and is compiled.
        setting.rows as u64 * ((signals + columns) * float + BYTES_PER_ROW as u64 + PLANNING)
            + points * self.dataset.train.len() as u64 * (candidate + 3 * seed)
    }

    /// The program and the dataset, but for what the ledger has besides. A number that does not
    /// depend on what else the process has done, where it takes no more than expected.
    fn process_bytes(&self) -> u64 {
        let Dataset { train, test, points, .. } = &self.dataset;
        let views = train.iter().chain(test);
        let rendered = |view: &View| view.source.rendered.as_ref().map_or(0, |image| image.bytes());
        // A view's name and path; it is there once more for its images.
        let view = |view: &View| (3 * size_of::<View>() + 512) as u64 + rendered(view);
        let expected = PROGRAM + views.map(view).sum::<u64>() + points.len() as u64 * POINT;
        let program = match self.resident {
            Some(resident) if resident > expected => resident.next_multiple_of(PROGRAM_STEP),
            _ => expected,
        };
        program + KEPT
    }

    /// What of a ledger `--memory` bounds: the device where there is one, else all of it.
    pub(super) fn bounded(&self, ledger: &Ledger) -> u64 {
        if self.device.is_some() { ledger.on_device() } else { ledger.total() }
    }

    /// Bytes of all training images decoded.
    pub(super) fn all_images(&self) -> u64 {
        self.images[0].all
    }
}

/// How a GPU is to add up gradients; `None` leaves that to it.
fn accumulation(args: &TrainArgs, settings: &Settings) -> Result<Option<Accumulation>, Failure> {
    match settings.accumulation() {
        Some(given) if args.deterministic && !given.is_deterministic() => {
            Err(Failure::input(format!(
                "--deterministic, which takes accumulation={}, and --knob accumulation={given} \
                 contradict each other; give one of them",
                Accumulation::Slots
            )))
        }
        _ if args.deterministic => Ok(Some(Accumulation::Slots)),
        given => Ok(given),
    }
}

fn images(dataset: &Dataset) -> [ImageDemand; 2] {
    let of = |views: &[View]| ImageDemand::of(views.iter().map(|view| &view.source));
    [of(&dataset.train), of(&dataset.test)]
}
