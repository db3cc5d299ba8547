//! Building blocks of adaptive density control that several policies share: schedules, growth curves,
//! clones, splits, pruning limits and opacity resets.
//!
//! Most are from Kerbl et al., *3D Gaussian Splatting for Real-Time Radiance Field Rendering*, 2023,
//! section 5.2, and its public code.

use std::ops::Bound::Excluded;

use crate::parameters::in_range;
use crate::plan::{
    EditPlan, NO_ROTATION, Offspring, OpacityRule, ParentFate, Placement, ScaleRule,
};
use crate::policy::{PolicyResult, SceneInfo, Signal, Snapshot};
use crate::sample::top_k;

/// Signals for growth by screen gradient and for pruning by opacity and size.
pub(crate) const GROWTH_SIGNALS: [Signal; 4] =
    [Signal::VisibleCount, Signal::ScreenGradient, Signal::Opacity, Signal::ScaleMax];

/// A schedule: the multiples of `every` with `from` < step < `until`; none if `every` is 0.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Window {
    /// Start (exclusive) `[steps]`.
    pub from: u32,
    /// End (exclusive) `[steps]`.
    pub until: u32,
    /// Interval `[steps]`.
    pub every: u32,
}

impl Window {
    /// True if `step` (1-based) is on the schedule.
    pub fn is_due(&self, step: u32) -> bool {
        self.every > 0 && self.from < step && step < self.until && step.is_multiple_of(self.every)
    }

    /// Number of scheduled steps up to and including `step` (1-based).
    pub fn count(&self, step: u32) -> u32 {
        let last = step.min(self.until.saturating_sub(1));
        match self.every {
            0 => 0,
            every => (last / every).saturating_sub(self.from / every),
        }
    }
}

/// The opacity resets of the original 3DGS: at regular intervals, plus one for scenes on a white background.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct OpacityResets {
    regular: Window,
    /// Step of the additional reset; `None` if the background is not white.
    white: Option<u32>,
    /// Largest opacity after a reset, in (0, 1).
    max_opacity: f32,
}

impl OpacityResets {
    /// Before `until`, limits opacities to `reset_opacity` at the multiples of `every` and, if the scene's
    /// background is white, at `white_at` (all three in steps; 0: never).
    ///
    /// # Errors
    /// When `reset_opacity`, rounded to f32, is not in (0, 1).
    pub fn new(
        every: u32,
        until: u32,
        white_at: u32,
        reset_opacity: f64,
        scene: &SceneInfo,
    ) -> PolicyResult<Self> {
        let max_opacity = reset_opacity as f32;
        in_range("reset_opacity", f64::from(max_opacity), (Excluded(0.0), Excluded(1.0)))?;
        let white = (scene.white_background && white_at < until).then_some(white_at);
        Ok(Self { regular: Window { from: 0, until, every }, white, max_opacity })
    }

    /// True if opacities are reset at `step` (1-based).
    pub fn is_due(&self, step: u32) -> bool {
        step > 0 && (self.regular.is_due(step) || self.white == Some(step))
    }

    /// Adds the reset of `step` to the plan, if there is one.
    pub fn plan(&self, step: u32, plan: &mut EditPlan) {
        if self.is_due(step) {
            plan.cause("reset");
            // `new` has checked the range, so this is never refused.
            let _ = plan.clamp_opacity(self.max_opacity);
        }
    }
}

/// Number of rows allowed at `step` by the concave growth curve N(x) = S + (B − S)(2x/M − (x/M)²) after
/// x of the window's M intervals, from S = `start` rows at its start to B = `end` at its end (*Taming 3DGS*,
/// Mallick et al. 2024, equation 2). If both ends are multiples of the interval, the last event is
/// number M − 1, just below B, because the end is exclusive.
pub fn concave_curve(window: Window, step: u32, start: usize, end: usize) -> usize {
    let Window { from, until, every } = window;
    if every == 0 {
        return start;
    }
    let intervals = (until.saturating_sub(from) / every).max(1);
    let passed = (step / every).saturating_sub(from / every);
    let progress = (f64::from(passed) / f64::from(intervals)).min(1.0);
    let (start, end) = (start as f64, end as f64);
    (start + (end - start) * (2.0 * progress - progress * progress)).floor() as usize
}

/// Divides a sum over views by the number of views that saw the row. 0 if no view saw it or the mean is not
/// finite. Shape: `[rows]`.
pub fn mean_over_views(sum: &[f32], views: &[f32]) -> Vec<f32> {
    let mean = |(&sum, &views): (&f32, &f32)| {
        let mean = sum / views;
        if views > 0.0 && mean.is_finite() { mean } else { 0.0 }
    };
    sum.iter().zip(views).map(mean).collect()
}

