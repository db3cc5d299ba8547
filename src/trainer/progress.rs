//! Read access to a run in progress: counters, times, events, and the model.

use std::time::Duration;

use super::{AutoBudget, Trainer};
use crate::backend::{Backend, BackendError};
use crate::exposure::Exposures;
use crate::gaussians::Gaussians;
use crate::views::ViewSource;

impl<V: ViewSource> Trainer<V> {
    /// The measurements and the limit of rows, if they are [chosen automatically](super::AutoChoices::rows).
    #[must_use]
    pub fn growth(&self) -> Option<&AutoBudget> {
        self.auto_budget.as_ref()
    }

    /// How the training views were exposed, where that is learned.
    #[must_use]
    pub fn exposures(&self) -> Option<&Exposures> {
        self.exposures.as_ref()
    }

    /// Number of training views that are not rendered for the policy's scores, as others are nearly the
    /// same; 0 if the policy renders none.
    #[must_use]
    pub fn unscored_views(&self) -> usize {
        if self.needs.aux.is_some() { self.views.count() - self.scored.len() } else { 0 }
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

    /// Most rows at any instant so far, also during edits.
    #[must_use]
    pub fn peak_rows(&self) -> usize {
        self.peak_rows
    }

    /// Renders so far beside the one per step: views that the policy or `--budget auto` measured.
    #[must_use]
    pub fn extra_forwards(&self) -> u64 {
        self.extra_forwards
    }

    /// Wall time of all policy events so far (signals, plan and its execution), and separately that of
    /// the views rendered for them.
    #[must_use]
    pub fn policy_times(&self) -> (Duration, Duration) {
        (self.policy_time.saturating_sub(self.views_time), self.views_time)
    }

    /// Wall time that steps have waited for their images so far.
    #[must_use]
    pub fn images_time(&self) -> Duration {
        self.images_time
    }

    /// The training views.
    #[must_use]
    pub fn views(&self) -> &V {
        &self.views
    }

    /// A copy of the current model, in the coordinates of training.
    pub fn model(&self) -> Result<Gaussians, BackendError> {
        self.backend.download()
    }

    /// The backend, for rendering and its ledger.
    pub fn backend(&mut self) -> &mut dyn Backend {
        self.backend.as_mut()
    }
}
