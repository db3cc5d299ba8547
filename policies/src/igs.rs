//! # igs — long-axis splits where the images have edges
//!
//! Improved-GS: *Improving Densification in 3D Gaussian Splatting for High-Fidelity Rendering*, Deng,
//! Diao, Li, Yu, Xu, 2025, arXiv 2508.12313, with the constants of its public code.
//!
//! ## What it does
//!
//! **Growth**, after every `grow_every` steps between `grow_from` and `grow_until`. The model may have
//! as many rows as budget · √((step − `grow_from`) / (`curve_until` − `grow_from`)), at most the
//! budget. Rows are eligible whose absolute screen gradient (mean over the views that saw them of the
//! norm of the loss gradient by their mean on screen (NDC), its absolute values summed over pixels)
//! is at least `tau`. Of these as many as there are to come are drawn without replacement, in
//! proportion to their edge score: `views` training views, chosen at random, are rendered, each row's
//! sum of the edge map over the pixels that it is blended into is divided by the mean of all rows
//! that have any, and the quotients are added up. At the first growth after a recovery prune all
//! views are used. From `final_from` on the gradient itself is the score, no view is rendered, and
//! `tau` is divided by `final_divisor`.
//!
//! A row grows in one way: it is **split along its longest axis**. With d = `split_share`, two
//! children stand at ±3d standard deviations; their longest axis is 1 − d times the parent's, the
//! others √(1 − d²) times, so that the ends stay where they were; opacity is multiplied by
//! `child_opacity`.
//!
//! **Pruning**: at `first_prune_at`, rows less opaque than `first_prune_opacity`; at every growth,
//! before it, those less opaque than `min_opacity`; and the `recovery_share` of all rows with the
//! lowest opacity, `recover` steps after each opacity reset: what has not recovered is not needed.
//!
//! **Opacity resets** to at most `reset_opacity` after every `reset_every` steps, `resets` of them in
//! all, none from `grow_until` on.
//!
//! **The optimiser** steps every iteration up to `sum_from`, then once for `sum` iterations, after
//! `sum_more_from` once for `sum_more`, on the sum of their gradients. The means' step size falls from
//! `mean_start` to `mean_end`; that of the colour bands 1–3 is `sh_rest`. (`--lr` wins over these.)
//!
//! ## Where we depart from the source
//!
//! - `recover` counts optimiser steps and does not scale with the length of the run; but it is never
//!   more than half the interval of resets, so that no reset comes between.
//! - The source normalises edge scores by their mean; we take the mean over the rows that a view
//!   shows.
//! - The last row is never pruned.
//!
//! ## Parameters
//!
//! | name | default | range | unit | what |
//! |---|---|---|---|---|
//! | grow_from | 500 | >= 0 | step | start of growth and pruning (exclusive) |
//! | grow_until | 15000 | >= 0 | step | end of growth, pruning and resets (exclusive) |
//! | grow_every | 100 | >= 0 | steps | interval of growth and pruning; 0: never |
//! | curve_until | 14500 | >= 0 | step | when the model may have as many rows as the budget |
//! | tau | 0.0003 | >= 0 | 1 / NDC | absolute screen gradient from which a row may grow |
//! | views | 10 | >= 1 | views | views rendered per growth; all if there are fewer |
//! | split_share | 0.45 | 0 to 1, both excluded | | d of the split |
//! | child_opacity | 0.6 | 0 to 1, 0 excluded | | factor of the children's opacity |
//! | final_from | 14500 | >= 0 | step | start of growth by gradient |
//! | final_divisor | 1.5 | >= 1 | | by which `tau` is divided then |
//! | min_opacity | 0.005 | 0 to 1 | | opacity below which a row is pruned |
//! | first_prune_at | 300 | >= 0 | step | the first pruning; 0: none |
//! | first_prune_opacity | 0.02 | 0 to 1 | | opacity below which it prunes |
//! | reset_every | 3000 | >= 0 | steps | interval of opacity resets; 0: never |
//! | resets | 2 | >= 0 | | number of opacity resets |
//! | reset_opacity | 0.05 | 0 to 1, both excluded | | largest opacity after a reset |
//! | recover | 300 | >= 1 | steps | from a reset to the recovery prune |
//! | recovery_share | 0.2 | 0 to 1 | rows | share of the rows that it prunes; 0: none |
//! | sum_from | 15000 | >= 0 | step | start of summed gradients (exclusive) |
//! | sum | 5 | 1 to 1000 | steps | iterations per optimiser step then; 1: every one |
//! | sum_more_from | 22500 | >= 0 | step | start of longer sums (exclusive) |
//! | sum_more | 20 | 1 to 1000 | steps | iterations per optimiser step then; 1: every one |
//! | mean_start | 0.00004 | > 0 | extent / step | step size of the means at the start |
//! | mean_end | 0.000002 | > 0 | extent / step | step size of the means at the end |
//! | sh_rest | 0.00025 | > 0 | | step size of the colour bands 1–3 |
//!
//! Defaults that are steps are for a run of 30,000 and scale with its length, intervals (`…_every`)
//! down to 100 steps at most; `recover` and the sums do not.

