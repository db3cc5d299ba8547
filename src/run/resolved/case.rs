//! A run's description, with its inputs and all choices that do not depend on the size of the run.

use std::borrow::Cow;

use densify_policies::policy::{Needs, SceneInfo, SignalSet};
use densify_policies::registry::PolicyEntry;
use toml::Table;

use super::config::{ModelSize, RunConfig};
use super::degree::Degree;
use super::exposure::Exposure;
use super::fit::RunSize;
use super::inputs::{Evidence, Inputs, Reading, choose_moments, open_device};
use super::poses::RefinedPoses;
use super::size::MIN_ROWS;
use super::vignette::CameraVignettes;
use crate::failure::{Failure, ModelProblem, OptionProblem, SizeProblem};
use crate::host::Host;
use crate::near_plane::NearPlane;
use crate::position_rates::PositionRates;
use crate::spec::knobs::Knobs;
use crate::spec::{AbsolutePath, Budget, InitChoice, RunSpec, ShDegree};
use densify_core::antialiasing::Antialiasing;
use densify_core::budget::RowBudget;
use densify_core::memory::Ledger;
use densify_core::spelling::Spelling;
use densify_data::dataset::View;
use densify_train::exposure::ExposureChoice;
use densify_train::poses::PoseChoice;
use densify_train::schedule::Background;
use densify_train::trainer::{AutoChoices, FLOATER_BYTES, floater_request, growth_signals};
use densify_train::vignette::VignetteChoice;

/// Maximum number of random initial points without `--init-points` (Kerbl et al. 2023 use 100,000).
const RANDOM_POINTS: usize = 100_000;
/// Resident memory by which a process that resumes a run may exceed the process that began it `[bytes]`. The ledger
/// reserves more than this for the allocator.
const RESUME_TOLERANCE: u64 = 1 << 20;
/// Number of threads that decode training views ahead of the trainer.
pub(crate) const DECODERS: usize = 2;
/// Number of threads that decode test views.
pub(crate) const TEST_DECODERS: usize = 1;

/// A run before its size is known. Cases with other sizes and options share the inputs.
pub(crate) struct Case<'a> {
    /// The description, as the user gave it.
    pub(crate) spec: &'a RunSpec,
    pub(crate) inputs: Cow<'a, Inputs>,
    pub(crate) choices: Choices,
}

/// Decisions that do not depend on the size of the run.
#[derive(Clone)]
pub(crate) struct Choices {
    pub(crate) entry: &'static PolicyEntry,
    /// The policy's parameters that are set; the others have the policy's defaults.
    pub(crate) parameters: Table,
    pub(crate) knobs: Knobs,
    pub(crate) degree: Degree,
    pub(crate) exposure: Exposure,
    pub(crate) poses: RefinedPoses,
    pub(crate) vignette: CameraVignettes,
    pub(crate) antialiasing: Antialiasing,
    pub(crate) near: NearPlane,
    pub(crate) position_rates: PositionRates,
    /// Choices that the run makes while it trains.
    pub(crate) automatic: AutoChoices,
    /// Number of threads that train and measure.
    pub(crate) threads: usize,
}

/// The first Gaussians of a run, besides frozen ones.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Init {
    /// One on each point of the dataset.
    Points,
    /// At this many random points.
    Random(usize),
    /// The model of a file.
    Model(AbsolutePath),
}

impl Choices {
    /// Messages about the choices that depend on the scene.
    pub(super) fn lines(&self, spec: &RunSpec, spelling: Spelling) -> impl Iterator<Item = String> {
        let depths = self.near.line(spelling).into_iter().chain(self.position_rates.line());
        let light = self.exposure.line(spelling).into_iter().chain(self.vignette.line(spelling));
        depths.chain(self.degree.line()).chain(light).chain(self.poses.line(spec, spelling))
    }
}

/// Decisions by the evidence.
struct Decisions {
    degree: Degree,
    exposure: Exposure,
    vignette: CameraVignettes,
    poses: RefinedPoses,
}

