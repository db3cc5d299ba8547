//! # mcmc — relocation of dead Gaussians, noise on faint ones
//!
//! Moves dead Gaussians to the positions of living ones, grows the model by 5 % per 1/300 of the run up
//! to the budget, and lets faint Gaussians explore by adding noise to their means.
//!
//! Source: *3D Gaussian Splatting as Markov Chain Monte Carlo*, Kheradmand, Rebain, Sharma, Sun, Tseng,
//! Isack, Kar, Tagliasacchi, Yi, NeurIPS 2024, arXiv 2404.09591, with the constants of its public code
//! and of gsplat.
//!
//! ## Method
//!
//! Every `grow_every` steps between `grow_from` and `grow_until`:
//!
//! 1. Gaussians with an opacity of at most `min_opacity` are dead. Each is replaced by a copy of a
//!    living Gaussian, drawn with replacement in proportion to opacity.
//! 2. The model grows by the factor 1 + `growth`, up to the budget, by further copies drawn in the same
//!    way. An event that stands for m events of the published code, as in a short run, grows by (1 + `growth`)ᵐ;
//!    m is 1 in a run of 30,000 steps with the default `grow_every`.
//!
//! A Gaussian drawn n times becomes N = n + 1 equal ones that together render like the original. Each
//! has the opacity o′ = 1 − (1 − o)^(1/N), at least `min_opacity`, and standard deviations multiplied
//! by o / Σₖ C(N, k)·(−1)^(k−1)·o′^k/√k, k from 1 to N (equation 9 of the paper with its double sum
//! simplified). N is capped at `most_shares` in these formulas. Mean, rotation and colour are copied.
//!
//! **At every step** two terms are added to the loss, `opacity_term` · mean opacity and
//! `scale_term` · mean standard deviation, so that Gaussians which are not needed fade and shrink.
//! After the optimiser step every mean moves by Σ·ξ · σ(−`noise_sharpness`·(o − `noise_opacity`)) ·
//! `noise` · λ, with Σ the Gaussian's covariance, ξ ~ N(0, I) and λ the learning rate of the means at
//! that step. In short runs the trainer increases learning rates so that parameters follow their gradients
//! further per step. This does not apply to noise: λ is the rate before the increase.
//!
//! **Learning rates** are the published ones, independent of the trainer's: means 1.6e-4 falling to
//! 1.6e-6, log-scales 5e-3, quaternions 1e-3, opacities 0.05, SH band 0 2.5e-3, and bands 1–3 a twentieth
//! of that. The trainer increases all of them in short runs, and `--lr` overrides each.
//!
//! **At the start** all opacities are set to `start_opacity`, and standard deviations are multiplied by
//! `start_scale`. Opacities are never reset.
//!
//! ## Differences from the published code
//!
//! - Relocation and growth are one edit. Both draw by the opacities before the event, and if both draw the
//!   same Gaussian, all its copies are equal. The published code draws for growth by the opacities after
//!   relocation.
//! - All copies start with zero moments and age 0. The published code keeps stale moments in the slots
//!   of dead Gaussians.
//! - The published `noise` and `scale_term` depend on the unit of length. Here the unit is the camera
//!   radius (scene extent / 1.1), as in gsplat's normalised scenes.
//! - The published code grows by 5 % every 100 steps: 244 events multiply the model by up to 150,000. A run of
//!   2,000 steps has 16 events; at 5 % each they would only double the model, whatever the budget. `growth` is
//!   therefore per 100 steps of a run of 30,000, and each event applies it m = `grow_every` · 300 / iterations
//!   times: 15 times in a run of 2,000, so that each event doubles the model.
//! - If no Gaussian is alive, nothing happens.
//!
//! ## Parameters
//!
//! | name | default | range | unit | meaning |
//! |---|---|---|---|---|
//! | grow_from | 500 | >= 0 | step | start of relocation and growth (exclusive) |
//! | grow_until | 25000 | >= 0 | step | end of relocation and growth (exclusive) |
//! | grow_every | 100 | >= 0 | steps | interval of relocation and growth; 0: never |
//! | min_opacity | 0.005 | 0 to 1, both excluded | | Gaussians up to this opacity are dead |
//! | growth | 0.05 | 0 to 1 | Gaussians | share of Gaussians added per 1/300 of the run |
//! | most_shares | 51 | 2 to 51 | Gaussians | largest N in the formulas |
//! | opacity_term | 0.01 | >= 0 | loss | coefficient of the mean opacity |
//! | scale_term | 0.01 | >= 0 | loss / camera radius | coefficient of the mean standard deviation |
//! | noise | 500000.0 | >= 0 | 1 / camera radius² | strength of the noise; 0: none |
//! | noise_sharpness | 100.0 | >= 0 | | how steeply the noise falls with opacity |
//! | noise_opacity | 0.005 | 0 to 1 | | opacity at which the noise is halved |
//! | start_opacity | 0.5 | 0 to 1, both excluded | | initial opacity |
//! | start_scale | 0.1 | > 0 | | factor on the initial standard deviations |
//!
//! Defaults in steps are for a run of 30,000 iterations and scale with its length; intervals
//! (`…_every`) do not shrink below 100 steps.