use crate::adc::{Mortality, Window, mean_over_views, spare_one, split_long_axis};
use crate::plan::{EditPlan, Reset};
use crate::policy::{
    AuxColumn, AuxRequest, AuxView, Cadence, DensityPolicy, Needs, PixelMap, PolicyError,
    PolicyState, RateOverrides, SceneInfo, Signal, SignalSet, Snapshot, restore_nothing,
};
use crate::registry::ConfiguredPolicy;
use crate::rng::PolicyRng;
use crate::sample::{smallest, weighted};

mod parameters;

pub use parameters::IgsParams;

crate::register_policy!(
    "igs",
    Igs,
    summary: "long-axis splits along a square-root curve, where the images have edges",
    source: "Improved-GS, Deng et al. 2025, arXiv 2508.12313",
    doc: include_str!("igs.rs"),
);

/// Long-axis splits by edge score.
#[derive(Debug)]
pub struct Igs {
    params: IgsParams,
    grow: Window,
    /// Steps from a reset to its recovery prune.
    recover: u32,
    score: EdgeScore,
}

/// Edge scores of the event at hand. No state: they are gone with the event.
#[derive(Debug, Default)]
struct EdgeScore {
    step: u32,
    rows: Vec<f32>,
}

impl ConfiguredPolicy for Igs {
    type Params = IgsParams;