/// Adds to `gradient` the mean of the colour gradient over views, times `weight`.
///
/// # Errors
/// When the policy does not declare [`Signal::VisibleCount`] or [`Signal::ColourGradient`].
pub(crate) fn add_colour_gradient(
    gradient: &mut [f32],
    now: &Snapshot<'_>,
    weight: f32,
) -> PolicyResult {
    let views = now.signal(Signal::VisibleCount)?;
    let colour = mean_over_views(now.signal(Signal::ColourGradient)?, views);
    for (g, c) in gradient.iter_mut().zip(colour) {
        *g += weight * c;
    }
    Ok(())
}

/// A clone: the parent is unchanged, and a copy is placed at `offset` from it `[scene units]`.
pub fn clone_at(offset: [f32; 3]) -> Offspring {
    Offspring {
        children: 1,
        parent: ParentFate::Stays,
        placement: Placement::Offset(offset),
        scale: ScaleRule::Uniform(1.0),
        turn: NO_ROTATION,
        opacity: OpacityRule::Same,
    }
}

/// A split: two children, sampled from the parent and with its scales divided by `factor`, replace it.
pub fn split_by(factor: f32) -> Offspring {
    Offspring {
        parent: ParentFate::BecomesChild,
        placement: Placement::Sampled,
        scale: ScaleRule::Uniform(1.0 / factor),
        ..clone_at([0.0; 3])
    }
}

/// A long-axis split: two halves of the parent along its longest axis replace it.
///
/// With d = `share`, the children are placed at ±3d standard deviations; their longest axis is 1 − d
/// times the parent's, the others √(1 − d²) times. As 3d + 3(1 − d) = 3, the ends of the parent stay in place
/// (*Improving Densification in 3D Gaussian Splatting*, 2025). Opacities are multiplied by `opacity`.
pub fn split_long_axis(share: f32, opacity: f32) -> Offspring {
    Offspring {
        placement: Placement::LongAxis { sigmas: 3.0 * share },
        scale: ScaleRule::LongAxis { long: 1.0 - share, other: (1.0 - share * share).sqrt() },
        opacity: OpacityRule::Scaled(opacity),
        ..split_by(1.0)
    }
}

/// Limits of opacity and size beyond which Gaussians are pruned.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PruneLimits {
    /// Gaussians below this opacity are pruned.
    pub min_opacity: f32,
    /// Gaussians larger than this are pruned `[scene units]`.
    pub max_scale: f32,
}

impl PruneLimits {
    /// The limits at an event. `max_scale` is a fraction of the scene extent (0: no limit) and applies after
    /// step `max_scale_from`.
    pub fn at(now: &Snapshot<'_>, min_opacity: f64, max_scale: f64, max_scale_from: u32) -> Self {
        let limits_size = max_scale > 0.0 && now.step > max_scale_from;
        let max_scale = (max_scale * f64::from(now.scene.extent)) as f32;
        Self {
            min_opacity: min_opacity as f32,
            max_scale: if limits_size { max_scale } else { f32::INFINITY },
        }
    }

    /// True if a Gaussian of this opacity and largest standard deviation `[scene units]` is to be pruned.
    /// Gaussians with non-finite values always are, as training cannot repair them.
    pub fn exceeded(&self, opacity: f32, scale: f32) -> bool {
        !(opacity.is_finite() && scale.is_finite())
            || opacity < self.min_opacity
            || scale > self.max_scale
    }

    /// The rows to prune, ascending.
    ///
    /// # Errors
    /// When the policy does not declare [`Signal::Opacity`] or [`Signal::ScaleMax`].
    pub fn dead_rows(&self, now: &Snapshot<'_>) -> PolicyResult<Vec<u32>> {
        let (opacity, scale) = (now.signal(Signal::Opacity)?, now.signal(Signal::ScaleMax)?);
        let rows = (0..).zip(opacity).zip(scale);
        let dead = rows.filter(|((_, opacity), scale)| self.exceeded(**opacity, **scale));
        Ok(dead.map(|((row, _), _)| row).collect())
    }
}