use std::ops::Bound::{Excluded, Unbounded};

use serde::{Deserialize, Serialize};

use crate::adc::Window;
use crate::parameters::StepParameter::{self, Interval, Step};
use crate::parameters::{REFERENCE_ITERATIONS, in_range};
use crate::plan::{
    EditPlan, NO_ROTATION, Offspring, OpacityRule, ParentFate, Placement, ScaleRule,
};
use crate::policy::{
    DensityPolicy, LossTerms, Needs, NoiseTerm, PolicyResult, Rate, RateOverrides, SceneInfo,
    Signal, SignalSet, Snapshot, StartRule,
};
use crate::registry::ConfiguredPolicy;
use crate::rng::PolicyRng;
use crate::sample::with_replacement;

crate::register_policy!(
    "mcmc",
    Mcmc,
    summary: "relocation of dead Gaussians, steady growth to the budget, noise on faint ones",
    source: "Kheradmand et al. 2024, arXiv 2404.09591",
    doc: include_str!("mod.rs"),
);

/// Scene extent / camera radius.
const EXTENT_MARGIN: f64 = 1.1;

/// Steps between two events of the published code.
const PUBLISHED_INTERVAL: u32 = 100;

/// The published learning rates.
const RATES: RateOverrides = RateOverrides {
    mean: Some(Rate { start: 1.6e-4, end: 1.6e-6 }),
    log_scale: Some(Rate::constant(5e-3)),
    quat: Some(Rate::constant(1e-3)),
    opacity: Some(Rate::constant(0.05)),
    sh_dc: Some(Rate::constant(2.5e-3)),
    sh_rest: Some(Rate::constant(2.5e-3 / 20.0)),
    fade: None,
};

/// Parameters of [`Mcmc`], explained in its manual page.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
#[expect(missing_docs, reason = "the manual page documents every parameter, and a test checks it")]
pub struct McmcParams {
    pub grow_from: u32,
    pub grow_until: u32,
    pub grow_every: u32,
    pub min_opacity: f64,
    pub growth: f64,
    pub most_shares: u32,
    pub opacity_term: f64,
    pub scale_term: f64,
    pub noise: f64,
    pub noise_sharpness: f64,
    pub noise_opacity: f64,
    pub start_opacity: f64,
    pub start_scale: f64,
}

impl Default for McmcParams {
    fn default() -> Self {
        Self {
            grow_from: 500,
            grow_until: 25_000,
            grow_every: 100,
            min_opacity: 0.005,
            growth: 0.05,
            most_shares: 51,
            opacity_term: 0.01,
            scale_term: 0.01,
            noise: 5e5,
            noise_sharpness: 100.0,
            noise_opacity: 0.005,
            start_opacity: 0.5,
            start_scale: 0.1,
        }
    }
}

/// Relocation, growth and noise.
#[derive(Debug)]
pub struct Mcmc {
    params: McmcParams,
    grow: Window,
    /// Factor on the number of rows at an event.
    growth_factor: f64,
}

impl ConfiguredPolicy for Mcmc {
    type Params = McmcParams;

    const STEP_PARAMETERS: &'static [StepParameter] =
        &[Step("grow_from"), Step("grow_until"), Interval("grow_every")];

    fn new(params: McmcParams, scene: &SceneInfo) -> PolicyResult<Self> {
        in_range("min_opacity", params.min_opacity, (Excluded(0.0), Excluded(1.0)))?;
        in_range("growth", params.growth, 0.0..=1.0)?;
        in_range("most_shares", params.most_shares.into(), 2.0..=51.0)?;
        in_range("opacity_term", params.opacity_term, 0.0..)?;
        in_range("scale_term", params.scale_term, 0.0..)?;
        in_range("noise", params.noise, 0.0..)?;
        in_range("noise_sharpness", params.noise_sharpness, 0.0..)?;
        in_range("noise_opacity", params.noise_opacity, 0.0..=1.0)?;
        in_range("start_opacity", params.start_opacity, (Excluded(0.0), Excluded(1.0)))?;
        in_range("start_scale", params.start_scale, (Excluded(0.0), Unbounded))?;
        let McmcParams { grow_from: from, grow_until: until, grow_every: every, .. } = params;
        let growth_factor = growth_factor(params.growth, every, scene.iterations);
        Ok(Self { grow: Window { from, until, every }, growth_factor, params })
    }
}

