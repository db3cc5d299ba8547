//! A run with every choice made. [`Inputs`] are the device and the dataset; a [`Case`] adds the description and the
//! choices that do not depend on the run's size; a [`ResolvedRun`] adds the size. The ledger is a function of inputs,
//! choices and size. Nothing is written.

mod case;
mod config;
mod coordinates;
mod degree;
mod estimate;
mod exposure;
mod fit;
mod geometry_measurement;
mod inputs;
mod ledger;
mod models;
mod plan;
mod poses;
mod remedy;
mod size;
mod sources;
#[cfg(test)]
mod tests;
mod training;
mod trial;
mod vignette;

pub(crate) use case::{Case, DECODERS, Init, TEST_DECODERS};
#[cfg(test)]
pub(crate) use config::tests::sample;
pub use config::{Findings, ModelSize, RunConfig};
pub(crate) use coordinates::random_points;
pub use estimate::{Extent, estimate, extent};
pub(crate) use fit::RunSize;
pub(crate) use geometry_measurement::GeometryMeasurement;
pub(crate) use models::{importance_setup, read};
pub use plan::{Alternatives, Plan, plan};
pub use size::DEFAULT_BUDGET;
pub use sources::{DegreeSource, DegreeTrial, ExposureSource, PoseSource, VignetteSource};
pub(crate) use training::ResolvedTraining;
pub(crate) use trial::TrialRuns;

use crate::failure::Failure;
use crate::host::Host;
use crate::spec::RunSpec;
use size::Size;
use trial::HELD_OUT;

/// A run with every choice made, before its first model exists.
pub(crate) struct ResolvedRun<'a> {
    pub(crate) case: Case<'a>,
    /// Rows, degree, tile lists and image cache.
    pub(crate) size: RunSize,
    /// The first Gaussians.
    pub(crate) init: Init,
    /// True if `--memory` made the degree lower than requested.
    pub(crate) degree_lowered: bool,
    /// Lines for the user: the reasons for the size, and the choices that depend on the scene.
    pub(crate) reasons: Vec<String>,
}

impl<'a> ResolvedRun<'a> {
    /// Resolves a new run.
    ///
    /// # Errors
    /// When options contradict each other, something cannot be opened, or no model fits.
    pub(crate) fn for_new_run(spec: &'a RunSpec, host: Host<'_>) -> Result<Self, Failure> {
        let case = Case::for_new_run(spec, host)?;
        let size = Size::choose(&case)?;
        let degree_lowered = size.is_lowered(&case);
        Ok(Self::new(case, &size, degree_lowered, host))
    }

    /// Resolves a trial run. It has images of half the size, of which one in [`HELD_OUT`] is not trained on but tested.
    ///
    /// # Errors
    /// As [`for_new_run`](Self::for_new_run).
    pub(crate) fn for_trial(&'a self, spec: &'a RunSpec, host: Host<'_>) -> Result<Self, Failure> {
        let mut case = self.case.with(spec)?;
        case.halve_and_hold_out(HELD_OUT);
        let mut size = Size::as_given(&case)?;
        size.run_size.images_on_gpu = self.size.images_on_gpu;
        Ok(Self::new(case, &size, false, host))
    }

    /// Resolves a resumed run with the choices of `saved`. `spec` is the saved description overlaid with the options
    /// given now. Only a checkpoint contains the exposures and vignettes; without it, the initial ones are determined again.
    ///
    /// # Errors
    /// As [`for_new_run`](Self::for_new_run).
    pub(crate) fn from_saved(
        spec: &'a RunSpec,
        saved: &RunConfig,
        has_checkpoint: bool,
        host: Host<'_>,
    ) -> Result<Self, Failure> {
        let case = Case::from_saved(spec, saved, has_checkpoint, host)?;
        let size = Size::as_given(&case)?;
        Ok(Self::new(case, &size, saved.resolved.sh_degree_lowered, host))
    }

    /// Resolves a run whose models of `--init` and `--freeze` do not exist yet, to estimate its memory. Exposures are
    /// counted if they may be learned.
    ///
    /// # Errors
    /// As [`for_new_run`](Self::for_new_run).
    pub(crate) fn for_estimate(
        spec: &'a RunSpec,
        models: [Option<ModelSize>; 2],
        host: Host<'_>,
    ) -> Result<Self, Failure> {
        let case = Case::for_estimate(spec, models, host)?;
        let size = Size::choose(&case)?;
        let degree_lowered = size.is_lowered(&case);
        Ok(Self::new(case, &size, degree_lowered, host))
    }

    fn new(case: Case<'a>, size: &Size, degree_lowered: bool, host: Host<'_>) -> Self {
        let spelling = host.observer.spelling();
        let scene = case.choices.lines(case.spec, spelling);
        let init = case.first_rows(size.run_size.rows);
        let coordinates = coordinates::line(&case, size.run_size.rows, &init, spelling);
        let reasons = scene.chain(size.lines(&case, spelling)).chain(coordinates).collect();
        Self { init, size: size.run_size, degree_lowered, reasons, case }
    }
}
