//! The trainer's own part of a checkpoint: where the run is, and what its policy remembers.
//!
//! It is small, because everything along a run is a function of (seed, step): the order of views,
//! the background, every draw.

use std::time::Duration;

use densify_policies::policy::{PolicyError, PolicyState};
use serde::{Deserialize, Serialize};

use super::guard::asked;
use super::{EditEvent, Growth, Trainer};
use crate::schedule;
use crate::views::ViewSource;

/// A [`Trainer`] between two steps, without the backend's part.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TrainerState {
    /// Steps done.
    pub step: u32,
    /// Rows after initialisation, as the policy has been told.
    pub initial_rows: usize,
    /// Most rows at any instant so far.
    pub peak_rows: usize,
    /// Views rendered for the policy's decisions so far.
    pub extra_forwards: u64,
    /// Wall time of all policy events so far.
    pub policy_time: Duration,
    /// The part of it that went into rendering views.
    pub views_time: Duration,
    /// All edits so far.
    pub events: Vec<EditEvent>,
    /// What the policy remembers.
    pub policy: PolicyState,
    /// Ends of rungs, where rows must pay.
    #[serde(default)]
    pub growth: Option<Growth>,
}

impl<V: ViewSource> Trainer<V> {
    /// What a run that goes on from here must know, beside the model and the backend's state.
    ///
    /// # Errors
    /// When the policy panics.
    pub fn state(&self) -> Result<TrainerState, PolicyError> {
        Ok(TrainerState {
            step: self.step,
            initial_rows: self.scene.initial_rows,
            peak_rows: self.peak_rows,
            extra_forwards: self.extra_forwards,
            policy_time: self.policy_time,
            views_time: self.views_time,
            events: self.events.clone(),
            policy: asked(|| self.policy.save())?,
            growth: self.growth.clone(),
        })
    }

    /// Goes on where `state` was taken. This trainer must be new, made with the same options for
    /// the same views, and its backend hold the model and the state of that moment.
    ///
    /// # Errors
    /// [`PolicyError`] when the policy does not take its state back; the trainer must not be used
    /// then.
    pub fn resume(&mut self, state: TrainerState) -> Result<(), PolicyError> {
        asked(|| self.policy.restore(state.policy)).and_then(|done| done)?;
        self.step = state.step;
        self.scene.initial_rows = state.initial_rows;
        self.peak_rows = self.peak_rows.max(state.peak_rows);
        self.extra_forwards = state.extra_forwards;
        self.policy_time = state.policy_time;
        self.views_time = state.views_time;
        self.events = state.events;
        self.growth = state.growth;
        // Within an epoch its order is at hand, and the next one is drawn; at the end of an epoch
        // only the next one.
        let count = self.views.count();
        let (epoch, place) = (state.step / count as u32, state.step as usize % count);
        let order = |epoch| schedule::view_order(count, self.options.seed, epoch);
        let ahead = if place == 0 { epoch } else { epoch.saturating_add(1) };
        (self.order, self.next_order) =
            (if place == 0 { Vec::new() } else { order(epoch) }, order(ahead));
        Ok(())
    }
}
