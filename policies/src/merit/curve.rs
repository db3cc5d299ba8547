//! How many rows there may be, and how much opacity an event takes.

use super::Merit;

/// Most opacity that one event takes.
const MOST_TAX: f64 = 0.01;

impl Merit {
    /// Number of rows that the curve allows at `step`.
    pub(super) fn target(&self, step: u32, start: usize, budget: usize) -> usize {
        let (from, until) = (self.params.grow_from, self.params.curve_until);
        let length = f64::from(until.saturating_sub(from).max(1));
        let passed = (f64::from(step.saturating_sub(from)) / length).min(1.0);
        let (start, room) = (start.min(budget), budget.saturating_sub(start));
        start + (room as f64 * passed.powf(self.params.curve)).floor() as usize
    }

    /// Opacity that the event at `step` takes off.
    pub(super) fn tax(&self, step: u32) -> f32 {
        let events = f64::from(self.events.count(u32::MAX).max(1));
        // Of n events the k-th takes its part of n, n − 1, …, 1.
        let left = events + 1.0 - f64::from(self.events.count(step));
        let part = 2.0 * left / (events * (events + 1.0));
        (self.params.tax * part).min(MOST_TAX) as f32
    }
}
