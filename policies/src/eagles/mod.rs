//! # eagles — coarse-to-fine images, with pruning of the least influential Gaussians
//!
//! Trains on small images first and on larger ones later. The model grows as in `vanilla`, and at long
//! intervals the Gaussians that have contributed least to the images since the last prune are pruned.
//!
//! Source: *EAGLES: Efficient Accelerated 3D Gaussians with Lightweight EncodingS*, Girish, Gupta,
//! Shrivastava, ECCV 2024, arXiv 2312.04564: its coarse-to-fine training and its pruning by influence, with
//! the constants of its public code (`configs/efficient-3dgs.yaml`).
//!
//! ## Method
//!
//! **Images.** At step t both sides of the training image are multiplied by
//!
//! 1 − (1 − `first_resolution`) · (1 + cos(π · t / `whole_from`)) / 2
//!
//! so that the factor rises from `first_resolution` to 1 at step `whole_from`. Small images train faster
//! and yield fewer and smoother Gaussians.
//!
//! **Growth** is that of `vanilla`, with its parameters, but ends later and has longer intervals: clones and
//! splits by screen gradient, pruning by opacity and size, opacity resets, and a hard stop at the budget
//! (with `governor`, a growth curve).
//!
//! **Pruning.** A Gaussian's influence is the sum of its blend weights α·T over all pixels of the views
//! trained on since the last prune, or since it was created. Every `prune_every` steps before `prune_until`,
//! Gaussians whose influence is at most the `prune_share` quantile are pruned. (The quantile is interpolated
//! linearly, as in numpy and PyTorch.) Gaussians that grow in the same step are kept.
//!
//! `victims = "random"` is a control that measures the effect of the criterion: it prunes the same number
//! at random.
//!
//! ## Under a budget
//!
//! The budget bounds growth and is never exceeded. Until `grow_until`, new Gaussians take the place of pruned
//! ones. Each later prune (there are two with the defaults) keeps the share 1 − `prune_share` of the model; together
//! they keep 72 %.
//!
//! ## Differences from the published code
//!
//! - The paper also encodes colours, rotations and opacities as quantised vectors with small decoders. This
//!   reduces file size and is not part of density control, so the encoding and its learning rates are left out.
//! - Images are downscaled by averaging over each pixel's area, whereas the published code interpolates
//!   between four pixels and skips the others. They are never downscaled below 16 pixels a side.
//! - The code's own defaults are a different configuration: `prune_every` = 3000, `prune_share` = 0.05,
//!   `prune_until` = 24000, `vanilla`'s defaults for growth, and full-size images (`whole_from` = 0).
//! - At least one Gaussian is always kept.
//!
//! ## Parameters
//!
//! The first thirteen are those of `vanilla`.
//!
//! | name | default | range | unit | meaning |
//! |---|---|---|---|---|
//! | grow_from | 500 | >= 0 | step | start of growth (exclusive) |
//! | grow_until | 18000 | >= 0 | step | end of growth, of pruning by opacity and of opacity resets (exclusive) |
//! | grow_every | 125 | >= 0 | steps | interval of growth; 0: never |
//! | tau | 0.0002 | >= 0 | 1 / NDC | screen gradient from which a Gaussian is densified |
//! | small | 0.01 | >= 0 | scene extent | Gaussians up to this size are cloned, larger ones split |
//! | split_factor | 1.6 | 1 to 100 | | a split divides the scales by this |
//! | min_opacity | 0.005 | 0 to 1 | | Gaussians below this opacity are pruned during growth |
//! | max_scale | 0.1 | > 0 | scene extent | Gaussians above this size are pruned during growth |
//! | max_scale_from | 2500 | >= 0 | step | start of pruning by size (exclusive) |
//! | reset_every | 2500 | >= 0 | steps | interval of opacity resets; 0: never |
//! | reset_opacity | 0.01 | 0 to 1, both excluded | | largest opacity after a reset |
//! | white_reset_at | 500 | >= 0 | step | one more reset, on a white background only; 0: never |
//! | governor | false | | | grow along a curve instead of by `tau` |
//! | first_resolution | 0.3 | 0 to 1, 0 excluded | sides | factor on the images' sides at the start |
//! | whole_from | 21000 | >= 0 | step | start of training on full-size images; 0: always |
//! | prune_every | 5100 | >= 0 | steps | interval of prunes; 0: never |
//! | prune_until | 27000 | >= 0 | step | end of prunes (exclusive) |
//! | prune_share | 0.15 | 0 to 1 | Gaussians | quantile of influence up to which Gaussians are pruned |
//! | victims | "lowest" | lowest, random | | which Gaussians are pruned: the least influential or random ones |
//!
//! Defaults in steps are for a run of 30,000 iterations and scale with its length; intervals
//! (`…_every`) do not shrink below 100 steps.

