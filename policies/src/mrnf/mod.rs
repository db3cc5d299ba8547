//! # mrnf — growth by error, decay of what is seen, replacement of what has faded
//!
//! Splits Gaussians with large errors until the budget is filled, lets the opacities and scales of all visible
//! Gaussians decay, so that those which are not needed fade, and replaces the faded ones by children of opaque ones.
//!
//! Source: MRNF, the default strategy of LichtFeld Studio, from its public descriptions (pull requests 1685 and
//! 1839, issues 1767 and 2036, and published defaults, as of October 2026). There is no paper.
//!
//! ## Method
//!
//! Every `grow_every` steps until `replace_until`:
//!
//! 1. Gaussians less opaque than `min_opacity` are pruned. Each is **replaced** by a child of a Gaussian that was seen
//!    since the last event, drawn without replacement in proportion to opacity.
//! 2. Until `grow_until` the model **grows**. Candidates are Gaussians with a score above `tau`. The share `growth` of
//!    them is drawn without replacement in proportion to their scores, but at most the free budget divided by the number
//!    of events that are left until `grow_until`.
//! 3. Parents, also those of replacements, are split along their longest axis: with d = `split_share`, two halves are
//!    placed at ±3d standard deviations, their longest axis 1 − d times the parent's, the others √(1 − d²) times, their
//!    opacity `child_opacity` times the parent's.
//! 4. The opacities of all Gaussians seen since the last event **decay** by `opacity_decay` · (1 − t), and their standard
//!    deviations by the share `scale_decay` · (1 − t). t is the fraction of the run that has passed.
//!
//! **The score** is the mean over views of Σ w·M / (Σ w)^`footprint`, both sums over the pixels that the Gaussian is
//! blended into with the weight w, and M = (1 − SSIM) · (1 + `edge` · g/ḡ), where g is the Laplacian of the photograph's
//! luma and ḡ its mean over the view.
//!
//! **At every step** two terms are added to the loss: `opacity_term` · mean opacity, and `scale_term` ·
//! (p + 1)·(1 − t)^p · mean standard deviation, with p = `scale_term_power`. After the optimiser step every mean moves by
//! Σ·ξ · σ(−`noise_sharpness` · o) · `noise` · λ, with Σ the covariance of the Gaussian, ξ ~ N(0, I), o its opacity and λ
//! the learning rate of the means.
//!
//! **Learning rates** are the published ones; those of colour, opacity and SH bands fall to `fade` times their values
//! between `grow_until` and the end, so that the model does not memorise single photographs. (`--lr` overrides each.)
//! Opacities are never reset.
//!
//! **Growth is bounded** by the budget, as in the published method: replacements need no room, and births use only what
//! is free.
//!
//! ## Differences from the published method
//!
//! - Errors of several views are averaged; the published code takes the largest. Its error is that of contrast and
//!   structure, without luminance, divided by its mean over the view; ours is 1 − SSIM. `tau` has the published value,
//!   but the score has another scale: nearly every Gaussian that is seen is a candidate. In the published run of bonsai
//!   most are candidates, too: it grows from 206,613 to 1,830,000 Gaussians in 7,000 steps, and these rules would give
//!   2,080,000 if all were.
//! - Here each pixel's error is weighted by its edge strength; the published code has a separate score of edges per
//!   Gaussian, which also weights the draw of replacements, and a second factor for ridges.
//! - The share of the screen that a Gaussian covers is not limited. The published code shrinks those that cover more
//!   than 0.587 and splits them first.
//! - No share of the growth is reserved for far Gaussians and far points.
//! - The published noise is (1 − o)¹⁵⁰ · 50 · λ · ξ for Gaussians in view; here it has the shape of the covariance and
//!   applies to all. Both agree for Gaussians of a hundredth of the camera radius.
//! - The published learning rate of the means, 2.18e-5 falling to 2e-7, is in units of the median extent of the points.
//!   Policies only know the scene extent, which is half of it in bonsai; hence the factor of two.
//! - Rules of the published trainer that are no density control are not part of this policy: an edge loss, 0.22
//!   instead of 0.2 as the weight of SSIM, terms for flat Gaussians and for colours, a model of exposures.
//! - The published code has 175 events 163 steps apart. In a short run an event stands for m of them: its growth is
//!   (1 + `growth`)ᵐ − 1, at most all candidates, and its decay is that of m events, but per
//!   optimiser step at most five times the published one.
//!
//! ## Parameters
//!
//! | name | default | range | unit | meaning |
//! |---|---|---|---|---|
//! | grow_until | 15000 | >= 0 | step | end of growth (exclusive) |
//! | replace_until | 28500 | >= 0 | step | end of replacement and decay (exclusive) |
//! | grow_every | 163 | >= 0 | steps | interval of events; 0: never |
//! | growth | 0.07 | 0 to 1 | candidates | share that is split per published event |
//! | tau | 0.0031 | >= 0 | | score above which a Gaussian is a candidate |
//! | edge | 0.25 | >= 0 | | weight of edges in the score |
//! | footprint | 0.75 | 0 to 1 | | exponent of the sum of weights; 1: mean error, 0: sum of errors |
//! | min_opacity | 0.00392 | 0 to 1 | | Gaussians below this opacity are replaced |
//! | split_share | 0.45 | 0 to 1, both excluded | | d of the split |
//! | child_opacity | 0.6 | 0 to 1, 0 excluded | | factor on the opacity in a split |
//! | opacity_decay | 0.004 | 0 to 1 | | decay of opacities per published event, at the start |
//! | scale_decay | 0.002 | 0 to 1, 1 excluded | | decay of standard deviations per published event, at the start |
//! | opacity_term | 0.003 | >= 0 | loss | coefficient of the mean opacity |
//! | scale_term | 0.01 | >= 0 | loss / camera radius | mean coefficient of the mean standard deviation |
//! | scale_term_power | 0.4 | 0 to 100 | | p, the power with which that coefficient falls |
//! | noise | 500000.0 | >= 0 | 1 / camera radius² | strength of the noise; 0: none |
//! | noise_sharpness | 150.0 | >= 0 | | how steeply the noise falls with opacity |
//! | mean_start | 0.000044 | > 0 | extent / step | learning rate of the means at the start |
//! | mean_end | 0.0000004 | > 0 | extent / step | learning rate of the means at the end |
//! | log_scale_start | 0.0083 | > 0 | | learning rate of the log-scales at the start |
//! | log_scale_end | 0.005 | > 0 | | learning rate of the log-scales at the end |
//! | opacity_rate | 0.012 | > 0 | | learning rate of the opacity logits |
//! | quat | 0.0015 | > 0 | | learning rate of the quaternions |
//! | fade | 0.3 | 0 to 1, 0 excluded | | factor on the learning rates of colour and opacity at the end; 1: none |
//!
//! Defaults in steps are for a run of 30,000 iterations and scale with its length; intervals
//! (`…_every`) do not shrink below 100 steps.

