//! From a description to sizes: the scene and the device are opened, and rows, degree, tile lists and image
//! cache follow, with the ledger of what they take. Nothing is written.

mod degree;
mod exposure;
mod ledger;
mod plan;
mod remedy;
mod size;
#[cfg(test)]
mod tests;

use std::path::Path;

use densify_policies::policy::{Needs, SceneInfo, SignalSet};
use densify_policies::registry::PolicyEntry;
use toml::Table;

pub use plan::promised;
pub use plan::promised_bytes;
pub use plan::{Alternatives, Plan, plan};
pub use size::DEFAULT_BUDGET;
pub(super) use size::{Size, check, check_grant};

use super::companion::Companion;
use super::config::{ModelSize, RunConfig};
use super::observer::Observer;
use super::spec::{RunSpec, StartSpec};
use super::start::size_of_model;
use super::values::{Budget, InitChoice, ShDegree, Threads};
use crate::failure::Failure;
use crate::knobs::Knobs;
use degree::Degree;
use densify_core::memory::{peak_resident, resident};
use densify_core::numbers::grouped;
use densify_data::dataset::images::ImageDemand;
use densify_data::dataset::{Dataset, ReportedExposures, Tracks, View};
use densify_data::track_colours;
use densify_data::track_colours::{MIN_TRACKS, TrackColours};
use densify_render::Accumulation;
use densify_render::{BackendKind, Device};
use densify_train::exposure::ExposureChoice;
use densify_train::init::usable_points;
use densify_train::schedule::Background;
use densify_train::trainer::{AutoChoices, growth_signals};
use exposure::Exposure;

/// Most points of a random initialisation, where none is given (Kerbl et al. 2023 use 100,000).
const RANDOM_POINTS: usize = 100_000;
/// How much more memory a process that goes on with a run may be found to take than the one that began it, without being
/// refused its own run. The room that the ledger keeps for the allocator is larger.
const UNSTEADY: u64 = 1 << 20;
/// Threads that decode training views ahead of the trainer.
pub(super) const DECODERS: usize = 2;
/// Threads that decode test views.
pub(super) const TEST_DECODERS: usize = 1;

/// What is known of a run before its scene is read.
#[derive(Debug, Clone, Copy)]
pub(super) struct Known<'a> {
    /// How it was prepared.
    pub(super) config: &'a RunConfig,
    /// What becomes of what its photographs begin with.
    pub(super) exposures: Begun,
}

/// What photographs begin with is in no file but a checkpoint.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Begun {
    /// A checkpoint has it.
    Kept,
    /// There is none yet: it is found again.
    Anew,
    /// Only the bytes that finding it takes are asked for.
    Reckoned,
}

/// What a run starts from, before its size is known.
pub(super) struct Inputs<'a> {
    pub(super) spec: &'a RunSpec,
    pub(super) entry: &'static PolicyEntry,
    /// The policy's parameters as set.
    pub(super) parameters: Table,
    pub(super) knobs: Knobs,
    pub(super) device: Device,
    pub(super) dataset: Dataset,
    pub(super) degree: Degree,
    pub(super) exposure: Exposure,
    /// Bytes that the colours of tracks took before, beside an image, where they decide something.
    track_bytes: u64,
    /// What the run is to find out by itself.
    pub(super) required: AutoChoices,
    /// What training and test images take.
    pub(super) images: [ImageDemand; 2],
    /// The model that the run starts from, if it is one.
    pub(super) init_model: Option<ModelSize>,
    /// The model whose Gaussians never change, if there is one.
    pub(super) frozen: Option<ModelSize>,
    /// Rows that a start on the dataset's points would have, were there no limit.
    usable: usize,
    /// Resident memory with the dataset and a device's driver, and the most before that had its kernels.
    resident: Option<u64>,
    peak: Option<u64>,
    /// What stays beside the run.
    companion: Option<Companion>,
}

