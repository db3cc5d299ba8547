//! # igs — long-axis splits at image edges
//!
//! Splits Gaussians along their longest axis, those at image edges first, so that the number of
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
//! views that saw the Gaussian. As many candidates as the curve allows are drawn without replacement,
//! in proportion to their edge scores. For these, `views` random training views are rendered; in each,
//! a Gaussian's score is the sum of the edge map over the pixels that it is blended into, divided by
//! the mean of all Gaussians with a positive sum; the scores of all views are added. At the first
//! growth after a recovery prune all views are used. From `final_from` on the gradient itself is the
//! score, no view is rendered, and `tau` is divided by `final_divisor`.
//!
//! A candidate is **split along its longest axis**. With d = `split_share`, two children are placed at
//! ±3d standard deviations; their longest axis is 1 − d times the parent's, the others √(1 − d²)
//! times, so that both ends stay in place. Their opacity is the parent's times `child_opacity`.
//!
//! **Pruning** removes Gaussians less opaque than `first_prune_opacity` at step `first_prune_at`, and
//! those less opaque than `min_opacity` before every growth. `recover` steps after each opacity reset
//! it removes the share `recovery_share` of all Gaussians with the lowest opacity: those that have not
//! recovered are not needed.
//!
//! **Opacity resets** limit opacities to `reset_opacity` every `reset_every` steps, `resets` times in
//! all, and never from `grow_until` on.
//!
//! **The optimiser** steps at every iteration up to `sum_from`, then once per `sum` iterations, after
//! `sum_more_from` once per `sum_more`, on the summed gradients. The learning rate of the means falls
//! from `mean_start` to `mean_end`; that of SH bands 1–3 is `sh_rest`. (`--lr` overrides both.)
//!
//! ## Differences from the published code
//!
//! - `recover` counts optimiser steps and does not scale with the length of the run, but is at most half
//!   the interval of resets, so that the prune comes before the next reset.
//! - The published code divides edge scores by their mean over all Gaussians; here it is the mean over
//!   those that the view shows.
//! - The last Gaussian is never pruned.
//!
//! ## Parameters
//!
//! | name | default | range | unit | meaning |
//! |---|---|---|---|---|
//! | grow_from | 500 | >= 0 | step | start of growth and pruning (exclusive) |
//! | grow_until | 15000 | >= 0 | step | end of growth, pruning and resets (exclusive) |
//! | grow_every | 100 | >= 0 | steps | interval of growth and pruning; 0: never |
//! | curve_until | 14500 | >= 0 | step | when the growth curve reaches the budget |
//! | tau | 0.0003 | >= 0 | 1 / NDC | absolute screen gradient from which a Gaussian may be split |
//! | views | 10 | >= 1 | views | views rendered per growth; all if there are fewer |
//! | split_share | 0.45 | 0 to 1, both excluded | | d of the split |
//! | child_opacity | 0.6 | 0 to 1, 0 excluded | | factor on the children's opacity |
//! | final_from | 14500 | >= 0 | step | start of growth by gradient |
//! | final_divisor | 1.5 | >= 1 | | divides `tau` from then on |
//! | min_opacity | 0.005 | 0 to 1 | | Gaussians below this opacity are pruned |
//! | first_prune_at | 300 | >= 0 | step | the first pruning; 0: none |
//! | first_prune_opacity | 0.02 | 0 to 1 | | opacity limit of the first pruning |
//! | reset_every | 3000 | >= 0 | steps | interval of opacity resets; 0: never |
//! | resets | 2 | >= 0 | | number of opacity resets |
//! | reset_opacity | 0.05 | 0 to 1, both excluded | | largest opacity after a reset |
//! | recover | 300 | >= 1 | steps | from a reset to the recovery prune |
//! | recovery_share | 0.2 | 0 to 1 | Gaussians | share that the recovery prune removes; 0: none |
//! | sum_from | 15000 | >= 0 | step | start of summed gradients (exclusive) |
//! | sum | 5 | 1 to 1000 | steps | iterations per optimiser step from then on |
//! | sum_more_from | 22500 | >= 0 | step | start of longer sums (exclusive) |
//! | sum_more | 20 | 1 to 1000 | steps | iterations per optimiser step from then on |
//! | mean_start | 0.00004 | > 0 | extent / step | learning rate of the means at the start |
//! | mean_end | 0.000002 | > 0 | extent / step | learning rate of the means at the end |
//! | sh_rest | 0.00025 | > 0 | | learning rate of SH bands 1–3 |
//!
//! Defaults in steps are for a run of 30,000 iterations and scale with its length; intervals
//! (`…_every`) do not shrink below 100 steps. `recover`, `sum` and `sum_more` do not scale.

use crate::adc::{OpacityResets, PruneLimits, Window, mean_over_views, spare_one, split_long_axis};
use crate::parameters::StepParameter::{self, Interval, Step};
use crate::plan::{EditPlan, Reset};
use crate::policy::{
    AuxColumn, AuxRequest, AuxView, Cadence, DensityPolicy, Needs, PixelMap, PolicyResult, Rate,
    RateOverrides, SceneInfo, Signal, SignalSet, Snapshot,
};
use crate::registry::ConfiguredPolicy;
use crate::rng::PolicyRng;
use crate::sample::{smallest, weighted};

