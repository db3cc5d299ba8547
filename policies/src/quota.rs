//! How many rows one event may add or replace, as its part of a share of the budget.

use crate::adc::Window;

/// ⌊`share` · `budget`⌋.
pub(crate) fn rows_of_share(share: f64, budget: usize) -> usize {
    floor(share * budget as f64)
}

/// Rows for the event of `window` at `step`: all events together get ⌊`share` · `budget`⌋, each an
/// equal part but for rounding.
pub(crate) fn rows_of_event(share: f64, window: Window, step: u32, budget: usize) -> usize {
    let events = f64::from(window.count(u32::MAX).max(1));
    let until = |step: u32| floor(share * budget as f64 * f64::from(window.count(step)) / events);
    until(step) - until(step.saturating_sub(1))
}

/// ⌊x⌋, where x just below an integer counts as this integer: 0.29 · 100 is 28.999999999999996. Each of
/// up to three operations has an error of at most 2⁻⁵³ of its result.
fn floor(x: f64) -> usize {
    (x * (1.0 + 2.0 * f64::EPSILON)).floor() as usize
}
