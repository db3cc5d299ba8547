//! # merit — replaces all hardly visible Gaussians
//!
//! Fills the budget slowly and keeps replacing Gaussians: those that are hardly visible in any view make room for
//! children of those with large gradients in several views. The number of replacements adapts to
//! the scene: the more Gaussians are badly placed, the more are replaced.
//!
//! Source: our own; docs/comparison.md has the figures. The turnover, the gradient with its colour term and the
//! weighting of near views are from *Gaussians on a Diet* (arXiv 2604.20046, our `diet`); the absolute
//! gradient, splits along the longest axis and the square-root curve are from *Improving Densification in
//! 3D Gaussian Splatting* (Deng et al. 2025, our `igs`).
//!
//! ## Method
//!
//! **Events** take place every `grow_every` steps between `grow_from` and `grow_until`.
//!
//! **Growth.** The model may have S + (F − S) · √x Gaussians, with S the initial number, F the budget and x
//! the fraction of the way from `grow_from` to `curve_until`, at most 1. Each event adds Gaussians up to this
//! number, without a gradient threshold. By default the curve extends beyond the last event.
//!
//! **Turnover.** Each event also replaces the Gaussians whose importance is below `replaceable` times the
//! median, except newborns (younger than an epoch, at most `protect` steps). Over the whole run it replaces at
//! least `rho` · F Gaussians, even if fewer are below this limit, and at most `most_rho` · F, an equal number
//! at each event. While the model is below the budget, the new Gaussians use the free room and nothing is
//! pruned for them, so the budget fills faster. Importance is the largest blend weight α·T over all pixels of
//! the training views of the previous and the current epoch.
//!
//! **Parents** are the Gaussians with the largest g = g_p + `colour_weight` · g_c. g_c is the norm of the loss
//! gradient with respect to the colour, g_p that with respect to the projected mean (NDC), with absolute
//! values summed over pixels if `gradient` is `abs`. Both are averaged over the views since the last event;
//! a view in which the depth of the Gaussian is below `full_depth` is weighted by (depth / `full_depth`)².
//! Gaussians seen in fewer than `least_views` of these views get no children.
//!
//! **Pruning.** Gaussians below `min_opacity` are pruned. If there is no room for new Gaussians, the least
//! important ones that are not parents are pruned; newborns only if there are too few others, the oldest first.
//!
//! **Children.** A Gaussian larger than `small` is split along its longest axis: with d = `split_share`, two
//! halves at ±3d standard deviations, their longest axis 1 − d times the parent's, the others √(1 − d²) times,
//! their opacity `child_opacity` times the parent's. A smaller one is cloned in place.
//!
//! Each event is one plan that prunes before it grows, so the budget holds at all times. Opacities are
//! never reset, the pixel term of the loss is Huber's function (L1 below 40 training views), the loss has no
//! additional terms, and learning rates are the trainer's. With Huber's function, these are larger in runs of fewer
//! than 30,000 iterations (docs/studies/short-runs.tsv).
//!
//! ## Parameters
//!
//! | name | default | range | unit | meaning |
//! |---|---|---|---|---|
//! | grow_from | 500 | >= 0 | step | start of events (exclusive) |
//! | grow_until | 15000 | >= 0 | step | end of events (exclusive) |
//! | grow_every | 100 | >= 0 | steps | interval of events; 0: never |
//! | curve_until | 30000 | >= 0 | step | step at which the curve reaches the budget |
//! | rho | 0.25 | >= 0 | budget | minimum number of Gaussians replaced in the whole run |
//! | replaceable | 0.15 | >= 0 | median importance | Gaussians below this importance are replaced; 0: none beyond `rho` |
//! | most_rho | 2.0 | >= 0 | budget | maximum number of Gaussians replaced in the whole run |
//! | gradient | "abs" | abs, screen | | screen gradient, with absolute values or without |
//! | colour_weight | 30.0 | >= 0 | | weight of the colour gradient; 0: none |
//! | full_depth | 0.8 | >= 0 | scene extent | depth below which a view counts less in g; 0: all count equally |
//! | least_views | 3 | >= 0 | views | minimum number of views in which a parent is seen |
//! | protect | 100 | 0 to 65535 | steps | longest protection of newborns; 0: none |
//! | small | 0.01 | >= 0 | scene extent | Gaussians up to this size are cloned, larger ones split; 0: all are split |
//! | split_share | 0.45 | 0 to 1, both excluded | | d of the split |
//! | child_opacity | 0.6 | 0 to 1, 0 excluded | | factor on the opacity in a split |
//! | min_opacity | 0.005 | 0 to 1 | | Gaussians below this opacity are pruned |
//! | pixel_loss | "auto" | auto, l1, huber | | pixel term of the loss; `auto`: `huber` from 40 training views on |
//!
//! ## Ablations
//!
//! Slow filling is switched off by `curve_until = 0`, turnover by `rho = 0` and `replaceable = 0`, its
//! adaptation to the scene by `replaceable = 0` alone, absolute gradients by `gradient = "screen"`, the colour
//! gradient by `colour_weight = 0`, the weighting of near views by `full_depth = 0`, the minimum number of
//! views by `least_views = 0`, clones by `small = 0`, protection by `protect = 0`, Huber's function and the larger steps of
//! short runs by `pixel_loss = "l1"`.
//!
//! Defaults in steps are for a run of 30,000 iterations and scale with its length; intervals
//! (`…_every`) do not shrink below 100 steps. `protect` does not scale.

