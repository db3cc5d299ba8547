//! A prepared run.

use std::path::PathBuf;
use std::time::Instant;

use cpu_time::ProcessTime;

use super::records::{Lengths, Spent, Totals, Unwritten};
use super::resume::Resumed;
use super::{Occupied, prepare, train};
use crate::failure::Failure;
use crate::host::Host;
use crate::observer::{Observer, check_interrupt};
use crate::process::ProcessMemory;
use crate::resolved::{GeometryMeasurement, RunConfig};
use crate::spec::RunSpec;
use densify_core::gaussians::Gaussians;
use densify_core::memory::Ledger;
use densify_data::dataset::Dataset;
use densify_data::models::Coordinates;
use densify_data::views::DatasetViews;
use densify_train::checkpoint::Fingerprint;
use densify_train::trainer::{StepReport, TrainError, Trainer};

/// Steps between two records of the log.
const RECORD_EVERY: u32 = 10;

/// A run, ready to train.
pub struct Run {
    /// The description, as the user gave it.
    pub(super) spec: RunSpec,
    /// The run with every choice made, as in `config.toml`.
    pub config: RunConfig,
    pub(super) output: PathBuf,
    /// The trainer.
    pub trainer: Trainer<DatasetViews>,
    /// The test views.
    pub(super) test: DatasetViews,
    /// The dataset, with at most as many points as the companion (such as the page of `--view`) asks for.
    pub dataset: Dataset,
    /// The bytes of every buffer; the run takes no more than their [total](Ledger::total).
    pub ledger: Ledger,
    /// The measurement against the known surface at the end, if there is such a surface.
    pub(super) geometry_measurement: Option<GeometryMeasurement>,
    /// Identifies the dataset in checkpoints.
    pub(super) fingerprint: Fingerprint,
    /// The step at which the run ends.
    pub last: u32,
    /// Sums and scores so far.
    pub(super) totals: Totals,
    /// Edits and records of steps that were done before the logs were opened.
    pub(super) unwritten: Unwritten,
    /// Lengths of the logs in the run's folder, for a run that was resumed or has saved a checkpoint.
    pub(super) logs: Option<Lengths>,
    /// Step of the last checkpoint that this run has written or resumed from.
    pub(super) checkpoint: Option<u32>,
    /// Step of the newest checkpoint in the run's folder, as this run has left or found it.
    pub(super) newest_checkpoint: Option<u32>,
    pub(super) process: ProcessMemory,
}

impl Run {
    /// Prepares a new run: opens scene and device, decides the run's size, and makes the trainer. Nothing is written.
    ///
    /// # Errors
    /// When the description, one of its files or the device is unsuitable.
    pub fn prepare(spec: &RunSpec) -> Result<Self, Failure> {
        Self::prepare_on(spec, None, Host::default())
    }

    /// Prepares a run on `host`. If `resumed` is given, it continues the run that [`start`](crate::start) found.
    ///
    /// # Errors
    /// As [`prepare`](Self::prepare), and when the options would change the result of the run being resumed.
    pub fn prepare_on(
        spec: &RunSpec,
        resumed: Option<Resumed>,
        host: Host<'_>,
    ) -> Result<Self, Failure> {
        prepare::prepare(spec, resumed, host)
    }

    /// Does one step. Its edits and its record are written with the next checkpoint, or when [`train`](Self::train) begins.
    ///
    /// # Errors
    /// As [`Trainer::step`].
    pub fn step(&mut self) -> Result<StepReport, TrainError> {
        let (wall, cpu) = (Instant::now(), ProcessTime::try_now().ok());
        let stepped = self.trainer.step();
        self.totals.add(Spent::since(wall, cpu));
        for &(stage, time) in self.trainer.backend().stage_times() {
            self.totals.stage(stage, time);
        }
        let report = stepped?;
        self.totals.step(&report.output, self.dataset.train.len());
        self.unwritten.events.extend_from_slice(&report.events);
        // The original end of an extended run has a record, too, so that records do not depend on the extension.
        let ends = [self.spec.schedule.iterations.0, self.last];
        if report.step.is_multiple_of(RECORD_EVERY) || ends.contains(&report.step) {
            let resident = (self.process.resident)();
            self.unwritten.records.push(self.totals.record(report.step, report.rows, resident));
        }
        Ok(report)
    }

    /// Trains to the end, writes nothing, and returns the model in the dataset's own coordinates. In a scene far from
    /// the origin, these coordinates are local unless the description asks for world coordinates.
    ///
    /// # Errors
    /// When a view cannot be read, the device fails, or the observer asks to stop.
    pub fn model_after_training(mut self, observer: &dyn Observer) -> Result<Gaussians, Failure> {
        while self.trainer.steps_done() < self.last {
            check_interrupt(observer)?;
            self.trainer.step()?;
        }
        let to_world = self.dataset.normalisation;
        let is_world = self.spec.output.coordinates == Coordinates::World || !to_world.is_remote();
        let origin = if is_world { [0.0; 3] } else { to_world.local_origin() };
        Ok(to_world.world_from_model(self.trainer.model()?, origin))
    }

    /// Trains to the end, writes all files of the run, and returns its folder; `if_exists` decides about an existing
    /// run.
    ///
    /// # Errors
    /// When a view cannot be read, or the device, the disk or the policy fails. The error names the files that were
    /// written until then; these files stay.
    pub fn train(self, if_exists: Occupied, observer: &dyn Observer) -> Result<PathBuf, Failure> {
        train(self, if_exists, observer)
    }
}
