//! # vanilla — the original adaptive density control
//!
//! Clones or splits Gaussians with large screen gradients, prunes transparent and oversized ones, and
//! resets opacities at intervals.
//!
//! Source: Kerbl, Kopanas, Leimkühler, Drettakis, *3D Gaussian Splatting for Real-Time Radiance Field
//! Rendering*, SIGGRAPH 2023, section 5.2, with the constants and the order of its public code.
//!
//! ## Method
//!
//! Every `grow_every` steps between `grow_from` and `grow_until`:
//!
//! 1. Gaussians whose screen gradient g is at least `tau` are densified. g is the norm of the loss
//!    gradient with respect to the projected mean (NDC), averaged over the views that saw the Gaussian.
//!    Small Gaussians (largest standard deviation at most `small` · scene extent) are cloned: an exact
//!    copy at the same place. Larger ones are split into two samples, with scales divided by
//!    `split_factor`.
//! 2. Gaussians less opaque than `min_opacity` are pruned; after step `max_scale_from` also those larger
//!    than `max_scale` · scene extent. (Pruning by size on screen is dead code in the original.) At
//!    least one Gaussian is always kept.
//! 3. The gradient statistics are reset.
//!
//! Every `reset_every` steps until `grow_until`, and on a white background once at `white_reset_at`,
//! opacities are limited to `reset_opacity`, and their optimiser moments are set to zero.
//!
//! ## Under a budget
//!
//! By default growth stops hard at the budget. As in the original, growth comes before pruning; the
//! Gaussians with the largest g grow first while there is room, and at the budget nothing grows until
//! pruning has made room. Refused growth is counted as denied. A hard stop spends the budget on whatever
//! grows first, which some consider an unfair baseline.
//!
//! With `governor`, `tau` is not used. Each event grows the Gaussians with the largest g until the model
//! reaches a curve that rises from the S initial Gaussians to the budget B:
//! N(x) = S + (B − S)(2x/M − (x/M)²) after x of M intervals (*Taming 3DGS*, Mallick et al. 2024, equation 2).
//!
//! ## Parameters
//!
//! | name | default | range | unit | meaning |
//! |---|---|---|---|---|
//! | grow_from | 500 | >= 0 | step | start of growth and pruning (exclusive) |
//! | grow_until | 15000 | >= 0 | step | end of growth, pruning and opacity resets (exclusive) |
//! | grow_every | 100 | >= 0 | steps | interval of growth and pruning; 0: never |
//! | tau | 0.0002 | >= 0 | 1 / NDC | screen gradient from which a Gaussian is densified |
//! | small | 0.01 | >= 0 | scene extent | Gaussians up to this size are cloned, larger ones split |
//! | split_factor | 1.6 | 1 to 100 | | a split divides the scales by this |
//! | min_opacity | 0.005 | 0 to 1 | | Gaussians below this opacity are pruned |
//! | max_scale | 0.1 | > 0 | scene extent | Gaussians above this size are pruned |
//! | max_scale_from | 3000 | >= 0 | step | start of pruning by size (exclusive) |
//! | reset_every | 3000 | >= 0 | steps | interval of opacity resets; 0: never |
//! | reset_opacity | 0.01 | 0 to 1, both excluded | | largest opacity after a reset |
//! | white_reset_at | 500 | >= 0 | step | one more reset, on a white background only; 0: never |
//! | governor | false | | | follow a growth curve instead of `tau` |
//!
//! Defaults in steps are for a run of 30,000 iterations and scale with its length; intervals
//! (`…_every`) do not shrink below 100 steps.

use std::ops::Bound::{Excluded, Unbounded};

use serde::{Deserialize, Serialize};

use crate::adc::{
    GROWTH_SIGNALS, OpacityResets, PruneLimits, Window, clone_at, concave_curve, mean_over_views,
    spare_one, split_by,
};
use crate::parameters::StepParameter::{self, Interval, Step};
use crate::parameters::in_range;
use crate::plan::{EditPlan, Reset};
use crate::policy::{DensityPolicy, Needs, PolicyResult, SceneInfo, Signal, Snapshot};
use crate::registry::ConfiguredPolicy;
use crate::rng::PolicyRng;
use crate::sample::largest;

crate::register_policy!(
    "vanilla",
    Vanilla,
    summary: "the original adaptive density control; hard stop or governed growth under a budget",
    source: "Kerbl et al. 2023, arXiv 2308.04079",
    doc: include_str!("mod.rs"),
);

/// Parameters of [`Vanilla`], explained in its manual page.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
#[expect(missing_docs, reason = "the manual page documents every parameter, and a test checks it")]
pub struct VanillaParams {
    pub grow_from: u32,
    pub grow_until: u32,
    pub grow_every: u32,
    pub tau: f64,
    pub small: f64,
    pub split_factor: f64,
    pub min_opacity: f64,
    pub max_scale: f64,
    pub max_scale_from: u32,
    pub reset_every: u32,
    pub reset_opacity: f64,
    pub white_reset_at: u32,
    pub governor: bool,
}

