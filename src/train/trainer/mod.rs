//! The training loop, for any policy and any device.
//!
//! Views come from a [`ViewSource`], pixels and gradients from a [`Backend`], edits of rows from a [`DensityPolicy`]. A
//! step (Kerbl et al. 2023, section 5) takes the next view of the epoch, runs forward pass, backward pass and
//! optimiser, and then an edit if the policy is due. Policies see the model after the optimiser's step.

mod auto_budget;
mod depth;
mod edit;
mod error;
mod floaters;
mod near_duplicates;
mod nonfinite;
mod options;
mod policy_views;
mod pose;
mod progress;
mod report;
mod resolution;
mod row_history;
mod state;
mod validate;

use std::time::{Duration, Instant};

use densify_policies::policy::{
    Cadence, DensityPolicy, LossTerms, Needs, NoiseTerm, PolicyError, SceneInfo,
};

use crate::exposure::Exposures;
use crate::poses::Poses;
use crate::schedule;
use crate::vignette::Vignettes;
pub use auto_budget::{AutoBudget, Interval, MIN_GAIN, Removal, growth_signals};
use densify_core::camera::Camera;
use densify_core::image::SharedImage;
use densify_core::image::depth::SharedDepth;
use densify_core::vignette::Vignette;
use densify_data::views::{ViewError, ViewSource};
use densify_render::{Backend, StepInput};
use depth::distortion;
pub use depth::{Annealed, DepthTraining};
use error::AtStep;
pub use error::TrainError;
pub use floaters::{FLOATER_BYTES, floater_request};
use near_duplicates::distinct_views;
use nonfinite::AUDIT_EVERY;
pub use options::{AutoChoices, OnNan, TrainOptions};
use policy_views::call_policy;
pub use report::{EditEvent, StepReport};
pub use row_history::RowHistory;
pub use state::TrainerState;
use validate::{check_options, checked_needs};

/// A run in progress.
pub struct Trainer<V> {
    views: V,
    backend: Box<dyn Backend>,
    policy: Box<dyn DensityPolicy>,
    policy_name: String,
    needs: Needs,
    scene: SceneInfo,
    options: TrainOptions,
    state: TrainerState,
    /// Order of the views in this epoch.
    order: Vec<usize>,
    /// Order of the views in the next epoch.
    next_order: Vec<usize>,
    /// Wall time spent waiting for images.
    images_time: Duration,
    /// Training views in which the policy's scores are measured.
    scored_views: Vec<usize>,
    /// Training views in which the automatic budget measures the PSNR; empty without it.
    probe_views: Vec<usize>,
    /// History of the rows, if it is recorded.
    history: Option<RowHistory>,
}

impl<V: ViewSource> Trainer<V> {
    /// A new run. `backend` contains the initial model; `policy_name` is for messages only.
    ///
    /// # Errors
    /// [`TrainError::BadOption`] when the arguments contradict each other.
    pub fn new(
        views: V,
        backend: Box<dyn Backend>,
        (policy_name, policy): (&str, Box<dyn DensityPolicy>),
        scene: SceneInfo,
        options: TrainOptions,
    ) -> Result<Self, TrainError> {
        let count = views.count();
        check_options(&scene, &options, count, backend.as_ref())?;
        Ok(Self {
            needs: checked_needs(policy_name, policy.as_ref(), &scene)?,
            policy_name: policy_name.to_owned(),
            order: Vec::new(),
            next_order: schedule::view_order(count, options.seed, 0),
            state: TrainerState {
                initial_rows: scene.initial_rows,
                peak_rows: backend.rows(),
                ..TrainerState::default()
            },
            images_time: Duration::ZERO,
            views,
            backend,
            policy,
            scene,
            options,
            scored_views: (0..count).collect(),
            probe_views: Vec::new(),
            history: None,
        })
    }

    /// Enables automatic choices; call it before the first step. To choose the number of rows, the backend must also
    /// have been created with [`growth_signals`].
    #[must_use]
    pub fn with_auto_choices(mut self, choices: AutoChoices) -> Self {
        if choices.rows {
            self.probe_views = auto_budget::probe_views(self.views.count(), self.options.seed);
        }
        if choices.scored_views {
            self.scored_views = distinct_views(&self.views, self.scene.extent);
        }
        let (rows, budget) = (self.backend.rows(), self.backend.budget());
        self.state.auto_budget = choices.rows.then(|| AutoBudget::new(rows, budget));
        self
    }

