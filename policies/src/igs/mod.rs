//! # igs — long-axis splits at image edges
//!
//! Splits Gaussians along their longest axis, preferably those at image edges, so that the number of
//! Gaussians follows a square-root curve up to the budget.
//!
//! Source: Improved-GS, *Improving Densification in 3D Gaussian Splatting for High-Fidelity Rendering*,
//! Deng, Diao, Li, Yu, Xu, 2025, arXiv 2508.12313, with the constants of its public code.
//!
//! ## Method
//!
//! **Growth**, every `grow_every` steps between `grow_from` and `grow_until`. The model may have
//! budget · √((step − `grow_from`) / (`curve_until` − `grow_from`)) Gaussians, at most the budget.
//! Candidates have an absolute screen gradient of at least `tau`: the norm of the loss gradient with
//! respect to the projected mean (NDC), with absolute values summed over pixels, averaged over the
//! views that saw the Gaussian. Candidates are drawn without replacement, in proportion to their edge
//! scores, until the curve is reached. To compute the scores, `views` random training views are rendered;
//! in each, a Gaussian's score is the sum of the edges (the Laplacian of the photograph's luma, scaled to 0..1)
//! over the pixels that it is blended into, divided by the mean of all positive sums of the view; the scores of
//! all views are added. The first growth step after a recovery prune (see below) uses all views. After
//! `final_from` the gradient itself is the score, no view is rendered, and `tau` is divided by
//! `final_divisor`.
//!
//! A candidate is **split along its longest axis**. With d = `split_share`, two children are placed at
//! ±3d standard deviations; their longest axis is 1 − d times the parent's, the others √(1 − d²)
//! times, so that both ends of the parent stay in place. Their opacity is the parent's times `child_opacity`.
//!
//! **Pruning** follows the splits of the same step; the next growth step uses the room it makes, and
//! Gaussians below the opacity limit may be drawn before they are pruned. Each growth step prunes Gaussians
//! below `min_opacity`, but the last does so only with `prune_last`, because nothing would take their
//! place. `recover` steps after each of the first `recoveries` opacity resets, a recovery prune also
//! removes the share `recovery_share` of the remaining Gaussians, those with the lowest opacity: a Gaussian
//! that has not recovered is not needed. Before growth starts, at step `first_prune_at`, Gaussians below
//! `first_prune_opacity` are pruned.
//!
//! **Opacity resets** limit opacities to `reset_opacity` every `reset_every` steps, `resets` times in
//! total, and never from `grow_until` on. By default only the first two are followed by a recovery prune.
//!
//! **The optimiser** steps at every iteration up to `sum_from`, then once per `sum` iterations, and after
//! `sum_more_from` once per `sum_more` iterations, on the gradients summed in between. The learning rate of the
//! means falls from `mean_start` to `mean_end`; that of SH bands 1–3 is `sh_rest`. (`--lr` overrides both.)
//!
//! ## Differences from the published code
//!
//! - **`sums`.** The published values of `sum` and `sum_more`, 5 and 20, give 1,500 + 375 optimiser steps
//!   in the second half of 30,000 iterations, but 350 + 88 in a run of 7,000. By default (`"scaled"`) both are
//!   multiplied by iterations / 30,000 and rounded, at least 1, so that a short run has about as many optimiser
//!   steps as a full one if it has enough iterations; a run of 7,000 uses 1 and 5. `"fixed"` uses the same values
//!   in a run of any length.
//! - The published code splits, then prunes. A plan has one edit per Gaussian: if a Gaussian is drawn and
//!   its children would be pruned in the same event, it is pruned itself. The result is the same.
//! - `recover` is a number of optimiser steps, so it does not scale with the length of the run; it is limited to
//!   half the interval of resets, so that the prune comes before the next reset.
//! - The published code averages gradients from step 500 on; here the first growth step averages over
//!   all steps before it.
//! - The published code divides edge scores by their mean over all Gaussians; here the mean is over the
//!   Gaussians with a positive score in the view.
//! - At least one Gaussian is always kept.
//!
//! ## Parameters
//!
//! | name | default | range | unit | meaning |
//! |---|---|---|---|---|
//! | grow_from | 500 | >= 0 | step | start of growth and pruning (exclusive) |
//! | grow_until | 15000 | >= 0 | step | end of growth, pruning and resets (exclusive) |
//! | grow_every | 100 | >= 0 | steps | interval of growth and pruning; 0: never |
//! | curve_until | 14500 | >= 0 | step | step at which the growth curve reaches the budget |
//! | tau | 0.0003 | >= 0 | 1 / NDC | absolute screen gradient from which a Gaussian may be split |
//! | views | 10 | >= 1 | views | views rendered per growth step; all if there are fewer |
//! | split_share | 0.45 | 0 to 1, both excluded | | d of the split |
//! | child_opacity | 0.6 | 0 to 1, 0 excluded | | factor on the children's opacity |
//! | final_from | 14500 | >= 0 | step | start of growth by gradient (exclusive) |
//! | final_divisor | 1.5 | >= 1 | | divisor of `tau` after `final_from` |
//! | min_opacity | 0.005 | 0 to 1 | | Gaussians below this opacity are pruned |
//! | prune_last | false | | | also prune at the last growth step |
//! | first_prune_at | 300 | >= 0 | step | step of the first prune; 0: none |
//! | first_prune_opacity | 0.02 | 0 to 1 | | opacity limit of the first prune |
//! | reset_every | 3000 | >= 0 | steps | interval of opacity resets; 0: never |
//! | resets | 4 | >= 0 | | number of opacity resets |
//! | reset_opacity | 0.05 | 0 to 1, both excluded | | largest opacity after a reset |
//! | recover | 300 | >= 1 | steps | steps from a reset to its recovery prune |
//! | recoveries | 2 | >= 0 | | number of recovery prunes, one after each of the first resets |
//! | recovery_share | 0.2 | 0 to 1 | Gaussians | share that a recovery prune removes; 0: none |
//! | sum_from | 15000 | >= 0 | step | start of summing gradients over `sum` iterations (exclusive) |
//! | sum | 5 | 1 to 1000 | steps | iterations per optimiser step after `sum_from` |
//! | sum_more_from | 22500 | >= 0 | step | start of summing gradients over `sum_more` iterations (exclusive) |
//! | sum_more | 20 | 1 to 1000 | steps | iterations per optimiser step after `sum_more_from` |
//! | sums | "scaled" | scaled, fixed | | whether `sum` and `sum_more` scale with the length of the run |
//! | mean_start | 0.00004 | > 0 | extent / step | learning rate of the means at the start |
//! | mean_end | 0.000002 | > 0 | extent / step | learning rate of the means at the end |
//! | sh_rest | 0.00025 | > 0 | | learning rate of SH bands 1–3 |
//!
//! Defaults in steps are for a run of 30,000 iterations and scale with its length; intervals
//! (`…_every`) do not shrink below 100 steps. `recover` does not scale. Values set by the user do not scale,
//! except `sum` and `sum_more`, unless `sums` is `"fixed"`.

