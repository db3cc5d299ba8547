//! The training loop. It names no policy and no device: views come from a [`ViewSource`], pixels
//! and gradients from a [`Backend`], births and deaths from a [`DensityPolicy`].
//!
//! One step (Kerbl et al. 2023, section 5): a view in the order of its epoch, forward and backward
//! pass and optimiser, and then, where the policy is due, one edit of the rows. A policy sees the
//! model as the optimiser left it.

mod check;
mod edit;
mod error;
mod fresh;
mod growth;
mod guard;
mod options;
mod probe;
mod quarantine;
mod scored;
mod state;

use std::time::{Duration, Instant};

use densify_policies::plan::RowOps;
use densify_policies::policy::{Cadence, DensityPolicy, Needs, PolicyError, SceneInfo};
use serde::{Deserialize, Serialize};

use crate::backend::{Backend, BackendError, StepInput, StepOutput};
use crate::dataset::images::SharedImage;
use crate::gaussians::Gaussians;
use crate::schedule;
use crate::views::ViewSource;
use check::{check, checked_needs};
pub use error::TrainError;
pub use growth::{Growth, PAYS, Rung, Shrink, signals as growth_signals};
use guard::asked;
pub use options::{OnNan, Required, Savings, TrainOptions};
use quarantine::AUDIT_EVERY;
use scored::Scored;
pub use state::TrainerState;

/// What a run with this policy needs of its backend: the policy's needs, and room for the cadence of
/// [`TrainOptions::sh_every`].
#[must_use]
pub fn needs(policy: &dyn DensityPolicy, scene: &SceneInfo, sh_every: Option<u32>) -> Needs {
    let mut needs = policy.needs(scene);
    if let Some(every) = sh_every {
        needs.cadence.sh_rest = every;
    }
    needs
}

/// What one step did.
#[derive(Debug, Clone, PartialEq)]
pub struct StepReport {
    /// Iteration, 1-based.
    pub step: u32,
    /// The view's number.
    pub view: usize,
    /// The step's scalars.
    pub output: StepOutput,
    /// Rows after the step.
    pub rows: usize,
    /// The edits of this step: of rows that hold a number that is not finite, and the policy's, where it was
    /// due and had something to do.
    pub events: Vec<EditEvent>,
}

/// One edit of the rows.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct EditEvent {
    /// Iteration, 1-based.
    pub step: u32,
    /// Rows before.
    pub before: usize,
    /// Rows pruned.
    pub removed: usize,
    /// Rows born.
    pub added: usize,
    /// Rows rewritten in place.
    pub updated: usize,
    /// Edits that the plan refused: the policy wanted more.
    pub denied: usize,
    /// Rows after.
    pub after: usize,
    /// Why, in the policy's words, if it gave any.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub cause: String,
}

impl EditEvent {
    fn new(step: u32, ops: &RowOps) -> Self {
        Self {
            step,
            before: ops.rows_before,
            removed: ops.counts.removed,
            added: ops.counts.added,
            updated: ops.counts.updated,
            denied: ops.counts.denied,
            after: ops.rows_after,
            cause: ops.cause.clone(),
        }
    }
}

/// A run in progress.
pub struct Trainer<V> {
    views: V,
    backend: Box<dyn Backend>,
    policy: Box<dyn DensityPolicy>,
    policy_name: String,
    needs: Needs,
    scene: SceneInfo,
    options: TrainOptions,
    step: u32,
    order: Vec<usize>,
    next_order: Vec<usize>,
    peak_rows: usize,
    extra_forwards: u64,
    policy_time: Duration,
    views_time: Duration,
    images_time: Duration,
    events: Vec<EditEvent>,
    /// Training views that are rendered for scores.
    scored: Scored,
    /// Training views that are measured along the run; none where nothing asks for it.
    probes: Vec<usize>,
    growth: Option<Growth>,
}

