//! The schedule of `mrnf`, and how its rules for 175 events apply to fewer.

use crate::adc::Window;
use crate::parameters::REFERENCE_ITERATIONS;

/// Steps between two events of the published code, in a run of 30,000.
const PUBLISHED_INTERVAL: u32 = 163;

/// Largest decay per optimiser step, relative to the published one: Gaussians that are needed must recover between
/// events, or all of them fade. In short runs the trainer increases learning rates by at most this factor.
const MOST_DECAY: f64 = 5.0;

/// Events of a run.
#[derive(Debug, Clone, Copy)]
pub(super) struct Schedule {
    /// Events with growth.
    pub(super) grow: Window,
    /// All events.
    pub(super) events: Window,
    /// Length of the run `[steps]`.
    pub(super) iterations: u32,
}

impl Schedule {
    /// Fraction of the run that is left after `step`, in 0..=1.
    pub(super) fn left(&self, step: u32) -> f64 {
        (1.0 - f64::from(step) / f64::from(self.iterations.max(1))).max(0.0)
    }

    /// Share of the candidates that grow at an event, at most 1; `published` is that of a published event.
    pub(super) fn growth(&self, published: f64) -> f64 {
        ((1.0 + published).powf(self.published_events()) - 1.0).min(1.0)
    }

    /// Factor on the decay of a published event.
    pub(super) fn decay_factor(&self) -> f64 {
        let per_step = f64::from(self.events.every) / f64::from(PUBLISHED_INTERVAL);
        self.published_events().min(MOST_DECAY * per_step)
    }

    /// Number of events with growth from that at `step` on, at least 1.
    pub(super) fn growth_events_left(&self, step: u32) -> usize {
        let before = self.grow.count(step.saturating_sub(1));
        (self.grow.count(u32::MAX).saturating_sub(before) as usize).max(1)
    }

    /// Number of published events that an event of this run stands for.
    fn published_events(&self) -> f64 {
        let published = f64::from(REFERENCE_ITERATIONS) / f64::from(PUBLISHED_INTERVAL);
        f64::from(self.events.every) * published / f64::from(self.iterations.max(1))
    }
}