use crate::adc::{
    Window, add_colour_gradient, clone_at, mean_over_views, spare_one, split_long_axis,
};
use crate::parameters::StepParameter::{self, Interval, Step};
use crate::plan::{EditPlan, Offspring, Reset};
use crate::policy::{
    DensityPolicy, Needs, PixelLossChoice, PolicyResult, SceneInfo, Signal, SignalSet, Snapshot,
};
use crate::registry::ConfiguredPolicy;
use crate::rng::PolicyRng;
use crate::sample::{largest, smallest};

mod curve;
mod parameters;

pub use parameters::{Gradient, MeritParams};

crate::register_policy!(
    "merit",
    Merit,
    summary: "replaces all hardly visible Gaussians",
    source: "our own, docs/comparison.md",
    doc: include_str!("mod.rs"),
);

/// Growth by gradient, replacing hardly visible rows.
#[derive(Debug)]
pub struct Merit {
    params: MeritParams,
    events: Window,
    /// Rows younger than this are protected `[steps]`.
    protected_age: f32,
}

impl ConfiguredPolicy for Merit {
    type Params = MeritParams;

    const STEP_PARAMETERS: &'static [StepParameter] =
        &[Step("grow_from"), Step("grow_until"), Interval("grow_every"), Step("curve_until")];

    const ADDED_PARAMETERS: &'static [(&'static str, &'static str)] = &[PixelLossChoice::BEFORE];

    fn decided(mut params: MeritParams, scene: &SceneInfo) -> MeritParams {
        params.pixel_loss = params.pixel_loss.decided(scene.train_views);
        params
    }

    fn new(params: MeritParams, scene: &SceneInfo) -> PolicyResult<Self> {
        params.check()?;
        let MeritParams { grow_from: from, grow_until: until, grow_every: every, .. } = params;
        Ok(Self {
            events: Window { from, until, every },
            protected_age: params.protect.min(scene.train_views) as f32,
            params,
        })
    }
}

impl DensityPolicy for Merit {
    fn needs(&self, scene: &SceneInfo) -> Needs {
        let gradient = self.params.gradient.signal();
        let mut signals =
            SignalSet::from([Signal::VisibleCount, Signal::Opacity, Signal::WeightMax, gradient]);
        for (is_read, signal) in [
            (self.params.colour_weight > 0.0, Signal::ColourGradient),
            (self.params.small > 0.0, Signal::ScaleMax),
            (self.protected_age > 0.0, Signal::Age),
        ] {
            if is_read {
                signals = signals.with(signal);
            }
        }
        let full_depth = (self.params.full_depth * f64::from(scene.extent)) as f32;
        Needs {
            signals,
            full_depth,
            pixel_loss: self.params.pixel_loss.term(scene.train_views),
            ..Needs::default()
        }
    }

    fn is_due(&self, step: u32) -> bool {
        self.events.is_due(step)
    }

