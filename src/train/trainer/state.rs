//! The trainer's part of a checkpoint: counters, events and the policy's state.
//!
//! It is small because the order of views, the background and all random numbers are functions of seed and step.

use std::time::Duration;

use densify_policies::policy::{PolicyError, PolicyState};
use serde::{Deserialize, Serialize};

use super::policy_views::call_policy;
use super::{AutoBudget, EditEvent, Trainer};
use crate::exposure::Exposures;
use crate::poses::Poses;
use crate::schedule;
use crate::vignette::Vignettes;
use densify_data::views::ViewSource;

/// The state of a [`Trainer`] between two steps, without that of the backend.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TrainerState {
    /// Number of steps done.
    pub step: u32,
    /// Number of rows after initialisation, without frozen rows.
    pub initial_rows: usize,
    /// Largest number of rows so far, including those during edits.
    pub peak_rows: usize,
    /// Number of views rendered so far for the policy or the automatic budget, in addition to one per step.
    pub extra_forwards: u64,
    /// Wall time of all policy events so far: signals, plan and execution.
    pub policy_time: Duration,
    /// The part of `policy_time` that was spent on rendering views.
    pub views_time: Duration,
    /// All edits so far.
    pub events: Vec<EditEvent>,
    /// The policy's state.
    pub policy: PolicyState,
    /// State of the automatic budget, if it is [enabled](super::AutoChoices::rows).
    #[serde(default)]
    pub auto_budget: Option<AutoBudget>,
    /// Exposures of the training views, if they are learned.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub exposures: Option<Exposures>,
    /// Poses of the training views, if they are refined.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub poses: Option<Poses>,
    /// Vignettes of the cameras, if they are learned.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub vignettes: Option<Vignettes>,
}

impl<V: ViewSource> Trainer<V> {
    /// The state for a checkpoint, in addition to the model and the backend's state.
    ///
    /// # Errors
    /// When the policy cannot save its state.
    pub fn state(&self) -> Result<TrainerState, PolicyError> {
        Ok(TrainerState { policy: call_policy(|| self.policy.save())?, ..self.state.clone() })
    }

    /// Continues a run from `state`. This trainer must be new, with the same options and views, and its backend must
    /// have the model and the backend state of the same step.
    ///
    /// # Errors
    /// [`PolicyError`] if the policy rejects its state, or if the exposures or vignettes do not match. After an error the
    /// trainer must not be used.
    pub fn resume(&mut self, mut state: TrainerState) -> Result<(), PolicyError> {
        let policy = std::mem::take(&mut state.policy);
        call_policy(|| self.policy.restore(policy)).flatten()?;
        let matches = match (&state.exposures, &self.state.exposures) {
            (Some(saved), Some(own)) => saved.check_matches(own),
            (None, None) => Ok(()),
            _ => Err("either the checkpoint or this run has exposures, but not both".to_owned()),
        };
        matches.map_err(PolicyError::Other)?;
        let matches = match (&state.poses, &self.state.poses) {
            (Some(saved), Some(own)) => saved.check_matches(own),
            (None, None) => Ok(()),
            _ => Err("either the checkpoint or this run refines poses, but not both".to_owned()),
        };
        matches.map_err(PolicyError::Other)?;
        let matches = match (&state.vignettes, &self.state.vignettes) {
            (Some(saved), Some(own)) => saved.check_matches(own),
            (None, None) => Ok(()),
            _ => Err("either the checkpoint or this run has vignettes, but not both".to_owned()),
        };
        matches.map_err(PolicyError::Other)?;
        self.scene.initial_rows = state.initial_rows;
        state.peak_rows = state.peak_rows.max(self.state.peak_rows);
        // As after `next_view`: at the end of an epoch only the next order exists; within an epoch both orders do.
        let count = self.views.count();
        let (epoch, place) = (state.step / count as u32, state.step as usize % count);
        let order = |epoch| schedule::view_order(count, self.options.seed, epoch);
        let ahead = if place == 0 { epoch } else { epoch.saturating_add(1) };
        (self.order, self.next_order) =
            (if place == 0 { Vec::new() } else { order(epoch) }, order(ahead));
        self.state = state;
        Ok(())
    }
}
