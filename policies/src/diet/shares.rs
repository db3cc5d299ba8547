//! Shares of the budget, as numbers of rows.

use crate::adc::Window;

/// ⌊`of` · `budget`⌋.
pub(super) fn fraction(of: f64, budget: usize) -> usize {
    whole(of * budget as f64)
}

/// What the event of `window` at `step` takes of ⌊`of` · `budget`⌋ rows, which all events share
/// equally, but for rounding.
pub(super) fn part(of: f64, window: Window, step: u32, budget: usize) -> usize {
    let events = f64::from(window.count(u32::MAX).max(1));
    let until = |step: u32| whole(of * budget as f64 * f64::from(window.count(step)) / events);
    until(step) - until(step.saturating_sub(1))
}

/// ⌊x⌋ of what few operations gave: 0.29 · 100 is 28.999999999999996, but 29 is meant. Each of up to
/// three operations is off by at most 2⁻⁵³ of its result.
fn whole(x: f64) -> usize {
    (x * (1.0 + 2.0 * f64::EPSILON)).floor() as usize
}