impl<'a> Inputs<'a> {
    /// Opens the device and loads the dataset. `known` is of a run that goes on, or is only reckoned.
    pub(super) fn load(
        spec: &'a RunSpec,
        known: Option<Known<'_>>,
        companion: Option<Companion>,
        observer: &dyn Observer,
    ) -> Result<Self, Failure> {
        let saved = known.map(|known| known.config);
        let exposures = known.map_or(Begun::Anew, |known| known.exposures);
        let kept = known.filter(|_| exposures != Begun::Anew).map(|known| known.config);
        let (entry, parameters) = spec.policy()?;
        let mut knobs = spec.knobs()?;
        check_automatic(spec)?;
        let device = open(spec, &mut knobs, observer)?;
        use_threads(spec.device.threads);
        let scene = spec.scene()?;
        let is_exposed = spec.schedule.exposure != ExposureChoice::Off;
        let with_tracks = spec.size.sh_degree == Some(ShDegree::Auto(None)) && saved.is_none()
            || is_exposed && exposures != Begun::Kept;
        let mut dataset = Dataset::load(scene, &spec.data.load_options(with_tracks))?;
        for note in &dataset.notes {
            observer.say(format_args!("note: {note}"));
        }
        observer.say(format_args!("scene    {}: {}", scene.display(), dataset.describe()));
        let usable = usable_points(&dataset.points);
        let images = images(&dataset);
        let StartSpec { init, freeze, .. } = &spec.start;
        let size = |flag, file: Option<&Path>| {
            file.map(|file| size_of_model(flag, file, observer)).transpose()
        };
        let (init_model, frozen) = match saved {
            // It has their rows; the files may be gone.
            Some(saved) => (saved.resolved.init_model, saved.resolved.frozen),
            None => (
                size("--init", init.as_ref().and_then(InitChoice::file))?,
                size("--freeze", freeze.as_ref().map(|file| &*file.0))?,
            ),
        };
        // Tracks have a line of their own, and are given back.
        let is_resumed = saved.is_some() && exposures != Begun::Reckoned;
        let apart = dataset.tracks.bytes() + if is_resumed { UNSTEADY } else { 0 };
        let resident = resident().map(|now| now.saturating_sub(apart));
        let peak = peak_resident();
        let colours = match dataset.tracks.count() {
            ..MIN_TRACKS => None,
            _ if exposures == Begun::Reckoned => None,
            _ => Some(TrackColours::read(&dataset.tracks, &dataset.train)?),
        };
        let track_bytes = if with_tracks {
            dataset.tracks.bytes() + track_colours::bytes(&dataset.tracks)
        } else {
            0
        };
        let degree = Degree::decide(spec, saved, &dataset, colours.as_ref());
        let reported = match is_exposed && exposures == Begun::Anew {
            true => ReportedExposures::read(&dataset.train),
            false => ReportedExposures::default(),
        };
        let exposure = Exposure::decide(spec, kept, colours.as_ref(), &reported);
        for note in exposure.notes() {
            observer.say(format_args!("note: {note}"));
        }
        dataset.tracks = Tracks::default();
        let required = AutoChoices {
            rows: spec.size.budget.is_some_and(Budget::is_auto),
            scored_views: !spec.size.full,
        };
        let mut inputs = Self {
            spec,
            entry,
            parameters,
            knobs,
            device,
            dataset,
            degree,
            exposure,
            track_bytes,
            required,
            images,
            init_model,
            frozen,
            usable,
            resident,
            peak,
            companion,
        };
        let driver = inputs.driver_bytes()?;
        inputs.resident = inputs.resident.map(|bytes| bytes + driver);
        Ok(inputs)
    }

    /// What a device's driver takes of the process for its kernels.
    fn driver_bytes(&self) -> Result<u64, Failure> {
        if self.device.adapter().is_none() {
            return Ok(0);
        }
        let before = resident().unwrap_or(0);
        // Kernels depend on which signals there are, not on how many rows.
        self.device.prove(&self.needs(size::LEAST_ROWS)?)?;
        Ok(resident().unwrap_or(0).saturating_sub(before))
    }