/// If `dead` lists every row, removes the most opaque one from the list (the first of several): an empty model
/// could never grow again.
pub fn spare_one(dead: &mut Vec<u32>, opacity: &[f32]) {
    if dead.len() == opacity.len() {
        let spared = top_k(opacity, 1);
        dead.retain(|row| !spared.contains(row));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn windows_exclude_their_ends() {
        let window = Window { from: 500, until: 1000, every: 100 };
        let due: Vec<u32> = (0..2000).filter(|&step| window.is_due(step)).collect();
        assert_eq!(due, [600, 700, 800, 900]);
        let never = Window { every: 0, ..window };
        assert!((0..2000).all(|step| !never.is_due(step) && never.count(step) == 0));
        for window in
            [window, Window { from: 450, until: 1001, every: 7 }, Window { until: 0, ..window }]
        {
            let mut count = 0;
            for step in 0..2000 {
                count += u32::from(window.is_due(step));
                assert_eq!(window.count(step), count, "{window:?}, step {step}");
            }
        }
    }

    #[test]
    fn the_concave_curve_matches_values_worked_out_by_hand() {
        // M = 29: after the last event, the 28th at step 14,500, 1/29² of the growth is still missing.
        let window = Window { from: 500, until: 15_000, every: 500 };
        let rows = |step| concave_curve(window, step, 1000, 85_100);
        // x = 1: 84,100·(2/29 − 1/841) = 84,100·57/841 = 5,700.
        assert_eq!([rows(500), rows(1000), rows(1500)], [1000, 6700, 12_200]);
        assert_eq!([rows(14_500), rows(15_000), rows(90_000)], [85_000, 85_100, 85_100]);
        // M = 145: after the 144th and last event, 1/145² of the growth is still missing.
        let frequent = Window { every: 100, ..window };
        assert_eq!(concave_curve(frequent, 14_900, 0, 145 * 145), 145 * 145 - 1);
        assert_eq!(concave_curve(Window { every: 0, ..window }, 900, 7, 9), 7);
        // If the end is below the start, the curve falls and nothing grows.
        assert!(concave_curve(window, 1000, 100, 50) < 100);
    }

    #[test]
    fn long_axis_halves_keep_the_extent_of_their_parent() {
        let half = split_long_axis(0.45, 0.6);
        let (Placement::LongAxis { sigmas }, ScaleRule::LongAxis { long, other }) =
            (half.placement, half.scale)
        else {
            panic!("{half:?}")
        };
        assert!((sigmas - 1.35).abs() < 1e-6 && (long - 0.55).abs() < 1e-6);
        assert!((sigmas + 3.0 * long - 3.0).abs() < 1e-6);
        // √(1 − 0.45²) = 0.893.
        assert!((other - 0.893_029).abs() < 1e-6);
        assert_eq!((half.opacity, half.siblings()), (OpacityRule::Scaled(0.6), 2));
        assert_eq!((half.bad_field(), split_long_axis(0.0, 1.0).bad_field()), (None, None));
    }

    #[test]
    fn means_are_finite() {
        let sum = [6.0, 0.0, 1.0, f32::NAN, f32::INFINITY, 1.0];
        let views = [3.0, 0.0, 0.0, 2.0, 2.0, f32::NAN];
        assert_eq!(mean_over_views(&sum, &views), [2.0, 0.0, 0.0, 0.0, 0.0, 0.0]);
    }

    #[test]
    fn faint_huge_and_non_finite_rows_are_pruned() {
        let limits = PruneLimits { min_opacity: 0.005, max_scale: 2.0 };
        assert!(!limits.exceeded(0.005, 2.0));
        assert!(limits.exceeded(0.0049, 1.0) && limits.exceeded(0.5, 2.1));
        assert!(limits.exceeded(f32::NAN, 1.0) && limits.exceeded(0.5, f32::NAN));
        let any_size = PruneLimits { max_scale: f32::INFINITY, ..limits };
        assert!(!any_size.exceeded(0.5, 1e30) && any_size.exceeded(0.5, f32::INFINITY));
    }

    #[test]
    fn reset_opacities_outside_0_to_1_are_refused() {
        let scene = crate::event::Event::new(1, 1, 1).scene;
        // The last value rounds to 1 as f32.
        for opacity in [0.0, 1.0, f64::NAN, 0.999_999_99] {
            assert!(OpacityResets::new(3000, 15_000, 500, opacity, &scene).is_err(), "{opacity}");
        }
    }

    #[test]
    fn one_row_is_spared() {
        let opacity = [0.001, 0.003, f32::NAN, 0.003];
        let mut dead = vec![0, 1, 2, 3];
        spare_one(&mut dead, &opacity);
        assert_eq!(dead, [0, 2, 3]);
        spare_one(&mut dead, &opacity);
        assert_eq!(dead, [0, 2, 3]);
        let mut empty = Vec::new();
        spare_one(&mut empty, &[]);
        assert!(empty.is_empty());
    }
}
