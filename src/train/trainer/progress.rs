//! Read access to a run in progress: counters, times and the model.

use std::time::Duration;

use densify_policies::policy::{Signal, SignalSet};

use super::{RowHistory, Trainer, TrainerState};
use densify_core::gaussians::Gaussians;
use densify_data::views::ViewSource;
use densify_render::{Backend, BackendError};

impl<V: ViewSource> Trainer<V> {
    /// The state so far, without that of the policy.
    pub fn progress(&self) -> &TrainerState {
        &self.state
    }

    /// Number of training views that are not rendered for the policy's scores because they are near-duplicates; 0 if
    /// the policy renders no views.
    pub fn unscored_views(&self) -> usize {
        if self.needs.aux.is_some() { self.views.count() - self.scored_views.len() } else { 0 }
    }

    /// Number of steps done.
    pub fn steps_done(&self) -> u32 {
        self.state.step
    }

    /// Current number of rows.
    pub fn rows(&self) -> usize {
        self.backend.rows()
    }

    /// Wall time that steps have spent waiting for images so far.
    pub fn images_time(&self) -> Duration {
        self.images_time
    }

    /// The training views.
    pub fn views(&self) -> &V {
        &self.views
    }

    /// A copy of the current model, in normalised coordinates.
    ///
    /// # Errors
    /// When the model cannot be copied from the device.
    pub fn model(&self) -> Result<Gaussians, BackendError> {
        self.backend.download()
    }

    /// The signals that the policy reads.
    pub fn signals(&self) -> SignalSet {
        self.needs.signals
    }

    /// Starts recording the history of rows. For a resumed run, earlier edits are derived from the optimiser's step
    /// counts per row; frozen rows have no edits.
    ///
    /// # Errors
    /// When the step counts cannot be read.
    pub fn record_history(&mut self) -> Result<(), BackendError> {
        let ages = self.backend.take_signals(SignalSet::from([Signal::Age]))?;
        let (step, budget) = (self.state.step, self.row_budget());
        let edited = |(row, &age): (usize, &f32)| {
            if budget.is_frozen(row) { 0 } else { step.saturating_sub(age as u32) }
        };
        let rows = ages.get(Signal::Age).unwrap_or_default().iter().enumerate();
        let edited: Vec<u32> = rows.map(edited).collect();
        self.history = Some(RowHistory::from_edits(&edited, self.backend.budget()));
        self.backend.give_back(ages);
        Ok(())
    }

    /// The backend, and the history of rows if it is [recorded](Self::record_history).
    pub fn backend_and_history(&mut self) -> (&mut dyn Backend, Option<&RowHistory>) {
        (self.backend.as_mut(), self.history.as_ref())
    }

    /// The backend, for rendering and for its ledger.
    pub fn backend(&mut self) -> &mut dyn Backend {
        self.backend.as_mut()
    }
}