use crate::adc::{Window, mean_over_views, spare_one, split_long_axis};
use crate::parameters::StepParameter::{self, Interval, Step};
use crate::plan::{Decay, EditPlan, Reset};
use crate::policy::{
    DensityPolicy, ErrorMap, ErrorScore, Fade, LossTerms, Needs, NoiseTerm, PolicyResult, Rate,
    RateOverrides, SceneInfo, Signal, Snapshot,
};
use crate::registry::ConfiguredPolicy;
use crate::rng::PolicyRng;
use crate::sample::weighted;
use schedule::Schedule;

mod parameters;
mod schedule;

pub use parameters::MrnfParams;

crate::register_policy!(
    "mrnf",
    Mrnf,
    summary: "growth by error, decay of visible Gaussians, replacement of faded ones",
    source: "MRNF of LichtFeld Studio, pull request 1839",
    doc: include_str!("mod.rs"),
);

/// Scene extent / camera radius.
const EXTENT_MARGIN: f64 = 1.1;

/// Growth by error, decay and replacement.
#[derive(Debug)]
pub struct Mrnf {
    params: MrnfParams,
    schedule: Schedule,
}

impl ConfiguredPolicy for Mrnf {
    type Params = MrnfParams;

    const STEP_PARAMETERS: &'static [StepParameter] =
        &[Step("grow_until"), Step("replace_until"), Interval("grow_every")];

    fn new(params: MrnfParams, scene: &SceneInfo) -> PolicyResult<Self> {
        params.check()?;
        let MrnfParams { grow_until, replace_until, grow_every: every, .. } = params;
        let window = |until| Window { from: 0, until, every };
        let schedule = Schedule {
            grow: window(grow_until.min(replace_until)),
            events: window(replace_until),
            iterations: scene.iterations,
        };
        Ok(Self { params, schedule })
    }
}

