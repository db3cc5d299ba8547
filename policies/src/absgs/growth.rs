//! Growth by two gradients: small rows are cloned by their screen gradient, large ones split by the absolute one.

use crate::adc::{PruneLimits, clone_at, mean_over_views, split_by};
use crate::plan::Offspring;
use crate::policy::{PolicyResult, Signal, Snapshot};
use crate::sample::largest;

/// Signals that [`AbsGrowth::parents`] reads.
pub(crate) const ABS_GROWTH_SIGNALS: [Signal; 5] = [
    Signal::VisibleCount,
    Signal::ScreenGradient,
    Signal::ScreenGradientAbs,
    Signal::Opacity,
    Signal::ScaleMax,
];

/// Thresholds of growth by two gradients (AbsGS, Ye et al. 2024, section 4).
#[derive(Debug, Clone, Copy)]
pub(crate) struct AbsGrowth {
    /// Screen gradient from which small rows are cloned `[1 / NDC]`, >= 0.
    pub(crate) tau: f64,
    /// Absolute screen gradient from which large rows are split `[1 / NDC]`, >= 0.
    pub(crate) tau_abs: f64,
    /// Largest size of a small row `[fraction of the scene extent]`, >= 0.
    pub(crate) small: f64,
    /// A split divides the scales by this, >= 1.
    pub(crate) split_factor: f64,
}

impl AbsGrowth {
    /// Rows that grow, with their children: those whose gradient is the largest multiple of its threshold first, as
    /// they are the first to grow under a budget. Rows whose children would exceed `limits` are left out.
    pub(crate) fn parents(
        &self,
        now: &Snapshot<'_>,
        limits: PruneLimits,
    ) -> PolicyResult<Vec<(u32, Offspring)>> {
        let views = now.signal(Signal::VisibleCount)?;
        let screen = mean_over_views(now.signal(Signal::ScreenGradient)?, views);
        let absolute = mean_over_views(now.signal(Signal::ScreenGradientAbs)?, views);
        let (opacity, scale) = (now.signal(Signal::Opacity)?, now.signal(Signal::ScaleMax)?);
        let small = (self.small * f64::from(now.scene.extent)) as f32;
        let factor = self.split_factor as f32;
        let is_small = |row: usize| scale[row] <= small;
        // The gradient in units of its threshold; 0 for rows that do not grow.
        let urgency = |row: usize| {
            let (gradient, tau, grown_scale) = if is_small(row) {
                (screen[row], self.tau, scale[row])
            } else {
                (absolute[row], self.tau_abs, scale[row] / factor)
            };
            let tau = tau as f32;
            let grows = gradient >= tau && !limits.exceeded(opacity[row], grown_scale);
            // A threshold of 0 makes every row grow, those with the largest gradients first.
            if grows { gradient / tau.max(f32::MIN_POSITIVE) } else { -1.0 }
        };
        let urgency: Vec<f32> = (0..now.rows()).map(urgency).collect();
        let rows: Vec<u32> =
            (0..now.rows() as u32).filter(|&row| urgency[row as usize] >= 0.0).collect();
        let count = rows.len();
        let offspring = |row: u32| {
            if is_small(row as usize) { clone_at([0.0; 3]) } else { split_by(factor) }
        };
        Ok(largest(rows, &urgency, count).into_iter().map(|row| (row, offspring(row))).collect())
    }
}