impl<V: ViewSource> Trainer<V> {
    /// A run at its start. `backend` holds the initial model; `policy_name` is for messages only.
    ///
    /// # Errors
    /// [`TrainError::NoViews`], and [`TrainError::BadOption`] where `scene` or `options` disagree
    /// with the views or the backend.
    pub fn new(
        views: V,
        backend: Box<dyn Backend>,
        (policy_name, policy): (&str, Box<dyn DensityPolicy>),
        scene: SceneInfo,
        options: TrainOptions,
    ) -> Result<Self, TrainError> {
        let count = views.count();
        check(&scene, &options, count, backend.as_ref())?;
        Ok(Self {
            needs: checked_needs(policy_name, policy.as_ref(), &scene, &options)?,
            policy_name: policy_name.to_owned(),
            order: Vec::new(),
            next_order: schedule::view_order(count, options.seed, 0),
            peak_rows: backend.rows(),
            extra_forwards: 0,
            policy_time: Duration::ZERO,
            views_time: Duration::ZERO,
            images_time: Duration::ZERO,
            views,
            backend,
            policy,
            scene,
            options,
            step: 0,
            events: Vec::new(),
            scored: Scored::all(count),
            probes: Vec::new(),
            growth: None,
        })
    }

    /// Lets the run find out what the scene requires, before its first step. For rows the backend must
    /// have been made with [`growth_signals`], too.
    #[must_use]
    pub fn requiring(mut self, what: Required) -> Self {
        if what.rows {
            self.probes = probe::probes(self.views.count(), self.options.seed);
        }
        if what.scored_views {
            self.scored = Scored::distinct(&self.views, self.scene.extent);
        }
        let (rows, budget) = (self.backend.rows(), self.backend.budget());
        self.growth = what.rows.then(|| Growth::new(rows, budget));
        self
    }

    /// What more rows have brought, where [they must pay](Required::rows).
    #[must_use]
    pub fn growth(&self) -> Option<&Growth> {
        self.growth.as_ref()
    }

    /// Training views that are left out where the policy scores rows or looks at auxiliary views, as
    /// others are nearly the same; none where it does neither.
    #[must_use]
    pub fn unscored_views(&self) -> usize {
        let scores = self.needs.fresh_views > 0 || self.needs.aux.is_some();
        if scores { self.views.count() - self.scored.count() } else { 0 }
    }

    /// One iteration: a view, a gradient step, and the policy's edit where one is due.
    ///
    /// May be called beyond [`TrainOptions::iterations`]; step sizes then stay at their end.
    ///
    /// # Errors
    /// [`TrainError`]. After one, the run is over; the model can still be read.
    pub fn step(&mut self) -> Result<StepReport, TrainError> {
        let step = self.step + 1;
        let TrainOptions { iterations, savings, .. } = self.options;
        self.views.shrink(schedule::divisor(step, iterations, savings.coarse_until));
        let view = self.next_view();
        let start = Instant::now();
        let image = self.image(step, view)?;
        self.images_time = self.images_time.saturating_add(start.elapsed());
        let cadence = self.cadence(step)?;
        let TrainOptions { seed, background, rates, .. } = self.options;
        let input = StepInput {
            step,
            view,
            camera: self.views.camera(view),
            target: &image,
            background: background.at(seed, step),
            sh_degree: self.sh_degree(step),
            rates: rates.at(step, iterations, self.scene.extent),
            cadence,
            seed,
            ssim_weight: savings.ssim_weight(step, iterations),
        };
        let output = self.backend.train_step(&input).map_err(|e| self.stopped(step, e))?;
        self.step = step;
        if !output.loss.is_finite() {
            let view = self.views.name(view).to_owned();
            return Err(TrainError::Diverged { step, view, loss: output.loss });
        }
        let is_due = asked(|| self.policy.is_due(step)).map_err(|e| self.refused(step, e))?;
        let mut events = Vec::new();
        if is_due || step.is_multiple_of(AUDIT_EVERY) || step == iterations {
            events.extend(self.quarantine(step)?);
        }
        events.extend(self.watch_growth(step)?);
        let start = Instant::now();
        if is_due {
            events.extend(self.edit(step)?);
        }
        self.policy_time = self.policy_time.saturating_add(start.elapsed());
        Ok(StepReport { step, view, output, rows: self.backend.rows(), events })
    }

    fn image(&self, step: u32, view: usize) -> Result<SharedImage, TrainError> {
        self.views.image(view).map_err(|source| TrainError::View {
            step,
            view: self.views.name(view).to_owned(),
            source,
        })
    }