impl<'a> Case<'a> {
    /// A new run.
    pub(super) fn for_new_run(spec: &'a RunSpec, host: Host<'_>) -> Result<Self, Failure> {
        let may_learn_exposures = spec.schedule.exposure != ExposureChoice::Off;
        let may_refine = spec.schedule.poses != PoseChoice::Fixed;
        let may_learn_vignettes = spec.schedule.vignette != VignetteChoice::Off;
        let reading = Reading {
            by_colours: Degree::is_by_colours(spec) || may_learn_exposures || may_learn_vignettes,
            by_directions: may_refine,
            colours: true,
            exif: may_learn_exposures,
            vignettes: may_learn_vignettes,
            ..Reading::default()
        };
        Self::open(spec, &reading, host, |evidence, views| Decisions {
            degree: Degree::decide(spec, None, evidence),
            exposure: Exposure::decide(spec, evidence),
            vignette: CameraVignettes::decide(spec, evidence),
            poses: RefinedPoses::decide(spec, evidence, views),
        })
    }

    /// A resumed run.
    pub(super) fn from_saved(
        spec: &'a RunSpec,
        saved: &RunConfig,
        has_checkpoint: bool,
        host: Host<'_>,
    ) -> Result<Self, Failure> {
        let decides_exposures = spec.schedule.exposure != ExposureChoice::Off && !has_checkpoint;
        let decides_poses = spec.schedule.poses != PoseChoice::Fixed && !has_checkpoint;
        let decides_vignettes = spec.schedule.vignette != VignetteChoice::Off && !has_checkpoint;
        let findings = &saved.resolved;
        let reading = Reading {
            // A checkpoint contains the rows of both models, so their files may no longer exist.
            models: Some([findings.init_model, findings.frozen]),
            by_colours: decides_exposures || decides_vignettes,
            by_directions: decides_poses,
            colours: true,
            exif: decides_exposures,
            vignettes: decides_vignettes,
            depth: Some(findings.depth.is_some()),
            tolerance: RESUME_TOLERANCE,
        };
        Self::open(spec, &reading, host, |evidence, views| Decisions {
            degree: Degree::decide(spec, Some(findings.sh_degree_from), evidence),
            exposure: if has_checkpoint {
                Exposure::known(findings.has_exposures, findings.exposure_from)
            } else {
                Exposure::decide(spec, evidence)
            },
            vignette: if has_checkpoint {
                CameraVignettes::known(findings.has_vignettes, findings.vignette_from)
            } else {
                CameraVignettes::decide(spec, evidence)
            },
            poses: if has_checkpoint {
                RefinedPoses::known(findings.refines_poses, findings.poses_from)
            } else {
                RefinedPoses::decide(spec, evidence, views)
            },
        })
    }

    /// A run whose models do not exist yet, for estimating its memory.
    pub(super) fn for_estimate(
        spec: &'a RunSpec,
        models: [Option<ModelSize>; 2],
        host: Host<'_>,
    ) -> Result<Self, Failure> {
        let has_exposures = spec.schedule.exposure != ExposureChoice::Off;
        let has_vignettes = spec.schedule.vignette != VignetteChoice::Off;
        let refines_poses = spec.schedule.poses != PoseChoice::Fixed;
        let reading = Reading {
            models: Some(models),
            by_colours: has_exposures || has_vignettes,
            by_directions: refines_poses,
            vignettes: has_vignettes,
            ..Reading::default()
        };
        let mut case = Self::open(spec, &reading, host, |evidence, _| Decisions {
            degree: Degree::decide(spec, None, evidence),
            exposure: Exposure::known(has_exposures, super::ExposureSource::Given),
            vignette: CameraVignettes::known(has_vignettes, super::VignetteSource::Given),
            poses: RefinedPoses::known(refines_poses, super::PoseSource::Given),
        })?;
        case.leave_out_this_process();
        Ok(case)
    }

    /// For a run that will be another process: what this one holds counts only if it includes a driver's kernels.
    pub(super) fn leave_out_this_process(&mut self) {
        if self.inputs.device.adapter().is_none() {
            let inputs = self.inputs.to_mut();
            (inputs.resident, inputs.peak) = (None, None);
        }
    }

