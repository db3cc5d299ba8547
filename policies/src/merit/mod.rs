//! # merit — births where many views ask for them, deaths where few would notice
//!
//! Fills the budget along a curve and then keeps replacing: Gaussians that all views would miss the least
//! make room for children of those that most views complain of. All Gaussians lose a little opacity
//! at each event, so that what no view holds up fades.
//!
//! Source: our own, put together from what was measured of the other policies; docs/merit.md has the figures
//! of each part. The parts are from *Improving Densification in 3D Gaussian Splatting* (Deng et al.
//! 2025: splits along the longest axis, the curve), *Gaussians on a Diet* (arXiv 2604.20046: turnover),
//! *3D Gaussian Splatting as Markov Chain Monte Carlo* (Kheradmand et al. 2024: births by opacity) and
//! public descriptions of MRNF and Spirula (the tax, mean powers over views).
//!
//! ## Method
//!
//! **Events** come every `grow_every` steps between `grow_from` and `grow_until`.
//!
//! **How many.** The model may have N = S + (F − S) · x^`curve` Gaussians, S those at the start, F the budget
//! and x the part of the way from `grow_from` to `curve_until`, at most 1. Beyond that, `rho` · F are
//! replaced in all events together, an equal part in each. There is no threshold: births are as many
//! as there is room for.
//!
//! **Births.** The need of a Gaussian is A^(1 − b) · E^b with b = `error_share`. A is the norm of the loss
//! gradient with respect to the projected mean (`gradient`: `abs` sums absolute values over pixels, `screen`
//! does not) plus `colour_weight` times that with respect to the colour, averaged over the views since
//! the last event; views nearer than `full_depth` weigh less. E is the error where the Gaussian is seen:
//! the mean over these views of (Σ w·M / (Σ w)^`error_footprint`)^`error_view_power`, w the blend weight α·T
//! and M = e^`error_power` · (1 + `error_edge` · g/ḡ), e the loss of a pixel and g its edge. Gaussians seen
//! by fewer than `least_views` views have no need. The share `mu` of the births is drawn in
//! proportion to opacity instead, without regard to the need, as opaque is what many views agree on.
//!
//! **Deaths.** Gaussians less opaque than `min_opacity` are pruned. Where there is no room for the births, those
//! with the lowest importance go, parents excepted, and newborns (younger than an epoch, at most `protect`
//! steps) only if there are no others. Importance is what `importance` says: `max`, the largest blend weight
//! in the training views of the last two epochs, or `mean`, the squared mean over the views since the last
//! event of the root of the largest blend weight in each, which one view alone cannot hold up.
//!
//! **Children.** A Gaussian larger than `small` is split along its longest axis: with d = `split_share`, two
//! halves at ±3d standard deviations, their longest axis 1 − d times the parent's, the others √(1 − d²) times,
//! their opacity `child_opacity` times the parent's. A smaller one is cloned where it is.
//!
//! **The tax.** At each event every Gaussian that was seen since the last loses opacity: over all events `tax`,
//! falling linearly to 0, and at most 0.01 at once.
//!
//! **Terms of the loss.** `scale_term` · (1 − t)^0.4 times the mean standard deviation and `opacity_term` times
//! the mean opacity are added, t the part of the run that has passed.
//!
//! **Learning rates.** From the share `fade_from` of the run on, the rates of opacities and colours fall to
//! `fade_to` of what they are, so that single photographs are not memorised.
//!
//! ## Parameters
//!
//! | name | default | range | unit | meaning |
//! |---|---|---|---|---|
//! | grow_from | 500 | >= 0 | step | start of events (exclusive) |
//! | grow_until | 15000 | >= 0 | step | end of events (exclusive) |
//! | grow_every | 100 | >= 0 | steps | interval of events; 0: never |
//! | curve_until | 10000 | >= 0 | step | when the curve reaches the budget |
//! | curve | 0.5 | > 0 | | power of the curve |
//! | rho | 0.25 | >= 0 | budget | Gaussians that are replaced in all |
//! | mu | 0.3 | 0 to 1 | births | share drawn by opacity |
//! | gradient | "abs" | abs, screen | | which screen gradient |
//! | colour_weight | 30.0 | >= 0 | | weight of the colour gradient; 0: none |
//! | full_depth | 0.8 | >= 0 | scene extent | nearer views count less; 0: all count equally |
//! | error_share | 0.5 | 0 to 1 | | b: how much of the need is error; 0: none |
//! | error_power | 4.0 | 0 to 16, 0 excluded | | power of a pixel's error |
//! | error_edge | 0.25 | >= 0 | | weight of edges |
//! | error_footprint | 0.75 | 0 to 1 | | power of the sum of weights that divides |
//! | error_view_power | 0.4 | 0 to 1, 0 excluded | | power of a view's error |
//! | least_views | 3 | >= 0 | views | fewest views that make a need |
//! | importance | "mean" | mean, max | | what deaths go by |
//! | protect | 100 | 0 to 65535 | steps | longest protection of newborns; 0: none |
//! | small | 0.0 | >= 0 | scene extent | largest size that is cloned; 0: all are split |
//! | split_share | 0.45 | 0 to 1, both excluded | | d of the split |
//! | child_opacity | 0.6 | 0 to 1, 0 excluded | | factor on the children's opacity |
//! | min_opacity | 0.005 | 0 to 1 | | Gaussians below this opacity are pruned |
//! | tax | 0.3 | >= 0 | | opacity that all events together take; 0: none |
//! | scale_term | 0.01 | >= 0 | loss / camera radius | coefficient of the mean standard deviation at the start |
//! | opacity_term | 0.0 | >= 0 | loss | coefficient of the mean opacity |
//! | fade_from | 0.5 | 0 to 1, 1 excluded | run | start of the fade |
//! | fade_to | 0.3 | 0 to 1, 0 excluded | | factor on rates at the end; 1: none |
//!
//! Defaults in steps are for a run of 30,000 iterations and scale with its length; intervals
//! (`…_every`) do not shrink below 100 steps. `protect` does not scale.