    const STEP_PARAMETERS: &'static [&'static str] = &[
        "grow_from",
        "grow_until",
        "grow_every",
        "curve_until",
        "final_from",
        "first_prune_at",
        "reset_every",
        "sum_from",
        "sum_more_from",
    ];

    fn new(params: IgsParams, _scene: &SceneInfo) -> Result<Self, PolicyError> {
        params.check()?;
        let IgsParams { grow_from: from, grow_until: until, grow_every: every, .. } = params;
        Ok(Self {
            grow: Window { from, until, every },
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
            signals: SignalSet::of(&[
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
                mean_start: Some(params.mean_start),
                mean_end: Some(params.mean_end),
                sh_rest: Some(params.sh_rest as f32),
            },
            ..Needs::default()
        }
    }

    fn is_due(&self, step: u32) -> bool {
        self.grow.is_due(step)
            || self.prunes_first_at(step)
            || self.resets_at(step)
            || self.recovered_at(step)
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
        let after_prune = (since..step).any(|step| self.recovered_at(step));
        if after_prune { u32::MAX } else { self.params.views }
    }

    fn observe(&mut self, view: &AuxView<'_>) -> Result<(), PolicyError> {
        self.score.add(view.step, view.column(AuxColumn::MapSum)?);
        Ok(())
    }

    fn plan(
        &mut self,
        now: &Snapshot<'_>,
        rng: &PolicyRng,
        plan: &mut EditPlan,
    ) -> Result<(), PolicyError> {
        let score = std::mem::take(&mut self.score);
        self.prune(now, plan)?;
        if self.grow.is_due(now.step) {
            plan.cause("grow");
            self.split(now, &score, rng, plan)?;
            plan.reset(Reset::Signals);
        }
        if self.resets_at(now.step) {
            plan.cause("reset");
            // In range since `new`.
            let _ = plan.clamp_opacity(self.params.reset_opacity as f32);
        }
        Ok(())
    }

    fn save(&self) -> PolicyState {
        PolicyState::Null
    }

    fn restore(&mut self, state: PolicyState) -> Result<(), PolicyError> {
        restore_nothing(&state)
    }
}

impl EdgeScore {
    /// Adds one view: each row's sum, divided by the mean of the rows that have any.
    fn add(&mut self, step: u32, sums: &[f32]) {
        if self.step != step || self.rows.len() != sums.len() {
            *self = Self { step, rows: vec![0.0; sums.len()] };
        }
        let shown = sums.iter().filter(|sum| **sum > 0.0).map(|sum| f64::from(*sum));
        let (count, total) = shown.fold((0.0, 0.0), |(n, total), sum| (n + 1.0, total + sum));
        for (score, &sum) in self.rows.iter_mut().zip(sums) {
            let relative = (f64::from(sum) * count / total) as f32;
            if relative > 0.0 {
                *score += relative;
            }
        }
    }
}

impl Igs {
    fn prunes_first_at(&self, step: u32) -> bool {
        step > 0 && step == self.params.first_prune_at
    }

    /// Whether opacities are reset at `step`: the first multiples of the interval.
    fn resets_at(&self, step: u32) -> bool {
        let IgsParams { reset_every: every, resets, grow_until, .. } = self.params;
        every > 0
            && (1..=resets).contains(&(step / every))
            && step.is_multiple_of(every)
            && step < grow_until
    }

    fn recovered_at(&self, step: u32) -> bool {
        self.params.recovery_share > 0.0
            && step < self.params.grow_until
            && step.checked_sub(self.recover).is_some_and(|reset| self.resets_at(reset))
    }

    /// Rows that the curve allows at `step`.
    fn allowed(&self, step: u32, budget: usize) -> usize {
        let IgsParams { grow_from, curve_until, .. } = self.params;
        let length = f64::from(curve_until.saturating_sub(grow_from).max(1));
        let passed = f64::from(step.saturating_sub(grow_from)) / length;
        (budget as f64 * passed.min(1.0).sqrt()).floor() as usize
    }

    fn prune(&self, now: &Snapshot<'_>, plan: &mut EditPlan) -> Result<(), PolicyError> {
        let opacity = now.signal(Signal::Opacity)?;
        let mut least: f64 = 0.0;
        if self.grow.is_due(now.step) {
            least = self.params.min_opacity;
        }
        if self.prunes_first_at(now.step) {
            least = least.max(self.params.first_prune_opacity);
            plan.cause("first-prune");
        }
        let mortality = Mortality { min_opacity: least as f32, max_scale: f32::INFINITY };
        let is_dead = |row: &u32| mortality.is_dead(opacity[*row as usize], 0.0);
        let (mut dead, mut living): (Vec<u32>, Vec<u32>) =
            (0..now.rows() as u32).partition(is_dead);
        if self.recovered_at(now.step) {
            plan.cause("recovery-prune");
            let share = (self.params.recovery_share * now.rows() as f64).floor() as usize;
            let more = share.saturating_sub(dead.len());
            living = smallest(living, opacity, more);
            dead.append(&mut living);
            dead.sort_unstable();
        }
        spare_one(&mut dead, opacity);
        for row in dead {
            // Never refused: each row once, and it exists.
            let _ = plan.prune(row);
        }
        Ok(())
    }

    /// Splits eligible rows, drawn by their scores, as far as the curve allows.
    fn split(
        &self,
        now: &Snapshot<'_>,
        score: &EdgeScore,
        rng: &PolicyRng,
        plan: &mut EditPlan,
    ) -> Result<(), PolicyError> {
        let views = now.signal(Signal::VisibleCount)?;
        let gradient = mean_over_views(now.signal(Signal::ScreenGradientAbs)?, views);
        let by_gradient = now.step >= self.params.final_from;
        let divisor = if by_gradient { self.params.final_divisor } else { 1.0 };
        let tau = (self.params.tau / divisor) as f32;
        let weight = |row: usize| {
            let is_eligible = gradient[row] >= tau && plan.is_free(row as u32);
            let score = if by_gradient { Some(&gradient[row]) } else { score.rows.get(row) };
            if is_eligible { score.copied().unwrap_or(0.0) } else { 0.0 }
        };
        let weights: Vec<f32> = (0..now.rows()).map(weight).collect();
        let rows = plan.rows() - plan.pruned();
        let births = self.allowed(now.step, plan.budget()).saturating_sub(rows);
        let split =
            split_long_axis(self.params.split_share as f32, self.params.child_opacity as f32);
        for row in weighted(&weights, births, rng) {
            // A refusal is counted by the plan.
            let _ = plan.grow(row, split);
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests;
