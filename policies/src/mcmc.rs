//! # mcmc — relocation of the dead, noise on the faint
//!
//! *3D Gaussian Splatting as Markov Chain Monte Carlo*, Kheradmand, Rebain, Sharma, Sun, Tseng, Isack,
//! Kar, Tagliasacchi, Yi, NeurIPS 2024, arXiv 2404.09591, with the constants of its public code and of
//! gsplat's.
//!
//! ## What it does
//!
//! After every `grow_every` steps, between `grow_from` and `grow_until`:
//!
//! 1. Rows no more opaque than `min_opacity` are dead. Each gives its slot to a copy of a living row,
//!    drawn with replacement in proportion to opacity.
//! 2. As many rows as `growth` allows, up to the budget, are drawn in the same way and copied too.
//!
//! A row drawn n times becomes N = n + 1 equal rows that render like the one did: each gets the
//! opacity o′ = 1 − (1 − o)^(1/N), at least `min_opacity`, and its standard deviations multiplied by
//! o / Σₖ C(N, k)·(−1)^(k−1)·o′^k/√k, k from 1 to N (equation 9 of the paper, its double sum added up).
//! From `most_shares` on, N counts as that. Mean, rotation and colour are copied.
//!
//! **In every step** two terms are added to the loss, `opacity_term` · mean opacity and
//! `scale_term` · mean standard deviation, so that what is not needed fades and shrinks; and after
//! the optimiser's step every mean moves by Σ·ξ · σ(−`noise_sharpness`·(o − `noise_opacity`)) ·
//! `noise` · λ, with Σ the row's covariance, ξ ~ N(0, I) and λ the step size of the means: faint rows
//! explore.
//!
//! **At the start** all rows have the opacity `start_opacity`, and standard deviations multiplied by
//! `start_scale`. Opacities are never reset.
//!
//! ## Where we depart from the source
//!
//! - Relocation and growth are one transaction: both draw from the opacities before the event, and a
//!   row drawn by both shares equally among all its copies. The codes draw for growth from the
//!   opacities after relocation.
//! - All of a family start with zero moments and age 0. The codes keep stale moments in the slots of
//!   the dead.
//! - The published `noise` and `scale_term` depend on the unit of length. Ours is the radius of the
//!   cameras (scene extent / 1.1), as in gsplat's normalised scenes.
//! - Without a living row nothing is done.
//!
//! ## Parameters
//!
//! | name | default | range | unit | what |
//! |---|---|---|---|---|
//! | grow_from | 500 | >= 0 | step | start of relocation and growth (exclusive) |
//! | grow_until | 25000 | >= 0 | step | end of relocation and growth (exclusive) |
//! | grow_every | 100 | >= 0 | steps | interval of relocation and growth; 0: never |
//! | min_opacity | 0.005 | 0 to 1, both excluded | | opacity up to which a row is dead |
//! | growth | 0.05 | 0 to 1 | rows | growth per event |
//! | most_shares | 51 | 2 to 51 | rows | most rows that the formulas share a row among |
//! | opacity_term | 0.01 | >= 0 | loss | coefficient of the mean opacity |
//! | scale_term | 0.01 | >= 0 | loss / camera radius | coefficient of the mean standard deviation |
//! | noise | 500000.0 | >= 0 | 1 / camera radius² | strength of the noise; 0: none |
//! | noise_sharpness | 100.0 | >= 0 | | how steeply the noise falls with opacity |
//! | noise_opacity | 0.005 | 0 to 1 | | opacity at which half of the noise is left |
//! | start_opacity | 0.5 | 0 to 1, both excluded | | opacity of the initial rows |
//! | start_scale | 0.1 | > 0 | | factor of the initial standard deviations |
//!
//! Defaults that are steps are for a run of 30,000 and scale with its length, intervals (`…_every`)
//! down to 100 steps at most.

use std::ops::Bound::{Excluded, Unbounded};

use serde::{Deserialize, Serialize};

use crate::adc::Window;
use crate::parameters::in_range;
use crate::plan::{EditPlan, Offspring, OpacityRule, ParentFate, Placement, ScaleRule};
use crate::policy::{
    DensityPolicy, LossTerms, Needs, NoiseTerm, PolicyError, PolicyState, SceneInfo, Signal,
    SignalSet, Snapshot, StartRule, restore_nothing,
};
use crate::registry::ConfiguredPolicy;
use crate::rng::PolicyRng;
use crate::sample::with_replacement;

crate::register_policy!(
    "mcmc",
    Mcmc,
    summary: "relocation of dead rows, steady growth to the budget, noise on faint rows",
    source: "Kheradmand et al. 2024, arXiv 2404.09591",
    doc: include_str!("mcmc.rs"),
);

/// Margin of a scene's extent around its cameras.
const EXTENT_MARGIN: f64 = 1.1;