use crate::adc::{OpacityResets, PruneLimits, Window, mean_over_views, spare_one, split_long_axis};
use crate::parameters::StepParameter::{self, Interval, Step};
use crate::plan::{EditPlan, Reset};
use crate::policy::{
    AuxColumn, AuxRequest, AuxView, Cadence, DensityPolicy, Needs, PixelMap, PolicyResult, Rate,
    RateOverrides, SceneInfo, Signal, Snapshot,
};
use crate::registry::ConfiguredPolicy;
use crate::rng::PolicyRng;
use crate::sample::weighted;

mod parameters;

pub(crate) use parameters::MAX_SUM;
pub use parameters::{IgsParams, SumScaling};

crate::register_policy!(
    "igs",
    Igs,
    summary: "long-axis splits at image edges, along a square-root growth curve",
    source: "Improved-GS, Deng et al. 2025, arXiv 2508.12313",
    doc: include_str!("mod.rs"),
);

/// Long-axis splits by edge score.
#[derive(Debug)]
pub struct Igs {
    params: IgsParams,
    grow: Window,
    resets: OpacityResets,
    /// Steps from a reset to its recovery prune.
    recover: u32,
    /// Iterations per optimiser step after `sum_from`, and after `sum_more_from`, in this run.
    sums: [u32; 2],
    score: EdgeScore,
}

/// Edge score of each row over the views of one event. Not saved, as each event starts from zero.
#[derive(Debug, Default)]
struct EdgeScore {
    step: u32,
    rows: Vec<f32>,
}

impl ConfiguredPolicy for Igs {
    type Params = IgsParams;

    const STEP_PARAMETERS: &'static [StepParameter] = &[
        Step("grow_from"),
        Step("grow_until"),
        Interval("grow_every"),
        Step("curve_until"),
        Step("final_from"),
        Step("first_prune_at"),
        Interval("reset_every"),
        Step("sum_from"),
        Step("sum_more_from"),
    ];

    fn new(params: IgsParams, scene: &SceneInfo) -> PolicyResult<Self> {
        params.check()?;
        let IgsParams { grow_from: from, grow_until: until, grow_every: every, .. } = params;
        let last_reset = params.reset_every.saturating_mul(params.resets);
        let resets_until = until.min(last_reset.saturating_add(1));
        let opacity = params.reset_opacity;
        Ok(Self {
            grow: Window { from, until, every },
            resets: OpacityResets::new(params.reset_every, resets_until, 0, opacity, scene)?,
            recover: params.recover.min((params.reset_every / 2).max(1)),
            sums: params.scaled_sums(scene.iterations),
            score: EdgeScore::default(),
            params,
        })
    }
}

