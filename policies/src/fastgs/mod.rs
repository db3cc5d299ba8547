//! # fastgs — growth and pruning where several views agree on an error
//!
//! Grows like `absgs`, but only Gaussians that take part in wrong pixels of several rendered views, and prunes by
//! the same measure: few Gaussians, and a short training time.
//!
//! Source: *FastGS: Training 3D Gaussian Splatting in 100 Seconds*, Ren, Wen, Fang, Lu, 2025, arXiv 2511.04283,
//! with the constants of public descriptions of its code.
//!
//! ## Method
//!
//! **Scores.** At each event `views` random training views are rendered. A pixel is wrong if its error, the mean over
//! channels of |I − G| scaled to 0..1 by its minimum and maximum in the view, is above `wrong`. n is the number of wrong
//! pixels of a view that a Gaussian is blended into, L the loss of the view, 0.8·L1 + 0.2·(1 − SSIM).
//!
//! - The importance is the mean of n over the views, rounded down.
//! - The pruning score is Σ L·n, scaled to 0..1 by its minimum and maximum over all Gaussians.
//!
//! **Growth**, every `grow_every` steps between `grow_from` and `grow_until`: of the Gaussians with an importance above
//! `wrong_pixels`, small ones (largest standard deviation at most `small` · scene extent) with a screen gradient of at
//! least `tau` are cloned in place, and larger ones with an absolute screen gradient of at least `tau_abs` are split
//! into two samples, with scales divided by `split_factor`. (`absgs` defines both gradients.)
//!
//! **Pruning.** Gaussians less opaque than `min_opacity` are dead; with `max_scale`, after step `max_scale_from` also
//! those larger than `max_scale` · scene extent. After growth, half of them (`prune_share`) are pruned, drawn in proportion to
//! 1/(10⁻⁶ + 1 − pruning score). Then opacities are limited to `limit_opacity`.
//!
//! **Late pruning**, every `late_prune_every` steps between `grow_until` and `late_prune_until`: Gaussians less opaque
//! than `late_prune_opacity` or with a pruning score above `late_prune_score` are pruned, at most the share
//! `late_prune_share` of all.
//!
//! Opacities are reset as in `vanilla`. **The optimiser** steps at every iteration up to `sum_from` (for SH bands 1–3,
//! whose learning rate is `sh_rest`, once per `sh_every`), then once per `sum` iterations and after `sum_more_from` once
//! per `sum_more`, on the gradients summed in between.
//!
//! **Growth is bounded** by a hard stop at the budget: Gaussians whose gradient is the largest multiple of its
//! threshold grow first while there is room, and at the budget nothing grows until pruning has made room.
//!
//! ## Differences from the published method
//!
//! - The published method has no budget, and ends with as many Gaussians as the thresholds yield. Its authors choose
//!   `tau`, `tau_abs`, `small` and the learning rate of SH bands 1–3 for each scene; these are the defaults of their
//!   code.
//! - `wrong_pixels` counts pixels: on images of a few hundred pixels a Gaussian covers fewer of them than on those of a
//!   thousand and more for which 5 was chosen, and fewer Gaussians grow.
//! - The published code counts Gaussians larger than a tenth of the scene extent as dead, as `max_scale = 0.1` does. In
//!   models of a few thousand, such Gaussians are often all there is of a wall: pruning them costs 7 dB in the built-in
//!   room.
//! - The published code draws from all Gaussians, and prunes the dead ones among those drawn; here the draw is from the
//!   dead. Dead Gaussians do not grow.
//! - `sh_every`, `sum` and `sum_more` scale with the length of the run, so that a short run has about as many optimiser
//!   steps of each kind as a full one if it has enough iterations; `sums = "fixed"` prevents it.
//! - The published rasteriser leaves out more of each Gaussian's faint rim than ours (its compact box), for speed.
//! - The published late pruning has no limit, and leaves nothing where opacities have just been reset.
//! - At least one Gaussian is always kept.
//!
//! ## Parameters
//!
//! | name | default | range | unit | meaning |
//! |---|---|---|---|---|
//! | grow_from | 500 | >= 0 | step | start of growth (exclusive) |
//! | grow_until | 15000 | >= 0 | step | end of growth and opacity resets, start of late pruning (exclusive) |
//! | grow_every | 500 | >= 0 | steps | interval of growth; 0: never |
//! | tau | 0.0002 | >= 0 | 1 / NDC | screen gradient from which a small Gaussian is cloned |
//! | tau_abs | 0.0012 | >= 0 | 1 / NDC | absolute screen gradient from which a larger one is split |
//! | small | 0.001 | >= 0 | scene extent | Gaussians up to this size are cloned, larger ones split |
//! | split_factor | 1.6 | 1 to 100 | | a split divides the scales by this |
//! | views | 10 | >= 1 | views | views rendered per event; all if there are fewer |
//! | wrong | 0.1 | 0 to 1, both excluded | | scaled error above which a pixel is wrong |
//! | wrong_pixels | 5 | >= 0 | pixels | importance above which a Gaussian may grow |
//! | min_opacity | 0.005 | 0 to 1 | | Gaussians below this opacity are dead |
//! | max_scale | 0.0 | >= 0 | scene extent | Gaussians above this size are dead; 0: none |
//! | max_scale_from | 3000 | >= 0 | step | start of pruning by size (exclusive) |
//! | prune_share | 0.5 | 0 to 1 | dead Gaussians | share that is pruned |
//! | limit_opacity | 0.8 | 0 to 1, both excluded | | largest opacity after a growth step |
//! | reset_every | 3000 | >= 0 | steps | interval of opacity resets; 0: never |
//! | reset_opacity | 0.01 | 0 to 1, both excluded | | largest opacity after a reset |
//! | white_reset_at | 500 | >= 0 | step | one more reset, on a white background only; 0: never |
//! | late_prune_every | 3000 | >= 0 | steps | interval of late pruning; 0: never |
//! | late_prune_until | 30000 | >= 0 | step | end of late pruning (exclusive) |
//! | late_prune_opacity | 0.1 | 0 to 1 | | opacity below which late pruning removes a Gaussian |
//! | late_prune_score | 0.9 | 0 to 1 | | pruning score above which late pruning removes a Gaussian |
//! | late_prune_share | 0.5 | 0 to 1 | Gaussians | largest share that a late pruning removes, the faintest first |
//! | sh_every | 16 | 1 to 1000 | steps | iterations per optimiser step of SH bands 1–3 |
//! | sh_rest | 0.00025 | > 0 | | learning rate of SH bands 1–3 |
//! | sum_from | 15000 | >= 0 | step | start of summing gradients over `sum` iterations (exclusive) |
//! | sum | 32 | 1 to 1000 | steps | iterations per optimiser step after `sum_from` |
//! | sum_more_from | 20000 | >= 0 | step | start of summing gradients over `sum_more` iterations (exclusive) |
//! | sum_more | 64 | 1 to 1000 | steps | iterations per optimiser step after `sum_more_from` |
//! | sums | "scaled" | scaled, fixed | | whether `sh_every`, `sum` and `sum_more` scale with the length of the run |
//!
//! Defaults in steps are for a run of 30,000 iterations and scale with its length; intervals
//! (`…_every`) do not shrink below 100 steps. Values set by the user do not scale, except `sh_every`, `sum` and `sum_more`,
//! unless `sums` is `"fixed"`.

