//! The trainer's part of a checkpoint: counters, events and the policy's state.
//!
//! It is small because the order of views, the background and every random draw are functions of
//! (seed, step).

use std::time::Duration;

use densify_policies::policy::{PolicyError, PolicyState};
use serde::{Deserialize, Serialize};

use super::policy_views::call_policy;
use super::{AutoBudget, EditEvent, Trainer};
use crate::exposure::Exposures;
use crate::schedule;
use densify_data::views::ViewSource;

/// A [`Trainer`] between two steps, without the backend's part.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TrainerState {
    /// Steps done.
    pub step: u32,
    /// Rows after initialisation.
    pub initial_rows: usize,
    /// Most rows at any instant so far.
    pub peak_rows: usize,
    /// Renders so far beside the one per step.
    pub extra_forwards: u64,
    /// Wall time of all policy events so far.
    pub policy_time: Duration,
    /// The part of it spent on rendering views.
    pub views_time: Duration,
    /// All edits so far.
    pub events: Vec<EditEvent>,
    /// The policy's state.
    pub policy: PolicyState,
    /// The row limit of `--budget auto` and its measurements.
    #[serde(default)]
    pub auto_budget: Option<AutoBudget>,
    /// How each training view was exposed, as far as it is learned.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub exposures: Option<Exposures>,
}

impl<V: ViewSource> Trainer<V> {
    /// What a checkpoint must hold, beside the model and the backend's state.
    pub fn state(&self) -> Result<TrainerState, PolicyError> {
        Ok(TrainerState {
            step: self.step,
            initial_rows: self.scene.initial_rows,
            peak_rows: self.peak_rows,
            extra_forwards: self.extra_forwards,
            policy_time: self.policy_time,
            views_time: self.views_time,
            events: self.events.clone(),
            policy: call_policy(|| self.policy.save())?,
            auto_budget: self.auto_budget.clone(),
            exposures: self.exposures.clone(),
        })
    }

    /// Continues a run from `state`. This trainer must be new, with the same options and views, and its
    /// backend must hold the model and the backend state of the same step.
    ///
    /// # Errors
    /// [`PolicyError`] if the policy rejects its state, or the exposures are of other views; then the trainer
    /// must not be used.
    pub fn resume(&mut self, state: TrainerState) -> Result<(), PolicyError> {
        call_policy(|| self.policy.restore(state.policy)).and_then(|done| done)?;
        let like = match (&state.exposures, &self.exposures) {
            (Some(saved), Some(own)) => saved.check_like(own),
            (None, None) => Ok(()),
            _ => Err("it has exposures, or this run has, but not both".to_owned()),
        };
        like.map_err(PolicyError::Other)?;
        self.exposures = state.exposures;
        self.step = state.step;
        self.scene.initial_rows = state.initial_rows;
        self.peak_rows = self.peak_rows.max(state.peak_rows);
        self.extra_forwards = state.extra_forwards;
        self.policy_time = state.policy_time;
        self.views_time = state.views_time;
        self.events = state.events;
        self.auto_budget = state.auto_budget;
        // As after `next_view`: at the end of an epoch only the next order is drawn, within one both
        // are.
        let count = self.views.count();
        let (epoch, place) = (state.step / count as u32, state.step as usize % count);
        let order = |epoch| schedule::view_order(count, self.options.seed, epoch);
        let ahead = if place == 0 { epoch } else { epoch.saturating_add(1) };
        (self.order, self.next_order) =
            (if place == 0 { Vec::new() } else { order(epoch) }, order(ahead));
        Ok(())
    }
}
