//! # radsplat — growth as in `vanilla`, then pruning of Gaussians with little weight in every pixel
//!
//! Grows a model as `vanilla` does, and at two later steps prunes the Gaussians whose weight is negligible in
//! every pixel of every training view. The rest of the run trains the remaining Gaussians.
//!
//! Source: *RadSplat: Radiance Field-Informed Gaussian Splatting for Robust Real-Time Rendering with 900+
//! FPS*, Niemeyer, Manhardt, Rakotosaona, Oechsle, Duckworth, Gosula, Tateno, Bates, Kaeser, Tombari, 3DV
//! 2025, arXiv 2403.13806, section 3.3. There is no official code.
//!
//! ## Method
//!
//! **Growth** is that of `vanilla`, with its parameters: clones and splits by screen gradient, pruning by
//! opacity and size, opacity resets, and a hard stop at the budget (with `governor`, a growth curve). It ends at
//! `grow_until`, before the first prune.
//!
//! **Pruning.** At the steps `first_at` and `second_at` all training views are rendered. A Gaussian's
//! importance is its largest blend weight α·T in any pixel of any view, and those below `min_weight` are
//! pruned. A sum of weights would spare large faint Gaussians; the largest weight tells whether a Gaussian
//! matters anywhere. The paper's light variant, with fewer Gaussians, is `min_weight` = 0.25.
//!
//! `victims = "random"` is a control that measures the effect of the importance: it prunes at random. Its run is
//! identical to the real one up to the first prune, which removes the same number. As most unimportant Gaussians
//! remain after that prune, the second prune would remove more than in the real run: set `random_keep` to the
//! number that the real run had after its second prune.
//!
//! ## Under a budget
//!
//! The budget bounds growth and is never exceeded. Nothing grows after the prunes, so a run ends below
//! the budget, by an amount that depends on the scene; also compare at equal final numbers of Gaussians.
//! With a budget of 8,000 and 2,000 steps on half-resolution images, the defaults kept 97 % of the grown model on
//! room256 and 87 % on cup; the light variant kept 34 % and 11 %.
//!
//! ## Differences from the paper
//!
//! - The paper starts from a radiance field and trains on its renderings. Here the initial model and
//!   the photographs are the same as for every other policy.
//! - At least one Gaussian is always kept.
//! - Training views that nearly duplicate another are not rendered (`--full` renders all).
//! - The paper then groups cameras and stores which Gaussians each group sees. That speeds up viewing and
//!   is not part of density control.
//!
//! ## Parameters
//!
//! The first thirteen are those of `vanilla`.
//!
//! | name | default | range | unit | meaning |
//! |---|---|---|---|---|
//! | grow_from | 500 | >= 0 | step | start of growth (exclusive) |
//! | grow_until | 15000 | >= 0 | step | end of growth, of pruning by opacity and of opacity resets (exclusive) |
//! | grow_every | 100 | >= 0 | steps | interval of growth; 0: never |
//! | tau | 0.0002 | >= 0 | 1 / NDC | screen gradient from which a Gaussian is densified |
//! | small | 0.01 | >= 0 | scene extent | Gaussians up to this size are cloned, larger ones split |
//! | split_factor | 1.6 | 1 to 100 | | a split divides the scales by this |
//! | min_opacity | 0.005 | 0 to 1 | | Gaussians below this opacity are pruned during growth |
//! | max_scale | 0.1 | > 0 | scene extent | Gaussians above this size are pruned during growth |
//! | max_scale_from | 3000 | >= 0 | step | start of pruning by size (exclusive) |
//! | reset_every | 3000 | >= 0 | steps | interval of opacity resets; 0: never |
//! | reset_opacity | 0.01 | 0 to 1, both excluded | | largest opacity after a reset |
//! | white_reset_at | 500 | >= 0 | step | one more reset, on a white background only; 0: never |
//! | governor | false | | | grow along a curve instead of by `tau` |
//! | first_at | 16000 | >= 0 | step | first prune; 0: none |
//! | second_at | 24000 | >= 0 | step | second prune; 0: none |
//! | min_weight | 0.01 | 0 to 1 | | Gaussians whose largest blend weight is below this are pruned |
//! | victims | "lowest" | lowest, random | | which Gaussians are pruned: the least important or random ones |
//! | random_keep | 0 | >= 0 | Gaussians | Gaussians that `random` keeps at the second prune; 0: prunes as many as `min_weight` would |
//!
//! Defaults in steps are for a run of 30,000 iterations and scale with its length; intervals
//! (`…_every`) do not shrink below 100 steps.

use serde::{Deserialize, Serialize};

