//! # absgs — splits by absolute screen gradients, one late prune
//!
//! Splits large Gaussians where the absolute values of their gradients over pixels are large, even if the
//! gradients themselves cancel out; otherwise the original adaptive density control. Faint Gaussians are pruned
//! once, late in the run.
//!
//! Source: *AbsGS: Recovering Fine Details for 3D Gaussian Splatting*, Ye, Li, Liu, Qiao, Dou, 2024,
//! arXiv 2404.10484, with the constants of its public description. The late prune is from the discussion of *FastGS*
//! (arXiv 2511.04283), whose quality its critics attribute to AbsGS with a prune of opacities below 0.1.
//!
//! ## Method
//!
//! Every `grow_every` steps between `grow_from` and `grow_until`:
//!
//! 1. Small Gaussians (largest standard deviation at most `small` · scene extent) whose screen gradient is at
//!    least `tau` are cloned in place. The screen gradient is the norm of the loss gradient with respect to the
//!    projected mean (NDC), averaged over the views that saw the Gaussian.
//! 2. Larger Gaussians whose absolute screen gradient is at least `tau_abs` are split into two samples, with scales
//!    divided by `split_factor`. The absolute gradient is the norm of the sums over pixels of the absolute values of
//!    both components. On a large Gaussian over detail, the gradients of its pixels point in opposite directions and
//!    cancel out; their absolute values do not.
//! 3. Gaussians less opaque than `min_opacity` are pruned; with `max_scale`, after step `max_scale_from` also those
//!    larger than `max_scale` · scene extent. At least one Gaussian is always kept.
//! 4. The gradient statistics are reset.
//!
//! Until `grow_until`, opacities are limited to `limit_opacity` every `limit_every` steps and to `reset_opacity` every
//! `reset_every` steps, on a white background also at `white_reset_at`. At step `last_prune_at`, Gaussians less opaque
//! than `last_prune_opacity` are pruned, at most the share `last_prune_share` of all, so that a prune soon after a reset
//! leaves a model; nothing takes their place.
//!
//! **Growth is bounded** by a hard stop at the budget: Gaussians whose gradient is the largest multiple of its
//! threshold grow first while there is room, and at the budget nothing grows until pruning has made room.
//!
//! ## Differences from the published method
//!
//! - The published method has no budget, and ends with as many Gaussians as the thresholds yield.
//! - The late prune is not part of it; `last_prune_at = 0` switches it off.
//! - It prunes Gaussians larger than a tenth of the scene extent, as `max_scale = 0.1` does. In models of a few thousand,
//!   such Gaussians are often all there is of a wall: pruning them costs 8 dB in the built-in room.
//! - The published description names 3,000 steps as the interval of limiting opacities, its code 500, as here.
//! - Pruning by size on screen and by largest weight, which are off or without effect there, do not exist here.
//!
//! ## Parameters
//!
//! | name | default | range | unit | meaning |
//! |---|---|---|---|---|
//! | grow_from | 500 | >= 0 | step | start of growth and pruning (exclusive) |
//! | grow_until | 15000 | >= 0 | step | end of growth, pruning and limits of opacity (exclusive) |
//! | grow_every | 100 | >= 0 | steps | interval of growth and pruning; 0: never |
//! | tau | 0.0002 | >= 0 | 1 / NDC | screen gradient from which a small Gaussian is cloned |
//! | tau_abs | 0.0004 | >= 0 | 1 / NDC | absolute screen gradient from which a larger one is split |
//! | small | 0.001 | >= 0 | scene extent | Gaussians up to this size are cloned, larger ones split |
//! | split_factor | 1.6 | 1 to 100 | | a split divides the scales by this |
//! | min_opacity | 0.005 | 0 to 1 | | Gaussians below this opacity are pruned |
//! | max_scale | 0.0 | >= 0 | scene extent | Gaussians above this size are pruned; 0: none |
//! | max_scale_from | 3000 | >= 0 | step | start of pruning by size (exclusive) |
//! | reset_every | 3000 | >= 0 | steps | interval of opacity resets; 0: never |
//! | reset_opacity | 0.01 | 0 to 1, both excluded | | largest opacity after a reset |
//! | white_reset_at | 500 | >= 0 | step | one more reset, on a white background only; 0: never |
//! | limit_every | 500 | >= 0 | steps | interval of limits of opacity; 0: never |
//! | limit_opacity | 0.8 | 0 to 1, both excluded | | largest opacity after a limit |
//! | last_prune_at | 18000 | >= 0 | step | step of the late prune; 0: none |
//! | last_prune_opacity | 0.1 | 0 to 1 | | opacity limit of the late prune |
//! | last_prune_share | 0.5 | 0 to 1 | Gaussians | largest share that the late prune removes |
//!
//! Defaults in steps are for a run of 30,000 iterations and scale with its length; intervals
//! (`…_every`) do not shrink below 100 steps.