impl DensityPolicy for Igs {
    fn needs(&self, _scene: &SceneInfo) -> Needs {
        let params = &self.params;
        let map = PixelMap { edge: 1.0, ..PixelMap::default() };
        Needs {
            signals: [Signal::VisibleCount, Signal::ScreenGradientAbs, Signal::Opacity].into(),
            aux: Some(AuxRequest {
                map,
                columns: vec![AuxColumn::MapSum],
                ..AuxRequest::default()
            }),
            cadence: Cadence { all: self.sums[0].max(self.sums[1]), sh_rest: 1 },
            rates: RateOverrides {
                mean: Some(Rate { start: params.mean_start, end: params.mean_end }),
                sh_rest: Some(Rate::constant(params.sh_rest)),
                ..RateOverrides::default()
            },
            ..Needs::default()
        }
    }

    fn is_due(&self, step: u32) -> bool {
        self.grow.is_due(step)
            || self.is_first_prune(step)
            || self.resets.is_due(step)
            || self.is_recovery_prune(step)
    }

    fn cadence(&self, step: u32) -> Cadence {
        let all = match step {
            _ if step > self.params.sum_more_from => self.sums[1],
            _ if step > self.params.sum_from => self.sums[0],
            _ => 1,
        };
        Cadence { all, sh_rest: 1 }
    }

    fn aux_views(&self, step: u32, _rows: usize, _budget: usize) -> u32 {
        if !self.grow.is_due(step) || self.is_final(step) {
            return 0;
        }
        let last_growth = step - self.params.grow_every.min(step);
        let after_prune = (last_growth..step).any(|step| self.is_recovery_prune(step));
        if after_prune { u32::MAX } else { self.params.views }
    }

    fn observe(&mut self, view: &AuxView<'_>) -> PolicyResult {
        self.score.add(view.step, view.column(AuxColumn::MapSum)?);
        Ok(())
    }

    fn plan(&mut self, now: &Snapshot<'_>, rng: &PolicyRng, plan: &mut EditPlan) -> PolicyResult {
        let score = std::mem::take(&mut self.score);
        let drawn = self.draw(now, &score, rng, plan.budget())?;
        self.prune(now, &drawn, plan)?;
        let IgsParams { split_share, child_opacity, .. } = self.params;
        let split = split_long_axis(split_share as f32, child_opacity as f32);
        for &row in &drawn {
            // A row whose children would be pruned has been pruned itself and is not split.
            if plan.is_free(row) {
                let _ = plan.grow(row, split);
            }
        }
        if self.grow.is_due(now.step) {
            plan.cause("grow");
        }
        let step = now.step;
        if !drawn.is_empty() || self.is_first_prune(step) || self.is_recovery_prune(step) {
            plan.reset(Reset::Signals);
        }
        self.resets.plan(step, plan);
        Ok(())
    }
}

impl EdgeScore {
    /// Adds one view: each row's sum, divided by the mean of the positive sums.
    fn add(&mut self, step: u32, sums: &[f32]) {
        if self.step != step || self.rows.len() != sums.len() {
            *self = Self { step, rows: vec![0.0; sums.len()] };
        }
        let positive = sums.iter().filter(|sum| **sum > 0.0).map(|sum| f64::from(*sum));
        let (count, total) = positive.fold((0.0, 0.0), |(n, total), sum| (n + 1.0, total + sum));
        for (score, &sum) in self.rows.iter_mut().zip(sums) {
            let relative = (f64::from(sum) * count / total) as f32;
            if relative > 0.0 {
                *score += relative;
            }
        }
    }
}

impl Igs {
    fn is_first_prune(&self, step: u32) -> bool {
        step > 0 && step == self.params.first_prune_at
    }

    fn is_recovery_prune(&self, step: u32) -> bool {
        let IgsParams { reset_every, recoveries, recovery_share, grow_until, .. } = self.params;
        let last = reset_every.saturating_mul(recoveries);
        recovery_share > 0.0
            && step < grow_until
            && step
                .checked_sub(self.recover)
                .is_some_and(|reset| reset <= last && self.resets.is_due(reset))
    }