    /// The same scene on the same device, with other options of size, policy, knobs or resolution.
    fn with(&self, spec: &'a RunSpec) -> Result<Self, Failure> {
        let is_same = spec.data.resolution == self.spec.data.resolution;
        let dataset = match is_same {
            true => self.dataset.clone(),
            false => Dataset::load(spec.scene()?, &spec.data.load_options(false))?,
        };
        let degree = match spec.size.sh_degree == self.spec.size.sh_degree {
            true => self.degree.clone(),
            false => Degree::decide(spec, None, &dataset, None),
        };
        let knobs = match spec.schedule.knob == self.spec.schedule.knob {
            true => self.knobs.clone(),
            false => spec.knobs()?,
        };
        let (entry, parameters) = spec.policy()?;
        let (images, device) = (images(&dataset), self.device.clone());
        let exposure = self.exposure.clone();
        Ok(Self {
            spec,
            entry,
            parameters,
            knobs,
            dataset,
            degree,
            exposure,
            images,
            device,
            ..*self
        })
    }

    /// What there is to say of what the scene's colours have decided.
    pub(super) fn choices(&self) -> impl Iterator<Item = String> {
        self.degree.line().into_iter().chain(self.exposure.line())
    }

    /// What the first rows are.
    pub(super) fn init(&self) -> InitChoice {
        let start = &self.spec.start;
        match &start.init {
            Some(init) => init.clone(),
            None if self.dataset.points.is_empty() || start.init_points.is_some() => {
                InitChoice::Random
            }
            None => InitChoice::Points,
        }
    }

    /// Rows that the scene starts with, were there no limit; `None` where the limit decides.
    fn start(&self) -> Option<usize> {
        match self.init() {
            InitChoice::Model(_) => self.init_model.map(|model| model.rows),
            InitChoice::Points => Some(self.usable),
            InitChoice::Random => self.spec.start.init_points.map(|points| points.0),
        }
    }

    /// Rows to start with beside the frozen ones.
    fn initial_rows(&self, budget: usize) -> usize {
        let room = budget.saturating_sub(self.frozen_rows());
        self.start().unwrap_or_else(|| random_count(room)).min(room)
    }

    /// Rows that never change.
    pub(super) fn frozen_rows(&self) -> usize {
        self.frozen.map_or(0, |model| model.rows)
    }

    /// The scene as policies see it, who know nothing of frozen rows.
    pub(super) fn info(&self, budget: usize, initial_rows: usize) -> Result<SceneInfo, Failure> {
        Ok(SceneInfo {
            extent: self.dataset.extent() as f32,
            train_views: u32::try_from(self.dataset.train.len())
                .map_err(|_| Failure::input("the scene has more than 4 billion views"))?,
            budget: budget.saturating_sub(self.frozen_rows()).max(1),
            initial_rows,
            iterations: self.spec.schedule.iterations.0,
            white_background: self.spec.data.background == Background::White,
        })
    }

    /// What a run with so many rows needs of its backend.
    pub(super) fn needs(&self, rows: usize) -> Result<Needs, Failure> {
        let scene = self.info(rows, self.initial_rows(rows))?;
        let policy = self.entry.build(&self.parameters, &scene)?;
        Ok(self.backend_needs(policy.needs(&scene)))
    }

    /// The needs of a policy, and what the trainer needs beside them.
    pub(super) fn backend_needs(&self, needs: Needs) -> Needs {
        let signals = match self.required.rows {
            true => growth_signals().iter().fold(needs.signals, SignalSet::with),
            false => needs.signals,
        };
        Needs { signals, ..needs }
    }