    fn open(
        spec: &'a RunSpec,
        reading: &Reading,
        host: Host<'_>,
        decide: impl FnOnce(&Evidence, &[View]) -> Decisions,
    ) -> Result<Self, Failure> {
        let (entry, parameters) = spec.policy()?;
        let mut knobs = spec.knobs()?;
        check_automatic(spec)?;
        let device = open_device(spec, &mut knobs, host.observer)?;
        let (inputs, evidence) = Inputs::open(spec, device, reading, host)?;
        let Decisions { degree, exposure, vignette, poses } =
            decide(&evidence, &inputs.dataset.train);
        vignette.check(&inputs.dataset)?;
        drop(evidence);
        for note in &exposure.notes {
            host.observer.say(format_args!("note: {note}"));
        }
        let automatic = AutoChoices {
            rows: spec.size.budget.is_some_and(Budget::is_auto),
            scored_views: !spec.size.full,
        };
        let threads = spec.device.threads.map(|threads| threads.0 as usize);
        let threads = threads.unwrap_or_else(rayon::current_num_threads);
        let seen = inputs.dataset.seen_depths();
        let choices = Choices {
            entry,
            parameters,
            knobs,
            degree,
            exposure,
            poses,
            vignette,
            antialiasing: antialiasing(spec, &inputs)?,
            near: NearPlane::from_depths(spec.start.near, &seen),
            position_rates: PositionRates::choose(spec, &seen),
            automatic,
            threads,
        };
        let mut case = Self { spec, inputs: Cow::Owned(inputs), choices };
        let driver = case.driver_bytes(host)?;
        let inputs = case.inputs.to_mut();
        inputs.resident = inputs.resident.map(|bytes| bytes + driver);
        Ok(case)
    }

    /// Bytes of process memory that the device's driver uses for its kernels.
    fn driver_bytes(&self, host: Host<'_>) -> Result<u64, Failure> {
        if self.inputs.device.adapter().is_none() {
            return Ok(0);
        }
        let resident = || (host.process.resident)().unwrap_or(0);
        let before = resident();
        // Kernels depend on the signals, not on the number of rows.
        self.inputs.device.prove(
            &self.needs(MIN_ROWS)?,
            self.choices.knobs.storage,
            self.has_depth(),
        )?;
        Ok(resident().saturating_sub(before))
    }

    /// The same inputs with another description, which may differ in size, policy, knobs and resolution.
    pub(super) fn with<'b>(&'b self, spec: &'b RunSpec) -> Result<Case<'b>, Failure> {
        let inputs = if spec.data.resolution == self.spec.data.resolution {
            Cow::Borrowed(&*self.inputs)
        } else {
            Cow::Owned(self.inputs.at_resolution_of(spec)?)
        };
        let degree = if spec.size.sh_degree == self.spec.size.sh_degree {
            self.choices.degree.clone()
        } else {
            Degree::decide(spec, None, &Evidence::default())
        };
        let knobs = if spec.schedule.knob == self.spec.schedule.knob {
            self.choices.knobs.clone()
        } else {
            let mut knobs = spec.knobs()?;
            choose_moments(&mut knobs, inputs.device.kind());
            knobs
        };
        let (entry, parameters) = spec.policy()?;
        let choices = Choices { entry, parameters, knobs, degree, ..self.choices.clone() };
        Ok(Case { spec, inputs, choices })
    }

    /// The first rows of a run with this budget.
    pub(super) fn first_rows(&self, rows: usize) -> Init {
        match self.init() {
            InitChoice::Points => Init::Points,
            InitChoice::Random => Init::Random(
                self.wanted_initial_rows()
                    .unwrap_or_else(|| random_points(self.budget(rows).trainable())),
            ),
            InitChoice::Model(file) => Init::Model(file),
        }
    }

    fn init(&self) -> InitChoice {
        let start = &self.spec.start;
        if let Some(file) = &self.inputs.init_file {
            return InitChoice::Model(file.clone());
        }
        match &start.init {
            Some(init) => init.clone(),
            None if self.inputs.dataset.points.is_empty() || start.init_points.is_some() => {
                InitChoice::Random
            }
            None => InitChoice::Points,
        }
    }

    /// Number of rows that the scene starts with if nothing limits it; `None` if it depends on the budget.
    pub(super) fn wanted_initial_rows(&self) -> Option<usize> {
        match self.init() {
            InitChoice::Model(_) => self.inputs.init_model.map(|model| model.rows),
            InitChoice::Points => Some(self.inputs.usable_points),
            InitChoice::Random => self.spec.start.init_points.map(|points| points.0),
        }
    }

    /// Number of rows to start with, without frozen ones.
    pub(super) fn initial_rows(&self, rows: usize) -> usize {
        let trainable = self.budget(rows).trainable();
        self.wanted_initial_rows().unwrap_or_else(|| random_points(trainable)).min(trainable)
    }