    /// Enables learning of exposures, with their initial values; call it before the first step. The backend must have
    /// been created for exposures.
    ///
    /// # Panics
    /// When the numbers of exposures and of views differ, which is a bug in the caller.
    #[must_use]
    pub fn with_exposures(mut self, exposures: Option<Exposures>) -> Self {
        let count = exposures.as_ref().map_or(self.views.count(), Exposures::count);
        assert_eq!(count, self.views.count(), "the numbers of exposures and of views differ");
        self.state.exposures = exposures;
        self
    }

    /// Enables refinement of the poses; call it before the first step. The backend must have been created for it.
    ///
    /// # Panics
    /// When the numbers of poses and of views differ, which is a bug in the caller.
    #[must_use]
    pub fn with_poses(mut self, poses: Option<Poses>) -> Self {
        let count = poses.as_ref().map_or(self.views.count(), Poses::count);
        assert_eq!(count, self.views.count(), "the numbers of poses and of views differ");
        self.state.poses = poses;
        self
    }

    /// Enables learning of vignettes, with their initial values; call it before the first step. The backend must have
    /// been created for vignettes.
    ///
    /// # Panics
    /// When the numbers of views differ, which is a bug in the caller.
    #[must_use]
    pub fn with_vignettes(mut self, vignettes: Option<Vignettes>) -> Self {
        let count = vignettes.as_ref().map_or(self.views.count(), Vignettes::count);
        assert_eq!(count, self.views.count(), "the vignettes are for another number of views");
        self.state.vignettes = vignettes;
        self
    }

    /// The vignette of a view that is rendered with `camera`, if vignettes are learned.
    fn vignette(&self, view: usize, camera: &Camera) -> Option<Vignette> {
        let vignettes = self.state.vignettes.as_ref()?;
        Some(vignettes.of_view(view, self.views.camera(view), camera))
    }

    /// One iteration: a view, a gradient step, and the policy's edit if it is due.
    ///
    /// May be called beyond [`TrainOptions::iterations`]; step sizes then keep their final values.
    ///
    /// # Errors
    /// [`TrainError`]. The run cannot continue after an error, but the model can still be read.
    pub fn step(&mut self) -> Result<StepReport, TrainError> {
        let step = self.state.step + 1;
        let view = self.next_view();
        let start = Instant::now();
        // The image is read first, so that an error leaves the state after the last step unchanged.
        let (image, depth) = self.image_with_depth(step, view)?;
        if (self.state.step as usize).is_multiple_of(self.views.count()) {
            self.backend.begin_epoch();
        }
        self.images_time = self.images_time.saturating_add(start.elapsed());
        let cadence = self.cadence(step)?;
        let (loss_terms, noise) = self.terms(step)?;
        let (camera, image, depth) = self.at_resolution(step, view, image, depth)?;
        let TrainOptions { iterations, seed, background, rates, .. } = self.options;
        let progress = f64::from(step) / f64::from(iterations);
        let depth = self.options.depth.zip(depth.as_deref());
        let exposure = self.state.exposures.as_ref().map(|exposures| exposures.transform(view));
        let vignette = self.vignette(view, &camera);
        let input = StepInput {
            step,
            view,
            camera: &camera,
            target: &image,
            background: background.at(seed, step),
            exposure: exposure.as_ref(),
            pose: self.state.poses.is_some(),
            vignette: vignette.as_ref(),
            depth: depth.and_then(|(training, map)| training.target(map, progress)),
            distortion: distortion(self.options.distortion, progress),
            sh_degree: self.sh_degree(step),
            rates: rates.at(step, iterations, self.scene.extent),
            loss_terms,
            noise,
            cadence,
            seed,
        };
        let output = self.backend.train_step(&input).at(step)?;
        self.state.step = step;
        if !output.loss.is_finite() {
            let view = self.views.name(view).to_owned();
            return Err(TrainError::Diverged { step, view, loss: output.loss });
        }
        if let Some((exposures, gradient)) = self.state.exposures.as_mut().zip(output.exposure) {
            exposures.step(view, &gradient, progress);
        }
        self.move_pose(step, view, &output, progress);
        if let Some((vignettes, gradient)) = self.state.vignettes.as_mut().zip(output.vignette) {
            vignettes.step(view, &gradient, progress);
        }
        let is_due = self.ask_policy(step, |policy| policy.is_due(step))?;
        let mut events = Vec::new();
        if is_due || step.is_multiple_of(AUDIT_EVERY) || step == iterations {
            events.extend(self.remove_nonfinite(step)?);
        }
        events.extend(self.remove_floaters(step)?);
        events.extend(self.update_auto_budget(step)?);
        let start = Instant::now();
        if is_due {
            events.extend(self.edit(step)?);
        }
        self.state.policy_time = self.state.policy_time.saturating_add(start.elapsed());
        Ok(StepReport { step, view, output, rows: self.backend.rows(), events })
    }