mod parameters;

pub use parameters::IgsParams;

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
    score: EdgeScore,
}

/// Edge scores of the current event. They are not saved: each event starts anew.
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
            score: EdgeScore::default(),
            params,
        })
    }
}

impl DensityPolicy for Igs {
    fn needs(&self, _scene: &SceneInfo) -> Needs {
        let params = &self.params;
        Needs {
            signals: SignalSet::from([
                Signal::VisibleCount,
                Signal::ScreenGradientAbs,
                Signal::Opacity,
            ]),
            aux: Some(AuxRequest {
                map: PixelMap { error: 0.0, edge: 1.0 },
                columns: vec![AuxColumn::MapSum],
                points: 0,
            }),
            cadence: Cadence { all: params.sum.max(params.sum_more), sh_rest: 1 },
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
            _ if step > self.params.sum_more_from => self.params.sum_more,
            _ if step > self.params.sum_from => self.params.sum,
            _ => 1,
        };
        Cadence { all, sh_rest: 1 }
    }

    fn aux_views(&self, step: u32, _rows: usize, _budget: usize) -> u32 {
        if !self.grow.is_due(step) || step >= self.params.final_from {
            return 0;
        }
        // The first growth after a recovery prune.
        let since = step - self.params.grow_every.min(step);
        let after_prune = (since..step).any(|step| self.is_recovery_prune(step));
        if after_prune { u32::MAX } else { self.params.views }
    }

    fn observe(&mut self, view: &AuxView<'_>) -> PolicyResult {
        self.score.add(view.step, view.column(AuxColumn::MapSum)?);
        Ok(())
    }

    fn plan(&mut self, now: &Snapshot<'_>, rng: &PolicyRng, plan: &mut EditPlan) -> PolicyResult {
        let score = std::mem::take(&mut self.score);
        self.prune(now, plan)?;
        if self.grow.is_due(now.step) {
            plan.cause("grow");
            self.split(now, &score, rng, plan)?;
            plan.reset(Reset::Signals);
        }
        self.resets.plan(now.step, plan);
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
        self.params.recovery_share > 0.0
            && step < self.params.grow_until
            && step.checked_sub(self.recover).is_some_and(|reset| self.resets.is_due(reset))
    }

    /// Number of rows that the growth curve allows at `step`.
    fn allowed(&self, step: u32, budget: usize) -> usize {
        let IgsParams { grow_from, curve_until, .. } = self.params;
        let length = f64::from(curve_until.saturating_sub(grow_from).max(1));
        let passed = f64::from(step.saturating_sub(grow_from)) / length;
        (budget as f64 * passed.min(1.0).sqrt()).floor() as usize
    }

    fn prune(&self, now: &Snapshot<'_>, plan: &mut EditPlan) -> PolicyResult {
        let opacity = now.signal(Signal::Opacity)?;
        let mut least: f64 = 0.0;
        if self.grow.is_due(now.step) {
            least = self.params.min_opacity;
        }
        if self.is_first_prune(now.step) {
            least = least.max(self.params.first_prune_opacity);
            plan.cause("first-prune");
        }
        let limits = PruneLimits { min_opacity: least as f32, max_scale: f32::INFINITY };
        let is_dead = |row: &u32| limits.exceeded(opacity[*row as usize], 0.0);
        let (mut dead, mut living): (Vec<u32>, Vec<u32>) =
            (0..now.rows() as u32).partition(is_dead);
        if self.is_recovery_prune(now.step) {
            plan.cause("recovery-prune");
            let count = (self.params.recovery_share * now.rows() as f64).floor() as usize;
            living = smallest(living, opacity, count.saturating_sub(dead.len()));
            dead.append(&mut living);
            dead.sort_unstable();
        }
        spare_one(&mut dead, opacity);
        plan.prune_all(dead);
        Ok(())
    }

    /// Splits candidates, drawn by their scores, as far as the curve allows.
    fn split(
        &self,
        now: &Snapshot<'_>,
        score: &EdgeScore,
        rng: &PolicyRng,
        plan: &mut EditPlan,
    ) -> PolicyResult {
        let views = now.signal(Signal::VisibleCount)?;
        let gradient = mean_over_views(now.signal(Signal::ScreenGradientAbs)?, views);
        let by_gradient = now.step >= self.params.final_from;
        let divisor = if by_gradient { self.params.final_divisor } else { 1.0 };
        let tau = (self.params.tau / divisor) as f32;
        let weight = |row: usize| {
            let is_candidate = gradient[row] >= tau && plan.is_free(row as u32);
            let score = if by_gradient { Some(&gradient[row]) } else { score.rows.get(row) };
            if is_candidate { score.copied().unwrap_or(0.0) } else { 0.0 }
        };
        let weights: Vec<f32> = (0..now.rows()).map(weight).collect();
        let rows = plan.rows() - plan.pruned();
        let count = self.allowed(now.step, plan.budget()).saturating_sub(rows);
        let split =
            split_long_axis(self.params.split_share as f32, self.params.child_opacity as f32);
        for row in weighted(&weights, count, rng) {
            // A refusal is counted by the plan.
            let _ = plan.grow(row, split);
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests;