    /// A budget of this many rows, frozen ones included.
    pub(crate) fn budget(&self, total: usize) -> RowBudget {
        RowBudget { total, frozen: self.frozen_rows() }
    }

    /// The total budget, frozen rows included, in which this many rows can be trained.
    pub(super) fn rows_for(&self, trainable: usize) -> usize {
        RowBudget::for_trainable(trainable, self.frozen_rows()).total
    }

    fn frozen_rows(&self) -> usize {
        self.inputs.frozen_model.map_or(0, |model| model.rows)
    }

    /// The scene as policies see it, without frozen rows.
    pub(super) fn scene(&self, rows: usize, initial_rows: usize) -> Result<SceneInfo, Failure> {
        let dataset = &self.inputs.dataset;
        Ok(SceneInfo {
            extent: dataset.extent() as f32,
            train_views: u32::try_from(dataset.train.len())
                .map_err(|_| SizeProblem::TooManyViews)?,
            budget: self.budget(rows).trainable().max(1),
            initial_rows,
            iterations: self.spec.schedule.iterations.0,
            white_background: self.spec.data.background == Background::White,
        })
    }

    /// The ledger of a run of this size.
    pub(crate) fn ledger_of(&self, size: &RunSize) -> Result<Ledger, Failure> {
        Ok(self.ledger(size, &self.needs(size.rows)?))
    }

    /// The needs of a run with this budget: the signals and terms that its backend computes.
    pub(crate) fn needs(&self, rows: usize) -> Result<Needs, Failure> {
        let scene = self.scene(rows, self.initial_rows(rows))?;
        let policy = self.choices.entry.build(&self.choices.parameters, &scene)?;
        Ok(self.backend_needs(policy.needs(&scene)))
    }

    /// The needs of a policy, plus those of the trainer.
    pub(crate) fn backend_needs(&self, needs: Needs) -> Needs {
        let signals = if self.choices.automatic.rows {
            growth_signals().iter().fold(needs.signals, SignalSet::with)
        } else {
            needs.signals
        };
        if !self.spec.depth.remove_floaters {
            return Needs { signals, ..needs };
        }
        let own = floater_request();
        let mut aux = needs.aux.clone().unwrap_or_default();
        aux.columns.extend(own.columns);
        let scratch_bytes = needs.scratch_bytes + FLOATER_BYTES;
        Needs { signals, aux: Some(aux), scratch_bytes, ..needs }
    }
}

/// Default number of random points to start from.
fn random_points(trainable: usize) -> usize {
    (trainable / 2).clamp(1, RANDOM_POINTS)
}

/// Fails if an automatic choice contradicts `--full` or `--freeze`, or options about poses contradict others.
fn check_automatic(spec: &RunSpec) -> Result<(), Failure> {
    let is_auto_budget = spec.size.budget.is_some_and(Budget::is_auto);
    let is_auto_degree = matches!(spec.size.sh_degree, Some(ShDegree::Auto(_)));
    for (is_auto, option) in [(is_auto_budget, "budget"), (is_auto_degree, "sh_degree")] {
        if spec.size.full && is_auto {
            return Err(OptionProblem::AutomaticWithFull { option }.into());
        }
    }
    if is_auto_budget && spec.start.freeze.is_some() {
        return Err(OptionProblem::AutoBudgetWithFreeze.into());
    }
    if spec.schedule.poses != PoseChoice::Fixed && spec.start.freeze.is_some() {
        return Err(OptionProblem::PosesWithFreeze { choice: spec.schedule.poses }.into());
    }
    if spec.schedule.refine_focal && spec.schedule.poses == PoseChoice::Fixed {
        return Err(OptionProblem::FocalWithoutPoses.into());
    }
    Ok(())
}

/// The antialiasing of the run: that of the option, or else that of the models that the run starts from.
///
/// # Errors
/// When the models of `--init` and `--freeze` differ and no option decides.
fn antialiasing(spec: &RunSpec, inputs: &Inputs) -> Result<Antialiasing, Failure> {
    let models = [inputs.init_model, inputs.frozen_model];
    match (spec.start.antialias, models.map(|model| model.map(|model| model.antialiasing))) {
        (Some(given), _) => Ok(given),
        (None, [Some(init), Some(frozen)]) if init != frozen => {
            Err(ModelProblem::AntialiasingDiffers { init, frozen }.into())
        }
        (None, [init, frozen]) => Ok(init.or(frozen).unwrap_or_default()),
    }
}
