//! A run as data, and how it becomes one: a description is resolved to sizes, built into a trainer, and
//! trained to the end. Knows no subcommand and prints nothing; an [`Observer`] hears what there is to say.

mod companion;
mod config;
mod derived;
mod device;
pub mod failure;
pub mod finished;
pub mod knobs;
pub mod likeness;
mod measuring;
pub mod memory;
mod observer;
mod overlay;
mod prepare;
mod records;
mod report;
mod resolve;
mod resume;
mod session;
mod spec;
mod start;
mod summary;
mod values;

use std::path::PathBuf;

pub use companion::{Companion, CompanionSize};
pub use config::{DegreeSource, ExposureSource, ModelSize, Resolved, RunConfig};
pub use observer::{Between, Interrupt, Observer, Silent};
pub use overlay::Partial;
pub use report::Reductions;
pub use report::{LeftOut, Requirements};
pub use resolve::promised_bytes;
pub use resolve::{Alternatives, DEFAULT_BUDGET, Plan, plan};
pub use resolve::{promised, use_threads};
pub use resume::{Resumed, start};
pub use session::Occupied;
pub use spec::{
    DataSpec, DeviceSpec, OPTIONS, OnResume, OutputSpec, PolicySpec, RunOption, RunSpec,
    ScheduleSpec, SizeSpec, StartSpec,
};
pub use values::{
    AbsolutePath, Assignment, Budget, ByteCount, Fraction, ImageCache, InitChoice, Rows, ShDegree,
    Threads, Whole,
};

use crate::failure::Failure;
use densify_core::gaussians::Gaussians;
use densify_core::memory::Ledger;
use densify_data::dataset::Dataset;
use densify_data::views::DatasetViews;
use densify_train::checkpoint::Fingerprint;
use densify_train::trainer::Trainer;
use measuring::Measuring;

/// A run, ready to train.
pub struct Run {
    config: RunConfig,
    output: PathBuf,
    trainer: Trainer<DatasetViews>,
    /// The test views.
    test: DatasetViews,
    /// Everything of the dataset but its points, of which a page gets some.
    dataset: Dataset,
    ledger: Ledger,
    /// How the model is measured at the end, where the surface is known.
    measuring: Option<Measuring>,
    /// What the dataset is, for checkpoints.
    fingerprint: Fingerprint,
    /// The step at which the run ends.
    last: u32,
    /// What the logs were, for a run that goes on.
    session: Option<records::SavedSession>,
}

impl Run {
    /// Prepares a new run: opens scene and device, decides its size, and makes the trainer. Nothing is
    /// written.
    ///
    /// # Errors
    /// Everything that can be wrong with the description, its files and the device.
    pub fn prepare(spec: &RunSpec) -> Result<Self, Failure> {
        Self::prepare_observed(spec, None, None, &Silent)
    }

    /// The same, and says what there is to say. With `resumed` it goes on with the run that [`start`] has
    /// found. The memory of a `companion` is in the ledger.
    ///
    /// # Errors
    /// As [`prepare`](Self::prepare), and when it would give another result than the run that goes on.
    pub fn prepare_observed(
        spec: &RunSpec,
        resumed: Option<Resumed>,
        companion: Option<Companion>,
        observer: &dyn Observer,
    ) -> Result<Self, Failure> {
        prepare::build(spec, resumed, companion, observer)
    }

    /// Bytes per buffer, as promised.
    #[must_use]
    pub fn ledger(&self) -> &Ledger {
        &self.ledger
    }

    /// What it is, with nothing open.
    pub fn config(&self) -> &RunConfig {
        &self.config
    }

    /// The dataset; of its points, those that a page draws.
    pub fn dataset(&self) -> &Dataset {
        &self.dataset
    }

    /// Those points of the dataset that a page draws, if there is one.
    pub fn take_points(&mut self) -> densify_data::dataset::PointCloud {
        std::mem::take(&mut self.dataset.points)
    }

    /// The trainer.
    pub fn trainer(&mut self) -> &mut Trainer<DatasetViews> {
        &mut self.trainer
    }

    /// Trains to the end, writes nothing, and returns the model in the dataset's own coordinates.
    ///
    /// # Errors
    /// When a view cannot be read, the device fails, or the observer asks to stop.
    pub fn model_after_training(mut self, observer: &dyn Observer) -> Result<Gaussians, Failure> {
        while self.trainer.steps_done() < self.last {
            if let Some(Interrupt { name, exit_code }) = observer.interrupt() {
                let message = format!("stopped by {name}; nothing was written");
                return Err(Failure { code: exit_code, message });
            }
            self.trainer.step()?;
        }
        Ok(self.dataset.normalisation.world_from_model(self.trainer.model()?))
    }

    /// Trains to the end and writes everything that a run leaves; returns its folder.
    ///
    /// # Errors
    /// When a view cannot be read, the device or the disk fails, or the policy does. What was written
    /// until then stays, and is named.
    pub fn train(self, occupied: Occupied, observer: &dyn Observer) -> Result<PathBuf, Failure> {
        session::train(self, occupied, observer)
    }
}
