//! # lightgaussian — growth as in `vanilla`, then pruning by global significance
//!
//! Grows a model as `vanilla` does, and at two later steps prunes the Gaussians that contribute least
//! to all training views together. The rest of the run trains the remaining Gaussians.
//!
//! Source: *LightGaussian: Unbounded 3D Gaussian Compression with 15x Reduction and 200+ FPS*, Fan, Wang,
//! Wen, Zhu, Xu, Wang, NeurIPS 2024, arXiv 2311.17245, section 3.2, with the constants of its public
//! code for pruning while a model is trained.
//!
//! ## Method
//!
//! **Growth** is that of `vanilla`, with its parameters: clones and splits by screen gradient, pruning by
//! opacity and size, opacity resets, and a hard stop at the budget (with `governor`, a growth curve). It ends at
//! `grow_until`, before the first prune.
//!
//! **Pruning.** With `schedule = "twice"`, the share `first_share` of all Gaussians is pruned at step
//! `first_at` and the share `second_share` of the rest at `second_at`: those with the lowest global
//! significance
//!
//! S = V^β · Σ over all training views, Σ over the pixels that the Gaussian is blended into, of o
//!
//! with o its opacity, V the product of its three standard deviations and β = `volume_power`. The
//! published second share is 0.8 times the first: 0.8 · 0.5 = 0.4. With `schedule = "once"`, the other published
//! form, the share `once_share` is pruned at `once_at`. A share of 0, or a step of 0, switches a prune off;
//! if both prunes fall on one step, only the first takes place.
//!
//! - `hit` is the contribution of a pixel: `opacity`, the opacity o, as in the published code; or
//!   `blend-weight`, the Gaussian's weight α·T in the pixel, so that a Gaussian hidden behind others counts less.
//!   The paper uses the opacity times the transmittance T; the blend weight also falls off towards the
//!   Gaussian's edge. The published figures are for `opacity`, the default.
//! - `volume` is V: `plain`, as in the published code; or `clipped`, as in the paper, min(V / V90, 1),
//!   where V90 is the 90th percentile.
//! - `victims = "random"` is a control that measures the effect of the criterion: it prunes the same number
//!   at random. It renders no view, and its run is identical to the real one up to the first prune.
//!
//! ## Under a budget
//!
//! The budget bounds growth and is never exceeded. Nothing grows after the prunes, so a run ends far below
//! it: with the defaults at 0.5 · 0.6 = 30 % of the grown model, with `once` at 34 %. Other policies end
//! with three times as many Gaussians at the same budget, so also compare at equal final numbers of Gaussians.
//!
//! ## Differences from the published code
//!
//! - The published code divides V by a volume V_ref that 90 % of the Gaussians exceed. V_ref is the same for
//!   all Gaussians and does not change their order, so it is left out.
//! - ⌊share · N⌋ of N Gaussians are pruned; the published code also prunes all others with
//!   the same significance as the last of these. At least one Gaussian is always kept.
//! - Training views that nearly duplicate another are not rendered (`--full` renders all).
//! - The published pipeline continues with distilled spherical harmonics and quantised vectors. They reduce
//!   the file size of a finished model and are not part of density control.
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
//! | schedule | "twice" | twice, once | | number of prunes |
//! | first_at | 16000 | >= 0 | step | first prune of `twice`; 0: none |
//! | first_share | 0.5 | 0 to 1 | Gaussians | share that the first prune removes |
//! | second_at | 24000 | >= 0 | step | second prune of `twice`; 0: none |
//! | second_share | 0.4 | 0 to 1 | Gaussians | share that the second prune removes |
//! | once_at | 20000 | >= 0 | step | the prune of `once`; 0: none |
//! | once_share | 0.66 | 0 to 1 | Gaussians | share that the prune of `once` removes |
//! | victims | "lowest" | lowest, random | | which Gaussians are pruned: the least significant or random ones |
//! | hit | "opacity" | opacity, blend-weight | | contribution of a pixel to the significance |
//! | volume | "plain" | plain, clipped | | volume V in the significance |
//! | volume_power | 0.1 | 0 to 1 | | power β of the volume; 0: the volume is ignored |
//!
//! Defaults in steps are for a run of 30,000 iterations and scale with its length; intervals
//! (`…_every`) do not shrink below 100 steps.

use crate::parameters::StepParameter::{self, Step};
use crate::parameters::extended;
use crate::plan::EditPlan;
use crate::policy::{
    AuxColumn, AuxRequest, AuxView, DensityPolicy, Needs, PolicyResult, SceneInfo, Signal, Snapshot,
};
use crate::prune::{Victims, ViewAccumulator};
use crate::registry::ConfiguredPolicy;
use crate::rng::PolicyRng;
use crate::vanilla::Vanilla;

mod parameters;

pub use parameters::{Hit, LightGaussianParams, Schedule, Volume};

crate::register_policy!(
    "lightgaussian",
    LightGaussian,
    summary: "growth as in vanilla, then two prunes by opacity, pixels and volume over all views",
    source: "LightGaussian, Fan et al. 2024, arXiv 2311.17245",
    doc: include_str!("mod.rs"),
);