impl DensityPolicy for Mcmc {
    fn needs(&self, scene: &SceneInfo) -> Needs {
        let params = &self.params;
        let radius = f64::from(scene.extent) / EXTENT_MARGIN;
        let noise = NoiseTerm {
            strength: (params.noise / (radius * radius)) as f32,
            sharpness: params.noise_sharpness as f32,
            opacity: params.noise_opacity as f32,
        };
        Needs {
            signals: SignalSet::from([Signal::Opacity]),
            loss_terms: LossTerms {
                opacity: params.opacity_term as f32,
                scale: (params.scale_term / radius) as f32,
            },
            noise: (params.noise > 0.0).then_some(noise),
            start: StartRule {
                opacity: Some(params.start_opacity as f32),
                scale: params.start_scale as f32,
            },
            rates: RATES,
            ..Needs::default()
        }
    }

    fn is_due(&self, step: u32) -> bool {
        self.grow.is_due(step)
    }

    fn plan(&mut self, now: &Snapshot<'_>, rng: &PolicyRng, plan: &mut EditPlan) -> PolicyResult {
        let opacity = now.signal(Signal::Opacity)?;
        let min_opacity = self.params.min_opacity as f32;
        let is_alive = |opacity: f32| opacity.is_finite() && opacity > min_opacity;
        let weights: Vec<f32> =
            opacity.iter().map(|&o| if is_alive(o) { o } else { 0.0 }).collect();
        let dead: Vec<u32> =
            (0..).zip(opacity).filter(|(_, o)| !is_alive(**o)).map(|x| x.0).collect();
        if dead.len() == now.rows() {
            return Ok(());
        }
        let target = grown_rows(now.rows(), self.growth_factor).min(plan.budget());
        let copies = dead.len() + target.saturating_sub(now.rows());
        if !dead.is_empty() {
            plan.cause("relocate");
        }
        if copies > dead.len() {
            plan.cause("grow");
        }
        plan.prune_all(dead);
        for (row, count) in with_replacement(&weights, copies.min(plan.room()), rng) {
            let _ = plan.grow(row, self.copies(opacity[row as usize], count));
        }
        Ok(())
    }
}

/// The factor on the number of rows at events that are `every` steps apart. `growth` is per 100 steps of a
/// run of 30,000. The factor may overflow to infinity.
fn growth_factor(growth: f64, every: u32, iterations: u32) -> f64 {
    let published = f64::from(REFERENCE_ITERATIONS / PUBLISHED_INTERVAL);
    (1.0 + growth).powf(f64::from(every) * published / f64::from(iterations.max(1)))
}

/// ⌊`factor`·`rows`⌋, at most `usize::MAX`.
fn grown_rows(rows: usize, factor: f64) -> usize {
    // A product just below an integer counts as that integer: its relative error is at most 2⁻⁵³.
    (factor * rows as f64 * (1.0 + f64::EPSILON)).floor() as usize
}

impl Mcmc {
    /// Copies of a row that, together with it, render like the original row.
    fn copies(&self, opacity: f32, copies: u32) -> Offspring {
        let members = copies.saturating_add(1);
        let counted = members.min(self.params.most_shares);
        let min_opacity = self.params.min_opacity;
        let (share, scale) = divide_opacity(f64::from(opacity), counted, min_opacity);
        let is_exact = counted == members && share > min_opacity;
        Offspring {
            children: copies,
            parent: ParentFate::BecomesChild,
            placement: Placement::Offset([0.0; 3]),
            scale: ScaleRule::Uniform(scale as f32),
            turn: NO_ROTATION,
            opacity: if is_exact { OpacityRule::Conserved } else { OpacityRule::Set(share as f32) },
        }
    }
}

/// The opacity, at least `min_opacity`, of each of `members` equal rows that replace one of opacity
/// `opacity`, and the factor on their standard deviations.
fn divide_opacity(opacity: f64, members: u32, min_opacity: f64) -> (f64, f64) {
    // Just below 1, also as an f32.
    let max = 1.0 - f64::from(f32::EPSILON);
    let opacity = opacity.clamp(0.0, max);
    let share = (1.0 - (1.0 - opacity).powf(1.0 / f64::from(members))).clamp(min_opacity, max);
    let (mut sum, mut binomial, mut power) = (0.0, 1.0, -1.0);
    for k in 1..=members {
        binomial *= f64::from(members - k + 1) / f64::from(k);
        power *= -share;
        sum += binomial * power / f64::from(k).sqrt();
    }
    (share, opacity / sum)
}

#[cfg(test)]
mod tests;