use crate::adc::{Window, clone_at, spare_one, split_long_axis};
use crate::parameters::StepParameter::{self, Interval, Step};
use crate::plan::{Decay, EditPlan, Offspring, Reset};
use crate::policy::{
    DensityPolicy, Fade, LossTerms, Needs, PolicyResult, RateOverrides, SceneInfo, Signal,
    SignalSet, Snapshot,
};
use crate::quota::rows_of_event;
use crate::registry::ConfiguredPolicy;
use crate::rng::PolicyRng;
use crate::sample::{largest, smallest, weighted};

mod curve;
mod parameters;
mod score;

pub use parameters::{Gradient, Importance, MeritParams};

crate::register_policy!(
    "merit",
    Merit,
    summary: "births where many views ask for them, deaths where few would notice",
    source: "our own, docs/merit.md",
    doc: include_str!("mod.rs"),
);

/// Scene extent / camera radius.
const EXTENT_MARGIN: f64 = 1.1;

/// Power with which the scale term fades.
const SCALE_TERM_POWER: f64 = 0.4;

/// Births by consensus, deaths by importance, and a tax.
#[derive(Debug)]
pub struct Merit {
    params: MeritParams,
    events: Window,
    /// Rows younger than this are protected `[steps]`.
    protected_age: f32,
    iterations: u32,
}

impl ConfiguredPolicy for Merit {
    type Params = MeritParams;

    const STEP_PARAMETERS: &'static [StepParameter] =
        &[Step("grow_from"), Step("grow_until"), Interval("grow_every"), Step("curve_until")];

    fn new(params: MeritParams, scene: &SceneInfo) -> PolicyResult<Self> {
        params.check()?;
        let MeritParams { grow_from: from, grow_until: until, grow_every: every, .. } = params;
        Ok(Self {
            events: Window { from, until, every },
            protected_age: params.protect.min(scene.train_views) as f32,
            iterations: scene.iterations.max(1),
            params,
        })
    }
}

impl DensityPolicy for Merit {
    fn needs(&self, scene: &SceneInfo) -> Needs {
        let params = &self.params;
        let mut signals = SignalSet::from([
            Signal::VisibleCount,
            Signal::Opacity,
            params.gradient.signal(),
            params.importance.signal(),
        ]);
        for (is_used, signal) in [
            (params.colour_weight > 0.0, Signal::ColourGradient),
            (params.error_share > 0.0, Signal::ErrorScore),
            (params.small > 0.0, Signal::ScaleMax),
            (self.protected_age > 0.0, Signal::Age),
        ] {
            if is_used {
                signals = signals.with(signal);
            }
        }
        let fades = params.fade_to < 1.0;
        Needs {
            signals,
            full_depth: (params.full_depth * f64::from(scene.extent)) as f32,
            error_score: params.error_score(),
            loss_terms: LossTerms {
                opacity: params.opacity_term as f32,
                scale: (params.scale_term * EXTENT_MARGIN / f64::from(scene.extent)) as f32,
            },
            rates: RateOverrides {
                fade: fades.then_some(Fade { from: params.fade_from, to: params.fade_to }),
                ..RateOverrides::default()
            },
            ..Needs::default()
        }
    }

