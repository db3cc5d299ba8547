//! Divides a share of the budget among events: the number of rows that each event may add or replace.

use crate::adc::Window;

/// ⌊`share` · `budget`⌋.
pub(crate) fn share_of_budget(share: f64, budget: usize) -> usize {
    floor(share * budget as f64)
}

/// Number of rows for the event of `window` at `step`: its part of ⌊`share` · `budget`⌋, which is divided among
/// all events as equally as rounding permits.
pub(crate) fn event_quota(share: f64, window: Window, step: u32, budget: usize) -> usize {
    let events = f64::from(window.count(u32::MAX).max(1));
    let quota_through =
        |step: u32| floor(share * budget as f64 * f64::from(window.count(step)) / events);
    quota_through(step) - quota_through(step.saturating_sub(1))
}

/// ⌊x⌋, where x just below an integer counts as that integer: 0.29 · 100 is 28.999999999999996. x is the result
/// of up to three operations with a relative error of at most 2⁻⁵³ each.
fn floor(x: f64) -> usize {
    (x * (1.0 + 2.0 * f64::EPSILON)).floor() as usize
}