/// Growth as in `vanilla`, then pruning by global significance.
#[derive(Debug)]
pub struct LightGaussian {
    params: LightGaussianParams,
    growth: Vanilla,
    /// Numbers of pixels or sums of blend weights, summed over the views of the event. Shape: `[rows]`.
    hits: ViewAccumulator,
}

impl ConfiguredPolicy for LightGaussian {
    type Params = LightGaussianParams;

    const STEP_PARAMETERS: &'static [StepParameter] = &extended::<9>(
        Vanilla::STEP_PARAMETERS,
        &[Step("first_at"), Step("second_at"), Step("once_at")],
    );

    fn new(params: LightGaussianParams, scene: &SceneInfo) -> PolicyResult<Self> {
        params.check()?;
        let growth = Vanilla::new(params.growth.clone(), scene)?;
        Ok(Self { growth, hits: ViewAccumulator::default(), params })
    }
}

impl DensityPolicy for LightGaussian {
    fn needs(&self, scene: &SceneInfo) -> Needs {
        let growth = self.growth.needs(scene);
        if self.params.victims == Victims::Random {
            return growth;
        }
        Needs {
            signals: growth.signals.with(Signal::ScaleProduct),
            aux: Some(AuxRequest { columns: vec![self.column()], ..AuxRequest::default() }),
            ..growth
        }
    }

    fn is_due(&self, step: u32) -> bool {
        self.growth.is_due(step) || self.share_at(step) > 0.0
    }

    fn aux_views(&self, step: u32, _rows: usize, _budget: usize) -> u32 {
        let measures = self.params.victims == Victims::Lowest && self.share_at(step) > 0.0;
        if measures { u32::MAX } else { 0 }
    }

    fn observe(&mut self, view: &AuxView<'_>) -> PolicyResult {
        self.hits.add(view.step, view.column(self.column())?);
        Ok(())
    }

    fn plan(&mut self, now: &Snapshot<'_>, rng: &PolicyRng, plan: &mut EditPlan) -> PolicyResult {
        self.growth.plan(now, rng, plan)?;
        let share = self.share_at(now.step);
        if share > 0.0 {
            let count = (share * now.rows() as f64).floor() as usize;
            let significance = match (self.params.victims, self.hits.take(now)) {
                (Victims::Random, _) => Vec::new(),
                (Victims::Lowest, Some(hits)) => self.significance(now, &hits)?,
                // No view was measured, so nothing is pruned.
                (Victims::Lowest, None) => return Ok(()),
            };
            self.params.victims.prune(plan, &significance, count, rng);
        }
        Ok(())
    }
}

impl LightGaussian {
    /// The column that is summed over the views.
    fn column(&self) -> AuxColumn {
        match self.params.hit {
            Hit::Opacity => AuxColumn::PixelCount,
            Hit::BlendWeight => AuxColumn::WeightSum,
        }
    }

    /// Share of all rows that is pruned at `step`; 0 at all steps without a prune.
    fn share_at(&self, step: u32) -> f64 {
        let params = &self.params;
        match params.schedule {
            _ if step == 0 => 0.0,
            Schedule::Twice if step == params.first_at => params.first_share,
            Schedule::Twice if step == params.second_at => params.second_share,
            Schedule::Once if step == params.once_at => params.once_share,
            Schedule::Twice | Schedule::Once => 0.0,
        }
    }

    /// The significance S of every row, >= 0; 0 in place of NaN. Shape: `[rows]`.
    fn significance(&self, now: &Snapshot<'_>, hits: &[f32]) -> PolicyResult<Vec<f32>> {
        let (opacity, volume) = (now.signal(Signal::Opacity)?, now.signal(Signal::ScaleProduct)?);
        let per_hit = |row: usize| match self.params.hit {
            Hit::Opacity => opacity[row],
            // The blend weight includes the opacity.
            Hit::BlendWeight => 1.0,
        };
        let max_volume = match self.params.volume {
            Volume::Plain => f32::INFINITY,
            Volume::Clipped => percentile_90(volume),
        };
        let significance = |(row, (&hits, &volume)): (usize, (&f32, &f32))| {
            // `min` would replace NaN by the limit.
            let volume = if volume > max_volume { max_volume } else { volume };
            let volume = f64::from(volume).powf(self.params.volume_power);
            let significance = f64::from(hits) * f64::from(per_hit(row)) * volume;
            if significance > 0.0 { significance as f32 } else { 0.0 }
        };
        Ok(hits.iter().zip(volume).enumerate().map(significance).collect())
    }
}

/// The 90th percentile: of n values in descending order, the one after the first ⌊n / 10⌋. Infinite if there
/// are no values.
fn percentile_90(volume: &[f32]) -> f32 {
    let mut volumes = volume.to_vec();
    let larger_count = volumes.len() / 10;
    if larger_count >= volumes.len() {
        return f32::INFINITY;
    }
    let descending = |a: &f32, b: &f32| b.total_cmp(a);
    *volumes.select_nth_unstable_by(larger_count, descending).1
}

#[cfg(test)]
mod tests;