/// Parameters of [`Mcmc`]; its manual page says what they mean.
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
}

impl ConfiguredPolicy for Mcmc {
    type Params = McmcParams;

    const STEP_PARAMETERS: &'static [&'static str] = &["grow_from", "grow_until", "grow_every"];

    fn new(params: McmcParams, _scene: &SceneInfo) -> Result<Self, PolicyError> {
        // As the f32 that the plan will check.
        let unit = |value: f64| f64::from(value as f32);
        in_range("min_opacity", unit(params.min_opacity), (Excluded(0.0), Excluded(1.0)))?;
        in_range("growth", params.growth, 0.0..=1.0)?;
        in_range("most_shares", params.most_shares.into(), 2.0..=51.0)?;
        in_range("opacity_term", params.opacity_term, 0.0..)?;
        in_range("scale_term", params.scale_term, 0.0..)?;
        in_range("noise", params.noise, 0.0..)?;
        in_range("noise_sharpness", params.noise_sharpness, 0.0..)?;
        in_range("noise_opacity", params.noise_opacity, 0.0..=1.0)?;
        in_range("start_opacity", unit(params.start_opacity), (Excluded(0.0), Excluded(1.0)))?;
        in_range("start_scale", params.start_scale, (Excluded(0.0), Unbounded))?;
        let McmcParams { grow_from: from, grow_until: until, grow_every: every, .. } = params;
        Ok(Self { grow: Window { from, until, every }, params })
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
            signals: SignalSet::of(&[Signal::Opacity]),
            loss_terms: LossTerms {
                opacity: params.opacity_term as f32,
                scale: (params.scale_term / radius) as f32,
            },
            noise: (params.noise > 0.0).then_some(noise),
            start: StartRule {
                opacity: Some(params.start_opacity as f32),
                scale: params.start_scale as f32,
            },
            ..Needs::default()
        }
    }

    fn is_due(&self, step: u32) -> bool {
        self.grow.is_due(step)
    }

    fn plan(
        &mut self,
        now: &Snapshot<'_>,
        rng: &PolicyRng,
        plan: &mut EditPlan,
    ) -> Result<(), PolicyError> {
        let opacity = now.signal(Signal::Opacity)?;
        let least = self.params.min_opacity as f32;
        let lives = |opacity: f32| opacity.is_finite() && opacity > least;
        let weights: Vec<f32> = opacity.iter().map(|&o| if lives(o) { o } else { 0.0 }).collect();
        let dead: Vec<u32> = (0..).zip(opacity).filter(|(_, o)| !lives(**o)).map(|x| x.0).collect();
        if dead.len() == now.rows() {
            return Ok(());
        }
        let target = grown(now.rows(), self.params.growth).min(plan.budget());
        let births = dead.len() + target.saturating_sub(now.rows());
        if !dead.is_empty() {
            plan.cause("relocate");
        }
        if births > dead.len() {
            plan.cause("grow");
        }
        for row in dead {
            // Never refused: each row once, and it exists.
            let _ = plan.prune(row);
        }
        for (row, copies) in with_replacement(&weights, births.min(plan.room()), rng) {
            let _ = plan.grow(row, self.shared(opacity[row as usize], copies));
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

/// ⌊(1 + `growth`)·`rows`⌋.
fn grown(rows: usize, growth: f64) -> usize {
    // 1.05 · 100 is 105.00000000000001, 1.05 · 20 is 21: a product is off by at most 2⁻⁵³ of itself.
    ((1.0 + growth) * rows as f64 * (1.0 + f64::EPSILON)).floor() as usize
}

impl Mcmc {
    /// A row and its copies, which together render like the row did.
    fn shared(&self, opacity: f32, copies: u32) -> Offspring {
        let members = copies.saturating_add(1);
        let counted = members.min(self.params.most_shares);
        let least = self.params.min_opacity;
        let (share, scale) = share(f64::from(opacity), counted, least);
        let is_exact = counted == members && share > least;
        Offspring {
            children: copies,
            parent: ParentFate::BecomesChild,
            placement: Placement::Offset([0.0; 3]),
            scale: ScaleRule::Uniform(scale as f32),
            opacity: if is_exact { OpacityRule::Conserved } else { OpacityRule::Set(share as f32) },
        }
    }
}

/// The opacity of each of `members` equal rows that stand for one of opacity `opacity`, at least
/// `least`, and the factor of their standard deviations.
fn share(opacity: f64, members: u32, least: f64) -> (f64, f64) {
    // As opaque as an f32 can be.
    let most = 1.0 - f64::from(f32::EPSILON);
    let opacity = opacity.clamp(0.0, most);
    let share = (1.0 - (1.0 - opacity).powf(1.0 / f64::from(members))).clamp(least, most);
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