    /// A random sample of `count` scored views that depends on seed and step; all of them if there are fewer.
    fn sample_scored_views(&self, count: usize, step: u32) -> Vec<usize> {
        let drawn = schedule::fresh_views(self.scored_views.len(), count, self.options.seed, step);
        drawn.into_iter().map(|i| self.scored_views[i]).collect()
    }

    fn image(&self, step: u32, view: usize) -> Result<SharedImage, TrainError> {
        self.views.image(view).map_err(|source| self.view_error(step, view, source))
    }

    /// The image of a view, and its depth if it is trained on.
    fn image_with_depth(
        &self,
        step: u32,
        view: usize,
    ) -> Result<(SharedImage, Option<SharedDepth>), TrainError> {
        let loaded = self.views.image_with_depth(view);
        loaded.map_err(|source| self.view_error(step, view, source))
    }

    fn view_error(&self, step: u32, view: usize, source: ViewError) -> TrainError {
        TrainError::View { step, view: self.views.name(view).to_owned(), source }
    }

    /// The optimiser's cadence at this step, according to the policy.
    fn cadence(&self, step: u32) -> Result<Cadence, TrainError> {
        let cadence = self.ask_policy(step, |policy| policy.cadence(step))?;
        let declared = self.needs.cadence;
        if cadence.is_within(declared) {
            return Ok(cadence);
        }
        let error = format!("it wants the cadence {cadence:?}, but declared {declared:?}");
        Err(self.policy_error(step, PolicyError::Other(error)))
    }

    /// The policy's loss terms, and its noise on the means, at this step.
    fn terms(&self, step: u32) -> Result<(LossTerms, Option<NoiseTerm>), TrainError> {
        let Needs { loss_terms, noise, .. } = self.needs;
        let (terms, noise) = self.ask_policy(step, |policy| {
            (policy.loss_terms(step, loss_terms), policy.noise(step, noise))
        })?;
        let checked = terms.check().and_then(|()| noise.map_or(Ok(()), |noise| noise.check()));
        checked.map_err(|error| self.policy_error(step, PolicyError::Other(error)))?;
        Ok((terms, noise))
    }

    /// Calls a method of the policy that can fail only by panicking.
    fn ask_policy<T>(
        &self,
        step: u32,
        question: impl FnOnce(&dyn DensityPolicy) -> T,
    ) -> Result<T, TrainError> {
        call_policy(|| question(&*self.policy)).map_err(|error| self.policy_error(step, error))
    }

    fn policy_error(&self, step: u32, source: PolicyError) -> TrainError {
        TrainError::Policy { step, policy: self.policy_name.clone(), source }
    }

    /// Returns the view of the next step, and prefetches those after it.
    fn next_view(&mut self) -> usize {
        let count = self.views.count();
        let place = self.state.step as usize % count;
        if place == 0 {
            let epoch = self.state.step / count as u32;
            self.order = std::mem::take(&mut self.next_order);
            self.next_order = schedule::view_order(count, self.options.seed, epoch + 1);
        }
        // Beyond the last iteration the number of remaining steps is unknown.
        let remaining = self.options.iterations.checked_sub(self.state.step + 1);
        let remaining = remaining.map_or(usize::MAX, |steps| steps as usize);
        let upcoming: Vec<usize> = self.order[place + 1..]
            .iter()
            .chain(&self.next_order)
            .copied()
            .take(self.options.prefetch.min(remaining))
            .collect();
        self.views.prefetch(&upcoming);
        self.order[place]
    }

    /// The spherical-harmonic degree in use at a step.
    fn sh_degree(&self, step: u32) -> u8 {
        let TrainOptions { iterations, sh_degree, has_all_bands, .. } = self.options;
        if has_all_bands { sh_degree } else { schedule::sh_degree(step, iterations, sh_degree) }
    }
}

#[cfg(test)]
mod tests;