use crate::absgs::{ABS_GROWTH_SIGNALS, AbsGrowth};
use crate::adc::{OpacityResets, PruneLimits, Window, spare_one};
use crate::parameters::StepParameter::{self, Interval, Step};
use crate::plan::{EditPlan, Reset};
use crate::policy::{
    AuxColumn, AuxRequest, AuxView, Cadence, DensityPolicy, Needs, PixelMap, PolicyResult, Rate,
    RateOverrides, SceneInfo, Signal, Snapshot,
};
use crate::quota::share_of_budget;
use crate::registry::ConfiguredPolicy;
use crate::rng::PolicyRng;
use crate::sample::{smallest, weighted};
use score::ViewScores;

mod parameters;
mod score;

pub use parameters::FastGsParams;

crate::register_policy!(
    "fastgs",
    FastGs,
    summary: "growth and pruning where several views agree on an error",
    source: "FastGS, Ren et al. 2025, arXiv 2511.04283",
    doc: include_str!("mod.rs"),
);

/// Growth by gradients and by wrong pixels in several views.
#[derive(Debug)]
pub struct FastGs {
    params: FastGsParams,
    grow: Window,
    late_prune: Window,
    resets: OpacityResets,
    growth: AbsGrowth,
    /// Iterations per optimiser step in this run: at first of SH bands 1–3, then of all parameters after `sum_from`, and
    /// after `sum_more_from`.
    sums: [u32; 3],
    scores: ViewScores,
}

impl ConfiguredPolicy for FastGs {
    type Params = FastGsParams;

    const STEP_PARAMETERS: &'static [StepParameter] = &[
        Step("grow_from"),
        Step("grow_until"),
        Interval("grow_every"),
        Step("max_scale_from"),
        Interval("reset_every"),
        Step("white_reset_at"),
        Interval("late_prune_every"),
        Step("late_prune_until"),
        Step("sum_from"),
        Step("sum_more_from"),
    ];

    fn new(params: FastGsParams, scene: &SceneInfo) -> PolicyResult<Self> {
        params.check()?;
        let FastGsParams { grow_from: from, grow_until, grow_every: every, .. } = params;
        let FastGsParams { reset_every, white_reset_at, reset_opacity, .. } = params;
        let FastGsParams { tau, tau_abs, small, split_factor, .. } = params;
        let resets =
            OpacityResets::new(reset_every, grow_until, white_reset_at, reset_opacity, scene)?;
        Ok(Self {
            grow: Window { from, until: grow_until, every },
            late_prune: Window {
                from: grow_until,
                until: params.late_prune_until,
                every: params.late_prune_every,
            },
            resets,
            growth: AbsGrowth { tau, tau_abs, small, split_factor },
            sums: params.scaled_sums(scene.iterations),
            scores: ViewScores::default(),
            params,
        })
    }
}