use crate::adc::{OpacityResets, PruneLimits, Window};
use crate::parameters::StepParameter::{self, Interval, Step};
use crate::plan::{EditPlan, Reset};
use crate::policy::{DensityPolicy, Needs, PolicyResult, SceneInfo, Signal, Snapshot};
use crate::quota::share_of_budget;
use crate::registry::ConfiguredPolicy;
use crate::rng::PolicyRng;
use crate::sample::smallest;

mod growth;
mod parameters;

pub(crate) use growth::{ABS_GROWTH_SIGNALS, AbsGrowth};
pub use parameters::AbsGsParams;

crate::register_policy!(
    "absgs",
    AbsGs,
    summary: "splits by absolute screen gradients, one late prune by opacity",
    source: "AbsGS, Ye et al. 2024, arXiv 2404.10484",
    doc: include_str!("mod.rs"),
);

/// Adaptive density control by screen gradients and absolute ones.
#[derive(Debug)]
pub struct AbsGs {
    params: AbsGsParams,
    grow: Window,
    resets: OpacityResets,
    limits: OpacityResets,
    growth: AbsGrowth,
}

impl ConfiguredPolicy for AbsGs {
    type Params = AbsGsParams;

    const STEP_PARAMETERS: &'static [StepParameter] = &[
        Step("grow_from"),
        Step("grow_until"),
        Interval("grow_every"),
        Step("max_scale_from"),
        Interval("reset_every"),
        Step("white_reset_at"),
        Interval("limit_every"),
        Step("last_prune_at"),
    ];

    fn new(params: AbsGsParams, scene: &SceneInfo) -> PolicyResult<Self> {
        params.check()?;
        let AbsGsParams { grow_from: from, grow_until: until, grow_every: every, .. } = params;
        let AbsGsParams { reset_every, white_reset_at, reset_opacity, .. } = params;
        let AbsGsParams { tau, tau_abs, small, split_factor, .. } = params;
        let limits = OpacityResets::new(params.limit_every, until, 0, params.limit_opacity, scene)?;
        Ok(Self {
            grow: Window { from, until, every },
            resets: OpacityResets::new(reset_every, until, white_reset_at, reset_opacity, scene)?,
            limits,
            growth: AbsGrowth { tau, tau_abs, small, split_factor },
            params,
        })
    }
}

impl DensityPolicy for AbsGs {
    fn needs(&self, _scene: &SceneInfo) -> Needs {
        Needs { signals: ABS_GROWTH_SIGNALS.into(), ..Needs::default() }
    }

    fn is_due(&self, step: u32) -> bool {
        self.grow.is_due(step)
            || self.resets.is_due(step)
            || self.limits.is_due(step)
            || self.is_last_prune(step)
    }

    fn plan(&mut self, now: &Snapshot<'_>, _rng: &PolicyRng, plan: &mut EditPlan) -> PolicyResult {
        if self.grow.is_due(now.step) {
            plan.cause("densify");
            let AbsGsParams { min_opacity, max_scale, max_scale_from, .. } = self.params;
            let limits = PruneLimits::at(now, min_opacity, max_scale, max_scale_from);
            for (row, offspring) in self.growth.parents(now, limits)? {
                // A refusal is counted by the plan.
                let _ = plan.grow(row, offspring);
            }
            prune(now, limits, 1.0, plan)?;
            plan.reset(Reset::Signals);
        }
        if self.is_last_prune(now.step) {
            plan.cause("last-prune");
            let min_opacity = self.params.last_prune_opacity as f32;
            let limits = PruneLimits { min_opacity, max_scale: f32::INFINITY };
            prune(now, limits, self.params.last_prune_share, plan)?;
        }
        self.limits.plan(now.step, plan);
        self.resets.plan(now.step, plan);
        Ok(())
    }
}

impl AbsGs {
    fn is_last_prune(&self, step: u32) -> bool {
        step > 0 && step == self.params.last_prune_at
    }
}

/// Prunes rows beyond `limits` that have no edit yet, the faintest first: at most this share of all rows, and never the
/// last row.
fn prune(now: &Snapshot<'_>, limits: PruneLimits, share: f64, plan: &mut EditPlan) -> PolicyResult {
    let mut dead = limits.dead_rows(now)?;
    dead.retain(|&row| plan.is_free(row));
    let left = plan.rows() - plan.pruned();
    let most = share_of_budget(share, now.rows()).min(left.saturating_sub(1));
    if dead.len() > most {
        dead = smallest(dead, now.signal(Signal::Opacity)?, most);
    }
    plan.prune_all(dead);
    Ok(())
}

#[cfg(test)]
mod tests;