    /// How often the optimiser steps now: as the options say, else as the policy does.
    fn cadence(&self, step: u32) -> Result<Cadence, TrainError> {
        let wanted = asked(|| self.policy.cadence(step)).map_err(|e| self.refused(step, e))?;
        let cadence =
            Cadence { sh_rest: self.options.sh_every.unwrap_or(wanted.sh_rest), ..wanted };
        let declared = self.needs.cadence;
        if cadence.is_within(declared) {
            return Ok(cadence);
        }
        let why = format!("it wants {cadence:?}, but declared {declared:?}");
        Err(self.refused(step, PolicyError::Other(why)))
    }

    fn refused(&self, step: u32, source: PolicyError) -> TrainError {
        TrainError::Policy { step, policy: self.policy_name.clone(), source }
    }

    /// The view of the coming step; announces those after it, and epochs to the backend.
    fn next_view(&mut self) -> usize {
        let count = self.views.count();
        let place = self.step as usize % count;
        if place == 0 {
            let epoch = self.step / count as u32;
            self.order = std::mem::take(&mut self.next_order);
            self.next_order = schedule::view_order(count, self.options.seed, epoch + 1);
            self.backend.begin_epoch();
        }
        // A run that is extended goes on beyond its last iteration; then nothing is known of the end.
        let left = self.options.iterations.checked_sub(self.step + 1);
        let last = left.map_or(usize::MAX, |left| left as usize);
        let upcoming: Vec<usize> = self.order[place + 1..]
            .iter()
            .chain(&self.next_order)
            .copied()
            .take(self.options.prefetch.min(last))
            .collect();
        self.views.prefetch(&upcoming);
        self.order[place]
    }

    /// The spherical-harmonic degree at which a step's view is rendered.
    fn sh_degree(&self, step: u32) -> u8 {
        schedule::sh_degree(step, self.options.iterations, self.options.sh_degree)
    }

    fn stopped(&self, step: u32, source: BackendError) -> TrainError {
        TrainError::Backend { step, source }
    }

    /// Steps done so far.
    #[must_use]
    pub fn steps_done(&self) -> u32 {
        self.step
    }

    /// Rows now.
    #[must_use]
    pub fn rows(&self) -> usize {
        self.backend.rows()
    }

    /// Most rows there have been at any instant, inside edits too.
    #[must_use]
    pub fn peak_rows(&self) -> usize {
        self.peak_rows
    }

    /// Training views rendered for the policy's decisions so far, beside one per step: fresh and
    /// auxiliary ones.
    #[must_use]
    pub fn extra_forwards(&self) -> u64 {
        self.extra_forwards
    }

    /// Wall time of all policy events so far: signals, plan and its execution; and, apart from these,
    /// of the views that were rendered for them.
    #[must_use]
    pub fn policy_times(&self) -> (Duration, Duration) {
        (self.policy_time.saturating_sub(self.views_time), self.views_time)
    }

    /// Wall time that steps have waited for their images so far.
    #[must_use]
    pub fn images_time(&self) -> Duration {
        self.images_time
    }

    /// All edits so far.
    #[must_use]
    pub fn events(&self) -> &[EditEvent] {
        &self.events
    }

    /// The scene and the run as the policy sees them.
    #[must_use]
    pub fn scene(&self) -> &SceneInfo {
        &self.scene
    }

    /// The views that are trained on.
    #[must_use]
    pub fn views(&self) -> &V {
        &self.views
    }

    /// A copy of the model as it is now, in the coordinates of training.
    ///
    /// # Errors
    /// See [`BackendError`].
    pub fn model(&self) -> Result<Gaussians, BackendError> {
        self.model_rows(0..self.backend.rows())
    }

    /// Some rows of the [`model`](Self::model), which must be there.
    ///
    /// # Errors
    /// See [`BackendError`].
    pub fn model_rows(&self, rows: std::ops::Range<usize>) -> Result<Gaussians, BackendError> {
        self.backend.download_rows(rows)
    }

    /// The backend, for rendering and its ledger.
    pub fn backend(&mut self) -> &mut dyn Backend {
        self.backend.as_mut()
    }
}

#[cfg(test)]
mod tests;