impl DensityPolicy for FastGs {
    fn needs(&self, _scene: &SceneInfo) -> Needs {
        let (threshold, [sh_every, sum, sum_more]) = (self.params.wrong as f32, self.sums);
        let map = PixelMap { error: 1.0, edge: 0.0, threshold };
        let sh_rest = Some(Rate::constant(self.params.sh_rest));
        Needs {
            signals: ABS_GROWTH_SIGNALS.into(),
            aux: Some(AuxRequest {
                map,
                columns: vec![AuxColumn::MapSum],
                ..AuxRequest::default()
            }),
            cadence: Cadence { all: sum.max(sum_more), sh_rest: sh_every },
            rates: RateOverrides { sh_rest, ..RateOverrides::default() },
            ..Needs::default()
        }
    }

    fn is_due(&self, step: u32) -> bool {
        self.grow.is_due(step) || self.late_prune.is_due(step) || self.resets.is_due(step)
    }

    fn cadence(&self, step: u32) -> Cadence {
        let [sh_every, sum, sum_more] = self.sums;
        match step {
            _ if step > self.params.sum_more_from => Cadence { all: sum_more, sh_rest: 1 },
            _ if step > self.params.sum_from => Cadence { all: sum, sh_rest: 1 },
            _ => Cadence { all: 1, sh_rest: sh_every },
        }
    }

    fn aux_views(&self, step: u32, _rows: usize, _budget: usize) -> u32 {
        let is_scored = self.grow.is_due(step) || self.late_prune.is_due(step);
        if is_scored { self.params.views } else { 0 }
    }

    fn observe(&mut self, view: &AuxView<'_>) -> PolicyResult {
        self.scores.add(view)
    }

    fn plan(&mut self, now: &Snapshot<'_>, rng: &PolicyRng, plan: &mut EditPlan) -> PolicyResult {
        let scores = std::mem::take(&mut self.scores);
        if self.grow.is_due(now.step) {
            plan.cause("densify");
            self.grow(now, &scores, plan)?;
            self.prune(now, &scores.pruning(now), rng, plan)?;
            // The range was checked, so this is never refused.
            let _ = plan.clamp_opacity(self.params.limit_opacity as f32);
            plan.reset(Reset::Signals);
        }
        if self.late_prune.is_due(now.step) {
            plan.cause("late-prune");
            self.prune_late(now, &scores.pruning(now), plan)?;
        }
        self.resets.plan(now.step, plan);
        Ok(())
    }
}

impl FastGs {
    /// Limits beyond which a row is dead.
    fn limits(&self, now: &Snapshot<'_>) -> PruneLimits {
        let FastGsParams { min_opacity, max_scale, max_scale_from, .. } = self.params;
        PruneLimits::at(now, min_opacity, max_scale, max_scale_from)
    }

    fn grow(&self, now: &Snapshot<'_>, scores: &ViewScores, plan: &mut EditPlan) -> PolicyResult {
        let is_important = scores.is_important(now, self.params.wrong_pixels);
        for (row, offspring) in self.growth.parents(now, self.limits(now))? {
            if is_important[row as usize] {
                // A refusal is counted by the plan.
                let _ = plan.grow(row, offspring);
            }
        }
        Ok(())
    }

    /// Prunes some of the dead rows, drawn by their pruning scores. Shape of `score`: `[rows]`.
    fn prune(
        &self,
        now: &Snapshot<'_>,
        score: &[f32],
        rng: &PolicyRng,
        plan: &mut EditPlan,
    ) -> PolicyResult {
        let mut dead = self.limits(now).dead_rows(now)?;
        dead.retain(|&row| plan.is_free(row));
        let count = (self.params.prune_share * dead.len() as f64).floor() as usize;
        let mut chances = vec![0.0; now.rows()];
        for row in dead {
            chances[row as usize] = 1.0 / (1e-6 + (1.0 - score[row as usize]));
        }
        let mut pruned = weighted(&chances, count, rng);
        spare_one(&mut pruned, now.signal(Signal::Opacity)?);
        plan.prune_all(pruned);
        Ok(())
    }

    /// Prunes faint rows and those with a large pruning score. Shape of `score`: `[rows]`.
    fn prune_late(&self, now: &Snapshot<'_>, score: &[f32], plan: &mut EditPlan) -> PolicyResult {
        let opacity = now.signal(Signal::Opacity)?;
        let FastGsParams { late_prune_opacity, late_prune_score, .. } = self.params;
        let limits =
            PruneLimits { min_opacity: late_prune_opacity as f32, max_scale: f32::INFINITY };
        let is_pruned = |row: &u32| {
            let row = *row as usize;
            limits.exceeded(opacity[row], 0.0) || score[row] > late_prune_score as f32
        };
        let mut pruned: Vec<u32> = (0..now.rows() as u32).filter(is_pruned).collect();
        let most = share_of_budget(self.params.late_prune_share, now.rows());
        if pruned.len() > most {
            pruned = smallest(pruned, opacity, most);
        }
        spare_one(&mut pruned, opacity);
        plan.prune_all(pruned);
        Ok(())
    }
}

#[cfg(test)]
mod tests;
