//! Read access to a run in progress: counters, times, events, and the model.

use std::time::Duration;

use densify_policies::policy::{Signal, SignalSet};

use super::{AutoBudget, RowHistory, Trainer};
use crate::exposure::Exposures;
use densify_core::gaussians::Gaussians;
use densify_data::views::ViewSource;
use densify_render::{Backend, BackendError};

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

    /// The signals that the policy reads.
    #[must_use]
    pub fn signals(&self) -> SignalSet {
        self.needs.signals
    }

    /// Remembers from now on when rows are made and edited. Of a run that goes on, what was before is known as far as
    /// the optimiser's ages say it; of frozen rows there is none.
    ///
    /// # Errors
    /// When the ages cannot be read.
    pub fn remember_rows(&mut self) -> Result<(), BackendError> {
        let ages = self.backend.take_signals(SignalSet::from([Signal::Age]))?;
        let step = self.step;
        let edited = |(row, &age): (usize, &f32)| match row < self.options.frozen {
            true => 0,
            false => step.saturating_sub(age as u32),
        };
        let known = ages.get(Signal::Age).unwrap_or_default().iter().enumerate();
        let edited: Vec<u32> = known.map(edited).collect();
        self.history = Some(RowHistory::of(&edited, self.backend.budget()));
        self.backend.give_back(ages);
        Ok(())
    }

    /// The backend, and when rows were made and edited where that is [remembered](Self::remember_rows).
    pub fn looked_at(&mut self) -> (&mut dyn Backend, Option<&RowHistory>) {
        (self.backend.as_mut(), self.history.as_ref())
    }

    /// The backend, for rendering and its ledger.
    pub fn backend(&mut self) -> &mut dyn Backend {
        self.backend.as_mut()
    }
}