    /// Threads that train and measure.
    pub(super) fn threads(&self) -> usize {
        self.spec
            .device
            .threads
            .map_or_else(rayon::current_num_threads, |threads| threads.0 as usize)
    }
}

/// Rows of a random start within a budget, where no number is given.
pub(super) fn random_count(budget: usize) -> usize {
    (budget / 2).clamp(1, RANDOM_POINTS)
}

/// Limits rayon's common pool, which measuring uses, to the threads the user grants.
pub fn use_threads(threads: Option<Threads>) {
    if let Some(threads) = threads {
        // It fails only if the pool is in use already; then its size is what it is.
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads.0 as usize);
        let _ = pool.build_global();
    }
}

/// Opens the device, and checks that it has the knobs that are set.
fn open(spec: &RunSpec, knobs: &mut Knobs, observer: &dyn Observer) -> Result<Device, Failure> {
    let accumulation = match (spec.schedule.deterministic, knobs.accumulation) {
        (true, Some(given)) if !given.is_deterministic() => {
            return Err(Failure::input(format!(
                "--deterministic, which takes accumulation={}, and --knob accumulation={given} \
                 contradict each other; give one of them",
                Accumulation::Slots
            )));
        }
        (true, _) => Some(Accumulation::Slots),
        (false, given) => given,
    };
    let device = Device::open(spec.device.backend, spec.device.gpu.as_deref(), accumulation)?;
    observer.say(format_args!("device   {}", device.describe()));
    check_knobs(knobs, device.kind())?;
    if let Some(taken) = device.accumulation() {
        knobs
            .set("accumulation", taken.name())
            .map_err(|error| Failure::input(format!("--knob: {error}")))?;
        let note = match taken.is_deterministic() {
            true => "runs are reproducible byte for byte",
            false => "results vary slightly between runs; --deterministic makes them reproducible",
        };
        observer.say(format_args!("sums     accumulation={taken}: {note}"));
    }
    Ok(device)
}

/// Fails where a knob is set that this backend does not have.
fn check_knobs(knobs: &Knobs, kind: BackendKind) -> Result<(), Failure> {
    for (knob, value) in knobs.changed() {
        if let Some(other) = BackendKind::only_one_with(knob.name).filter(|only| *only != kind) {
            return Err(Failure::input(format!(
                "--knob: knob {name}={value}: the {} backend does not have it; the nearest that works \
                 there is {name}={}, or use --backend {}",
                kind.name(),
                knob.default,
                other.choice().word(),
                name = knob.name,
            )));
        }
    }
    Ok(())
}

/// Fails where what is automatic contradicts `--full` or `--freeze`.
fn check_automatic(spec: &RunSpec) -> Result<(), Failure> {
    let is_auto_budget = spec.size.budget.is_some_and(Budget::is_auto);
    let is_auto_degree = matches!(spec.size.sh_degree, Some(ShDegree::Auto(_)));
    for (is_given, option, other) in [
        (is_auto_budget, "--budget auto", "with a number of Gaussians"),
        (is_auto_degree, "--sh-degree auto", "with --sh-degree 3"),
    ] {
        if spec.size.full && is_given {
            return Err(Failure::input(format!(
                "--full disables automatic reductions, and {option} is one; give one of the two, or --full \
                 {other}"
            )));
        }
    }
    if is_auto_budget && spec.start.freeze.is_some() {
        return Err(Failure::input(
            "--budget auto asks of all Gaussians what each is worth, and --freeze keeps some whatever it is; give \
             --budget a number of Gaussians",
        ));
    }
    Ok(())
}

fn images(dataset: &Dataset) -> [ImageDemand; 2] {
    let demand = |views: &[View]| ImageDemand::total(views.iter().map(|view| &view.source));
    [demand(&dataset.train), demand(&dataset.test)]
}

/// What the log says of points that were not used, by number.
pub(super) fn ignored(number: usize, reason: &str) -> String {
    format!("note: {} {reason}", grouped(number))
}