    /// True if candidates at `step` are drawn by their gradients instead of edge scores.
    fn is_final(&self, step: u32) -> bool {
        step > self.params.final_from
    }

    /// Limits below which rows are pruned at `step` before candidates are drawn.
    fn first_limits(&self, step: u32) -> PruneLimits {
        let first = self.params.first_prune_opacity as f32;
        let min_opacity = if self.is_first_prune(step) { first } else { 0.0 };
        PruneLimits { min_opacity, max_scale: f32::INFINITY }
    }

    /// Number of rows that the growth curve allows at `step`.
    fn allowed(&self, step: u32, budget: usize) -> usize {
        let IgsParams { grow_from, curve_until, .. } = self.params;
        let length = f64::from(curve_until.saturating_sub(grow_from).max(1));
        let passed = f64::from(step.saturating_sub(grow_from)) / length;
        (budget as f64 * passed.min(1.0).sqrt()).floor() as usize
    }

    /// Draws candidates to split in proportion to their scores, as many as the curve allows.
    fn draw(
        &self,
        now: &Snapshot<'_>,
        score: &EdgeScore,
        rng: &PolicyRng,
        budget: usize,
    ) -> PolicyResult<Vec<u32>> {
        if !self.grow.is_due(now.step) {
            return Ok(Vec::new());
        }
        let opacity = now.signal(Signal::Opacity)?;
        let limits = self.first_limits(now.step);
        let views = now.signal(Signal::VisibleCount)?;
        let gradient = mean_over_views(now.signal(Signal::ScreenGradientAbs)?, views);
        let is_final = self.is_final(now.step);
        let divisor = if is_final { self.params.final_divisor } else { 1.0 };
        let tau = (self.params.tau / divisor) as f32;
        let weight = |row: usize| {
            let is_candidate = gradient[row] >= tau && !limits.exceeded(opacity[row], 0.0);
            let weight = if is_final { Some(&gradient[row]) } else { score.rows.get(row) };
            if is_candidate { weight.copied().unwrap_or(0.0) } else { 0.0 }
        };
        let weights: Vec<f32> = (0..now.rows()).map(weight).collect();
        let rows = opacity.iter().filter(|&&opacity| !limits.exceeded(opacity, 0.0)).count();
        let count = self.allowed(now.step, budget).saturating_sub(rows);
        Ok(weighted(&weights, count, rng))
    }

    /// Prunes rows as if those in `drawn` were already split.
    fn prune(&self, now: &Snapshot<'_>, drawn: &[u32], plan: &mut EditPlan) -> PolicyResult {
        let opacity = now.signal(Signal::Opacity)?;
        let limits = self.first_limits(now.step);
        if self.is_first_prune(now.step) {
            plan.cause("first-prune");
        }
        // The opacity of each row after the splits (for split rows, of each child); NaN for rows pruned before the
        // splits.
        let is_pruned = |&opacity: &f32| limits.exceeded(opacity, 0.0);
        let mut after: Vec<f32> =
            opacity.iter().map(|o| if is_pruned(o) { f32::NAN } else { *o }).collect();
        for &row in drawn {
            after[row as usize] *= self.params.child_opacity as f32;
        }
        let mut limit = 0.0;
        let is_last = !self.grow.is_due(now.step.saturating_add(self.params.grow_every));
        if self.grow.is_due(now.step) && (self.params.prune_last || !is_last) {
            limit = self.params.min_opacity as f32;
        }
        if self.is_recovery_prune(now.step) {
            plan.cause("recovery-prune");
            let children = drawn.iter().map(|row| &after[*row as usize]);
            let left = after.iter().chain(children).copied().filter(|&o| o >= limit);
            limit = limit_of_share(left.collect(), self.params.recovery_share).max(limit);
        }
        let is_kept = |row: &u32| after[*row as usize] >= limit;
        let mut dead: Vec<u32> = (0..now.rows() as u32).filter(|row| !is_kept(row)).collect();
        spare_one(&mut dead, opacity);
        plan.prune_all(dead);
        Ok(())
    }
}

/// The smallest value that is not below the interpolated `share` quantile. Equal values are never separated: all of
/// them are below the limit, or none.
fn limit_of_share(mut values: Vec<f32>, share: f64) -> f32 {
    if values.is_empty() {
        return 0.0;
    }
    let rank = share * (values.len() - 1) as f64;
    // A product just above an integer counts as that integer: its relative error is at most 2⁻⁵³.
    let rank = (rank * (1.0 - f64::EPSILON)).ceil() as usize;
    *values.select_nth_unstable_by(rank, f32::total_cmp).1
}

#[cfg(test)]
mod tests;