impl Default for VanillaParams {
    fn default() -> Self {
        Self {
            grow_from: 500,
            grow_until: 15_000,
            grow_every: 100,
            tau: 2e-4,
            small: 0.01,
            split_factor: 1.6,
            min_opacity: 0.005,
            max_scale: 0.1,
            max_scale_from: 3000,
            reset_every: 3000,
            reset_opacity: 0.01,
            white_reset_at: 500,
            governor: false,
        }
    }
}

/// The original adaptive density control.
#[derive(Debug)]
pub struct Vanilla {
    params: VanillaParams,
    pub(crate) grow: Window,
    pub(crate) resets: OpacityResets,
}

impl ConfiguredPolicy for Vanilla {
    type Params = VanillaParams;

    const STEP_PARAMETERS: &'static [StepParameter] = &[
        Step("grow_from"),
        Step("grow_until"),
        Interval("grow_every"),
        Step("max_scale_from"),
        Interval("reset_every"),
        Step("white_reset_at"),
    ];

    fn new(params: VanillaParams, scene: &SceneInfo) -> PolicyResult<Self> {
        in_range("tau", params.tau, 0.0..)?;
        in_range("small", params.small, 0.0..)?;
        in_range("split_factor", params.split_factor, 1.0..=100.0)?;
        in_range("min_opacity", params.min_opacity, 0.0..=1.0)?;
        in_range("max_scale", params.max_scale, (Excluded(0.0), Unbounded))?;
        let VanillaParams { grow_from: from, grow_until: until, grow_every: every, .. } = params;
        let VanillaParams { reset_every, white_reset_at, reset_opacity, .. } = params;
        let resets = OpacityResets::new(reset_every, until, white_reset_at, reset_opacity, scene)?;
        Ok(Self { grow: Window { from, until, every }, resets, params })
    }
}

impl DensityPolicy for Vanilla {
    fn needs(&self, _scene: &SceneInfo) -> Needs {
        Needs { signals: GROWTH_SIGNALS.into(), ..Needs::default() }
    }

    fn is_due(&self, step: u32) -> bool {
        self.grow.is_due(step) || self.resets.is_due(step)
    }

    fn plan(&mut self, now: &Snapshot<'_>, _rng: &PolicyRng, plan: &mut EditPlan) -> PolicyResult {
        if self.grow.is_due(now.step) {
            plan.cause("densify");
            self.densify(now, plan)?;
            // Resets only the signals of growth, as a policy that reuses this growth may reset others at its own
            // intervals.
            plan.reset(Reset::Only([Signal::VisibleCount, Signal::ScreenGradient].into()));
        }
        self.resets.plan(now.step, plan);
        Ok(())
    }
}

impl Vanilla {
    /// Grows, then prunes. As in the original, pruning applies to the state after growth: a huge row that is
    /// split is judged by the size of its children.
    fn densify(&self, now: &Snapshot<'_>, plan: &mut EditPlan) -> PolicyResult {
        let opacity = now.signal(Signal::Opacity)?;
        let scale = now.signal(Signal::ScaleMax)?;
        let screen_gradient = now.signal(Signal::ScreenGradient)?;
        let gradient = mean_over_views(screen_gradient, now.signal(Signal::VisibleCount)?);
        let VanillaParams { min_opacity, max_scale, max_scale_from, .. } = self.params;
        let limits = PruneLimits::at(now, min_opacity, max_scale, max_scale_from);
        let small = (self.params.small * f64::from(now.scene.extent)) as f32;
        let factor = self.params.split_factor as f32;

        let is_small = |row: usize| scale[row] <= small;
        let would_die = |row: usize| {
            let grown_scale = if is_small(row) { scale[row] } else { scale[row] / factor };
            limits.exceeded(opacity[row], grown_scale)
        };
        let governor = self.params.governor;
        let is_candidate = |row: usize| {
            if governor { gradient[row] > 0.0 } else { gradient[row] >= self.params.tau as f32 }
        };
        let parents = (0..now.rows()).filter(|&row| is_candidate(row) && !would_die(row));
        let parents: Vec<u32> = parents.map(|row| row as u32).collect();
        let count = if governor {
            let SceneInfo { initial_rows, budget, .. } = *now.scene;
            let allowed = concave_curve(self.grow, now.step, initial_rows, budget);
            allowed.saturating_sub(now.rows())
        } else {
            parents.len()
        };
        for row in largest(parents, &gradient, count) {
            let offspring =
                if is_small(row as usize) { clone_at([0.0; 3]) } else { split_by(factor) };
            // A refusal is counted by the plan.
            let _ = plan.grow(row, offspring);
        }

        let mut dead = limits.dead_rows(now)?;
        dead.retain(|&row| plan.is_free(row));
        spare_one(&mut dead, opacity);
        plan.prune_all(dead);
        Ok(())
    }
}

#[cfg(test)]
mod tests;