    fn plan(&mut self, now: &Snapshot<'_>, _rng: &PolicyRng, plan: &mut EditPlan) -> PolicyResult {
        plan.cause("grow");
        let opacity = now.signal(Signal::Opacity)?;
        let min_opacity = self.params.min_opacity as f32;
        // False for NaN.
        let is_alive = |row: u32| opacity[row as usize] >= min_opacity;
        let mut dead: Vec<u32> = (0..now.rows() as u32).filter(|&row| !is_alive(row)).collect();
        spare_one(&mut dead, opacity);
        plan.prune_all(dead);

        let births =
            self.shortfall(now.step, now.scene.initial_rows, plan) + self.turnover(now, plan)?;
        let parents = self.parents(now, plan, births)?;
        let without_room = parents.len().saturating_sub(plan.room());
        self.prune_least_important(now, plan, &parents, without_room)?;
        for row in parents {
            // A refusal is counted by the plan.
            let _ = plan.grow(row, self.offspring(now, row as usize)?);
        }
        plan.reset(Reset::Signals);
        Ok(())
    }
}

impl Merit {
    /// True if a row is old enough to be replaced. `age` is empty if no rows are protected.
    fn is_old(&self, age: &[f32], row: u32) -> bool {
        age.get(row as usize).is_none_or(|age| *age >= self.protected_age)
    }

    /// Ages of all rows; empty if no rows are protected.
    fn ages<'a>(&self, now: &Snapshot<'a>) -> PolicyResult<&'a [f32]> {
        if self.protected_age > 0.0 { now.signal(Signal::Age) } else { Ok(&[]) }
    }

    /// The gradient g of every row, >= 0. Shape: `[rows]`.
    fn gradient(&self, now: &Snapshot<'_>) -> PolicyResult<Vec<f32>> {
        let views = now.signal(Signal::VisibleCount)?;
        let screen = now.signal(self.params.gradient.signal())?;
        let mut gradient = mean_over_views(screen, views);
        if self.params.colour_weight > 0.0 {
            add_colour_gradient(&mut gradient, now, self.params.colour_weight as f32)?;
        }
        Ok(gradient)
    }

    /// The rows that get children, the largest gradient first.
    fn parents(
        &self,
        now: &Snapshot<'_>,
        plan: &EditPlan,
        births: usize,
    ) -> PolicyResult<Vec<u32>> {
        let gradient = self.gradient(now)?;
        let views = now.signal(Signal::VisibleCount)?;
        let least_views = self.params.least_views as f32;
        let is_eligible = |row: &u32| {
            let index = *row as usize;
            plan.is_free(*row) && gradient[index] > 0.0 && views[index] >= least_views
        };
        let rows: Vec<u32> = (0..now.rows() as u32).filter(is_eligible).collect();
        Ok(largest(rows, &gradient, births))
    }

    /// Prunes the `count` least important rows that are not parents; newborns only if there are too few others,
    /// the oldest first.
    fn prune_least_important(
        &self,
        now: &Snapshot<'_>,
        plan: &mut EditPlan,
        parents: &[u32],
        count: usize,
    ) -> PolicyResult {
        let mut is_parent = vec![false; now.rows()];
        for &row in parents {
            is_parent[row as usize] = true;
        }
        let age = self.ages(now)?;
        let others =
            (0..now.rows() as u32).filter(|&row| plan.is_free(row) && !is_parent[row as usize]);
        let (old, new): (Vec<u32>, Vec<u32>) = others.partition(|&row| self.is_old(age, row));
        let pruned = smallest(old, now.signal(Signal::WeightMax)?, count);
        let missing = count - pruned.len();
        plan.prune_all(pruned);
        plan.prune_all(largest(new, age, missing));
        Ok(())
    }

    /// The children of a row.
    fn offspring(&self, now: &Snapshot<'_>, row: usize) -> PolicyResult<Offspring> {
        let MeritParams { small, split_share, child_opacity, .. } = self.params;
        let small = (small * f64::from(now.scene.extent)) as f32;
        if small > 0.0 && now.signal(Signal::ScaleMax)?[row] <= small {
            return Ok(clone_at([0.0; 3]));
        }
        Ok(split_long_axis(split_share as f32, child_opacity as f32))
    }
}

#[cfg(test)]
mod tests;