impl DensityPolicy for Mrnf {
    fn needs(&self, scene: &SceneInfo) -> Needs {
        let params = &self.params;
        let radius = f64::from(scene.extent) / EXTENT_MARGIN;
        let noise = NoiseTerm {
            strength: (params.noise / (radius * radius)) as f32,
            sharpness: params.noise_sharpness as f32,
            opacity: 0.0,
        };
        let fade_from = f64::from(params.grow_until) / f64::from(scene.iterations.max(1));
        Needs {
            signals: [Signal::VisibleCount, Signal::ErrorScore, Signal::Opacity].into(),
            error_score: ErrorScore {
                map: ErrorMap::Dssim,
                edge: params.edge as f32,
                footprint: params.footprint as f32,
                ..ErrorScore::default()
            },
            loss_terms: LossTerms {
                opacity: params.opacity_term as f32,
                scale: (params.scale_term / radius) as f32,
            },
            noise: (params.noise > 0.0).then_some(noise),
            rates: RateOverrides {
                mean: Some(Rate { start: params.mean_start, end: params.mean_end }),
                log_scale: Some(Rate { start: params.log_scale_start, end: params.log_scale_end }),
                quat: Some(Rate::constant(params.quat)),
                opacity: Some(Rate::constant(params.opacity_rate)),
                fade: (fade_from < 1.0).then_some(Fade { from: fade_from, to: params.fade }),
                ..RateOverrides::default()
            },
            ..Needs::default()
        }
    }

    fn is_due(&self, step: u32) -> bool {
        self.schedule.events.is_due(step)
    }

    fn loss_terms(&self, step: u32, declared: LossTerms) -> LossTerms {
        let p = self.params.scale_term_power;
        let factor = (p + 1.0) * self.schedule.left(step).powf(p);
        LossTerms { scale: (f64::from(declared.scale) * factor) as f32, ..declared }
    }

    fn plan(&mut self, now: &Snapshot<'_>, rng: &PolicyRng, plan: &mut EditPlan) -> PolicyResult {
        let opacity = now.signal(Signal::Opacity)?;
        let min_opacity = self.params.min_opacity as f32;
        let is_alive = |row: usize| opacity[row].is_finite() && opacity[row] >= min_opacity;
        let mut dead: Vec<u32> =
            (0..now.rows()).filter(|&row| !is_alive(row)).map(|row| row as u32).collect();
        spare_one(&mut dead, opacity);
        let replaced = dead.len();
        plan.prune_all(dead);

        let views = now.signal(Signal::VisibleCount)?;
        let chance = |row: usize| {
            if views[row] > 0.0 && plan.is_free(row as u32) { opacity[row] } else { 0.0 }
        };
        let chances: Vec<f32> = (0..now.rows()).map(chance).collect();
        let room = plan.room();
        let mut parents = weighted(&chances, replaced.min(room), rng);
        plan.cause("replace");
        if self.schedule.grow.is_due(now.step) {
            plan.cause("grow");
            let free = room - parents.len();
            parents.extend(self.births(now, &parents, free, plan, rng)?);
        }
        let MrnfParams { split_share, child_opacity, .. } = self.params;
        let split = split_long_axis(split_share as f32, child_opacity as f32);
        for row in parents {
            // A refusal is counted by the plan.
            let _ = plan.grow(row, split);
        }
        self.decay(now.step, plan);
        plan.reset(Reset::Signals);
        Ok(())
    }
}

impl Mrnf {
    /// The rows that are split for their errors. `parents` already have a child; `free` rows may be added.
    fn births(
        &self,
        now: &Snapshot<'_>,
        parents: &[u32],
        free: usize,
        plan: &EditPlan,
        rng: &PolicyRng,
    ) -> PolicyResult<Vec<u32>> {
        let tau = self.params.tau as f32;
        let views = now.signal(Signal::VisibleCount)?;
        let mut score = mean_over_views(now.signal(Signal::ErrorScore)?, views);
        for (row, score) in (0..).zip(&mut score) {
            if *score <= tau || !plan.is_free(row) {
                *score = 0.0;
            }
        }
        let candidates = score.iter().filter(|score| **score > 0.0).count();
        for &row in parents {
            score[row as usize] = 0.0;
        }
        let share = self.schedule.growth(self.params.growth);
        let wanted = (share * candidates as f64).round() as usize;
        let paced = free.div_ceil(self.schedule.growth_events_left(now.step));
        Ok(weighted(&score, wanted.min(paced), rng))
    }

    /// Adds the decay of this event to the plan.
    fn decay(&self, step: u32, plan: &mut EditPlan) {
        let factor = self.schedule.left(step) * self.schedule.decay_factor();
        let opacity = (self.params.opacity_decay * factor) as f32;
        let scale = (self.params.scale_decay * factor).min(0.5) as f32;
        if opacity > 0.0 || scale > 0.0 {
            // All values are in range, so this is never refused.
            let _ = plan.decay(Decay { opacity, scale, seen_only: true });
        }
    }
}

#[cfg(test)]
mod tests;