    fn is_due(&self, step: u32) -> bool {
        self.events.is_due(step)
    }

    fn loss_terms(&self, step: u32, declared: LossTerms) -> LossTerms {
        let left = 1.0 - f64::from(step.min(self.iterations)) / f64::from(self.iterations);
        LossTerms { scale: declared.scale * left.powf(SCALE_TERM_POWER) as f32, ..declared }
    }

    fn plan(&mut self, now: &Snapshot<'_>, rng: &PolicyRng, plan: &mut EditPlan) -> PolicyResult {
        plan.cause("grow");
        let opacity = now.signal(Signal::Opacity)?;
        let least = self.params.min_opacity as f32;
        let is_alive = |row: &u32| opacity[*row as usize] >= least;
        let mut dead: Vec<u32> = (0..now.rows() as u32).filter(|row| !is_alive(row)).collect();
        spare_one(&mut dead, opacity);
        plan.prune_all(dead);

        let parents = self.parents(now, rng, plan)?;
        let missing = parents.len().saturating_sub(plan.room());
        self.prune_least(now, plan, &parents, missing)?;
        for row in parents {
            // Where there is still no room, the plan counts it as denied.
            let _ = plan.grow(row, self.offspring(now, row as usize)?);
        }
        let tax = self.tax(now.step);
        if tax > 0.0 {
            let _ = plan.decay(Decay { opacity: tax, scale: 0.0, seen_only: true });
        }
        plan.reset(Reset::Signals);
        Ok(())
    }
}

impl Merit {
    /// The rows that get children, drawn by opacity first, then by need, the largest first.
    fn parents(
        &self,
        now: &Snapshot<'_>,
        rng: &PolicyRng,
        plan: &EditPlan,
    ) -> PolicyResult<Vec<u32>> {
        let (budget, rows) = (plan.budget(), plan.rows() - plan.pruned());
        let target = self.target(now.step, now.scene.initial_rows, budget);
        let turnover = rows_of_event(self.params.rho, self.events, now.step, budget);
        let births = target.saturating_sub(rows) + turnover;
        let by_opacity = (births as f64 * self.params.mu).round() as usize;
        let views = now.signal(Signal::VisibleCount)?;
        let is_seen = |row: usize| views[row] >= self.params.least_views as f32;
        let opacity = now.signal(Signal::Opacity)?;
        let weight = |row: usize| {
            let counts = plan.is_free(row as u32) && is_seen(row);
            if counts { opacity[row] } else { 0.0 }
        };
        let weights: Vec<f32> = (0..now.rows()).map(weight).collect();
        let mut parents = weighted(&weights, by_opacity, rng);
        let mut is_drawn = vec![false; now.rows()];
        for &row in &parents {
            is_drawn[row as usize] = true;
        }
        let need = self.need(now)?;
        let wanting = |row: &u32| {
            let index = *row as usize;
            need[index] > 0.0 && is_seen(index) && !is_drawn[index] && plan.is_free(*row)
        };
        let rest: Vec<u32> = (0..now.rows() as u32).filter(wanting).collect();
        parents.extend(largest(rest, &need, births - parents.len()));
        Ok(parents)
    }

    /// Prunes the `count` least important rows that are no parents; newborns only where there are no
    /// others, the oldest first.
    fn prune_least(
        &self,
        now: &Snapshot<'_>,
        plan: &mut EditPlan,
        parents: &[u32],
        count: usize,
    ) -> PolicyResult {
        if count == 0 {
            return Ok(());
        }
        let mut is_parent = vec![false; now.rows()];
        for &row in parents {
            is_parent[row as usize] = true;
        }
        let importance = self.importance(now)?;
        let protects = self.protected_age > 0.0;
        let age = if protects { now.signal(Signal::Age)? } else { &[] };
        let others =
            (0..now.rows() as u32).filter(|&row| plan.is_free(row) && !is_parent[row as usize]);
        let (new, old): (Vec<u32>, Vec<u32>) =
            others.partition(|&row| protects && age[row as usize] < self.protected_age);
        let pruned = smallest(old, &importance, count);
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