use crate::parameters::StepParameter::{self, Step};
use crate::parameters::{extended, in_range};
use crate::plan::EditPlan;
use crate::policy::{
    AuxColumn, AuxRequest, AuxView, DensityPolicy, Needs, PolicyResult, SceneInfo, Snapshot,
};
use crate::prune::{Victims, ViewAccumulator};
use crate::registry::ConfiguredPolicy;
use crate::rng::PolicyRng;
use crate::vanilla::{Vanilla, VanillaParams};

crate::register_policy!(
    "radsplat",
    RadSplat,
    summary: "growth as in vanilla, then two prunes of Gaussians with little weight in every pixel",
    source: "RadSplat, Niemeyer et al. 2024, arXiv 2403.13806",
    doc: include_str!("mod.rs"),
);

/// Parameters of [`RadSplat`], explained in its manual page.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default)]
#[expect(missing_docs, reason = "the manual page documents every parameter, and a test checks it")]
pub struct RadSplatParams {
    #[serde(flatten)]
    pub growth: VanillaParams,
    pub first_at: u32,
    pub second_at: u32,
    pub min_weight: f64,
    pub victims: Victims,
    pub random_keep: u32,
}

impl Default for RadSplatParams {
    fn default() -> Self {
        Self {
            growth: VanillaParams::default(),
            first_at: 16_000,
            second_at: 24_000,
            min_weight: 0.01,
            victims: Victims::Lowest,
            random_keep: 0,
        }
    }
}

/// Growth as in `vanilla`, then pruning by the largest blend weight.
#[derive(Debug)]
pub struct RadSplat {
    params: RadSplatParams,
    growth: Vanilla,
    /// Largest blend weight in the views of the event. Shape: `[rows]`.
    weight: ViewAccumulator,
}

impl ConfiguredPolicy for RadSplat {
    type Params = RadSplatParams;

    const STEP_PARAMETERS: &'static [StepParameter] =
        &extended::<8>(Vanilla::STEP_PARAMETERS, &[Step("first_at"), Step("second_at")]);

    fn new(params: RadSplatParams, scene: &SceneInfo) -> PolicyResult<Self> {
        in_range("min_weight", params.min_weight, 0.0..=1.0)?;
        let growth = Vanilla::new(params.growth.clone(), scene)?;
        Ok(Self { growth, weight: ViewAccumulator::default(), params })
    }
}

impl DensityPolicy for RadSplat {
    fn needs(&self, scene: &SceneInfo) -> Needs {
        let aux = AuxRequest { columns: vec![AuxColumn::WeightMax], ..AuxRequest::default() };
        Needs { aux: Some(aux), ..self.growth.needs(scene) }
    }

    fn is_due(&self, step: u32) -> bool {
        self.growth.is_due(step) || self.prunes_at(step)
    }

    fn aux_views(&self, step: u32, _rows: usize, _budget: usize) -> u32 {
        if self.prunes_at(step) && self.kept_at_random(step).is_none() { u32::MAX } else { 0 }
    }

    fn observe(&mut self, view: &AuxView<'_>) -> PolicyResult {
        self.weight.maximum(view.step, view.column(AuxColumn::WeightMax)?);
        Ok(())
    }

    fn plan(&mut self, now: &Snapshot<'_>, rng: &PolicyRng, plan: &mut EditPlan) -> PolicyResult {
        self.growth.plan(now, rng, plan)?;
        if !self.prunes_at(now.step) {
            return Ok(());
        }
        let weight = self.weight.take(now);
        if let Some(kept) = self.kept_at_random(now.step) {
            let count = (plan.rows() - plan.pruned()).saturating_sub(kept);
            self.params.victims.prune(plan, &[], count, rng);
        } else if let Some(weight) = weight {
            let is_low = |row: u32| weight[row as usize] < self.params.min_weight as f32;
            let low = (0..plan.rows() as u32).filter(|&row| plan.is_free(row) && is_low(row));
            let count = low.count();
            self.params.victims.prune(plan, &weight, count, rng);
        }
        Ok(())
    }
}

impl RadSplat {
    fn prunes_at(&self, step: u32) -> bool {
        step > 0 && (step == self.params.first_at || step == self.params.second_at)
    }

    /// Number of rows that the control keeps at `step`, if `random_keep` sets it.
    fn kept_at_random(&self, step: u32) -> Option<usize> {
        let RadSplatParams { second_at, victims, random_keep, .. } = self.params;
        let applies = victims == Victims::Random && random_keep > 0 && step == second_at;
        applies.then_some(random_keep as usize)
    }
}

#[cfg(test)]
mod tests;