use std::f64::consts::PI;
use std::ops::Bound::{Excluded, Included};

use serde::{Deserialize, Serialize};

use crate::adc::Window;
use crate::parameters::StepParameter::{self, Interval, Step};
use crate::parameters::{extended, in_range};
use crate::plan::{EditPlan, Reset};
use crate::policy::{DensityPolicy, Needs, PolicyResult, SceneInfo, Signal, Snapshot};
use crate::prune::Victims;
use crate::registry::ConfiguredPolicy;
use crate::rng::PolicyRng;
use crate::sample::quantile;
use crate::vanilla::{Vanilla, VanillaParams};

crate::register_policy!(
    "eagles",
    Eagles,
    summary: "growth as in vanilla on coarse-to-fine images, and pruning of the least influential",
    source: "EAGLES, Girish et al. 2024, arXiv 2312.04564",
    doc: include_str!("mod.rs"),
);

/// Parameters of [`Eagles`], explained in its manual page.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default)]
#[expect(missing_docs, reason = "the manual page documents every parameter, and a test checks it")]
pub struct EaglesParams {
    #[serde(flatten)]
    pub growth: VanillaParams,
    pub first_resolution: f64,
    pub whole_from: u32,
    pub prune_every: u32,
    pub prune_until: u32,
    pub prune_share: f64,
    pub victims: Victims,
}

impl Default for EaglesParams {
    fn default() -> Self {
        Self {
            growth: VanillaParams {
                grow_until: 18_000,
                grow_every: 125,
                max_scale_from: 2500,
                reset_every: 2500,
                ..VanillaParams::default()
            },
            first_resolution: 0.3,
            whole_from: 21_000,
            prune_every: 5100,
            prune_until: 27_000,
            prune_share: 0.15,
            victims: Victims::Lowest,
        }
    }
}

/// Growth as in `vanilla` on coarse-to-fine images, and pruning by influence.
#[derive(Debug)]
pub struct Eagles {
    params: EaglesParams,
    growth: Vanilla,
    prunes: Window,
}

impl ConfiguredPolicy for Eagles {
    type Params = EaglesParams;

    const STEP_PARAMETERS: &'static [StepParameter] = &extended::<9>(
        Vanilla::STEP_PARAMETERS,
        &[Step("whole_from"), Interval("prune_every"), Step("prune_until")],
    );

    fn new(params: EaglesParams, scene: &SceneInfo) -> PolicyResult<Self> {
        let above_zero = (Excluded(0.0), Included(1.0));
        in_range("first_resolution", params.first_resolution, above_zero)?;
        in_range("prune_share", params.prune_share, 0.0..=1.0)?;
        let growth = Vanilla::new(params.growth.clone(), scene)?;
        let EaglesParams { prune_every: every, prune_until: until, .. } = params;
        Ok(Self { growth, prunes: Window { from: 0, until, every }, params })
    }
}

impl DensityPolicy for Eagles {
    fn needs(&self, scene: &SceneInfo) -> Needs {
        let growth = self.growth.needs(scene);
        let shrinks = self.params.first_resolution < 1.0 && self.params.whole_from > 0;
        Needs {
            signals: growth.signals.with(Signal::WeightSum),
            least_resolution: shrinks.then_some(self.params.first_resolution),
            ..growth
        }
    }

    fn is_due(&self, step: u32) -> bool {
        self.growth.is_due(step) || self.prunes.is_due(step)
    }

    fn resolution(&self, step: u32) -> f64 {
        let EaglesParams { first_resolution: first, whole_from, .. } = self.params;
        if step >= whole_from {
            return 1.0;
        }
        let progress = f64::from(step) / f64::from(whole_from);
        (1.0 - (1.0 - first) * 0.5 * (1.0 + (PI * progress).cos())).clamp(first, 1.0)
    }

    fn plan(&mut self, now: &Snapshot<'_>, rng: &PolicyRng, plan: &mut EditPlan) -> PolicyResult {
        self.growth.plan(now, rng, plan)?;
        if !self.prunes.is_due(now.step) {
            return Ok(());
        }
        let influence: Vec<f32> =
            now.signal(Signal::WeightSum)?.iter().map(|&sum| sum.max(0.0)).collect();
        let limit = quantile(&influence, self.params.prune_share).unwrap_or(0.0);
        let is_low = |&row: &u32| plan.is_free(row) && f64::from(influence[row as usize]) <= limit;
        let count = (0..plan.rows() as u32).filter(is_low).count();
        self.params.victims.prune(plan, &influence, count, rng);
        plan.reset(Reset::Only([Signal::WeightSum].into()));
        Ok(())
    }
}

#[cfg(test)]
mod tests;
