//! # reduced-3dgs — growth as in `vanilla`, with regular pruning of redundant Gaussians
//!
//! Grows a model as `vanilla` does, and throughout the run prunes Gaussians in crowded regions as well as the
//! faintest ones.
//!
//! Source: *Reducing the Memory Footprint of 3D Gaussian Splatting*, Papantonakis, Kopanas, Kerbl, Lanvin,
//! Drettakis, I3D 2024, arXiv 2406.17074, section 3.1, with the constants of its public code.
//!
//! ## Method
//!
//! **Growth** is that of `vanilla`, with its parameters: clones and splits by screen gradient, pruning by
//! opacity and size, opacity resets, and a hard stop at the budget (with `governor`, a growth curve).
//!
//! **Redundancy.** No view can separate Gaussians within one pixel. Each Gaussian therefore has a sphere
//! around its mean with radius r = √3/2 · p, half the diagonal of a cube with edge p, where p is the smallest
//! width of a pixel at its depth in the views since the last prune. The count of a sphere is 1 plus the number
//! of the Gaussian's `neighbours` nearest neighbours whose ellipsoid (`sigmas` standard deviations) intersects
//! it. The redundancy R of a Gaussian is the smallest count of all spheres that it intersects in this way, so
//! a Gaussian is not redundant if it is needed in one sparse region.
//!
//! **Pruning** every `prune_every` steps until `prune_until` (inclusive), but not at opacity resets:
//!
//! 1. A Gaussian is redundant if R > max(mean + `deviations` · standard deviation, `min_redundancy`), with
//!    mean and standard deviation over all Gaussians. Redundant Gaussians below their median opacity are
//!    pruned.
//! 2. Faint Gaussians, those below both `faint_opacity` and the `faint_share` quantile of all opacities, are pruned.
//! 3. After growth (`grow_until`), Gaussians below opacity 1/255 are pruned, as they are never rendered.
//!
//! **Loss.** `opacity_term` · mean opacity is added to the loss, so that unneeded Gaussians fade.
//!
//! `victims = "random"` is a control that measures the effect of the criterion: it prunes the same number at
//! random. As it leaves redundant Gaussians, it then finds more to prune than the real run. To end at the same
//! number, set `random_keep` to the number of Gaussians at which the real run ended: from `grow_until` on, each
//! prune then removes the same share, and the last one leaves this number.
//!
//! ## Under a budget
//!
//! The budget bounds growth and is never exceeded. Until `grow_until`, new Gaussians take the place of pruned
//! ones. Nothing grows after that, so a run ends below the budget: with the defaults each prune removes at
//! least the faintest 3 %, as long as these are below `faint_opacity`. With a budget of 8,000, runs of 7,000
//! steps on half-resolution images ended at 24 to 34 % of the budget (six scenes). Also compare policies
//! at equal final numbers of Gaussians.
//!
//! ## Differences from the published code
//!
//! - Spherical harmonics of Gaussians whose colour hardly varies are not dropped, as this needs the colour
//!   seen by each view. Without this step, the published schedule prunes to the end of the run, as here. The
//!   published codebook for the finished model is not part of density control.
//! - The paper does not define the extent of an ellipsoid. Three standard deviations is where a rasteriser
//!   stops drawing it.
//! - The smallest pixel width is taken over the views since the last prune (a few epochs), not over all views. A
//!   Gaussian that was visible in none of them has no sphere.
//! - Redundancy is measured before the growth of the same step, and Gaussians that grow are not pruned.
//! - At least one Gaussian is always kept.
//!
//! ## Parameters
//!
//! The first thirteen are those of `vanilla`.
//!
//! | name | default | range | unit | meaning |
//! |---|---|---|---|---|
//! | grow_from | 500 | >= 0 | step | start of growth (exclusive) |
//! | grow_until | 15000 | >= 0 | step | end of growth and of opacity resets (exclusive) |
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
//! | prune_every | 1000 | >= 0 | steps | interval of pruning; 0: never |
//! | prune_until | 30000 | >= 0 | step | end of pruning (inclusive) |
//! | neighbours | 30 | 1 to 1000 | Gaussians | nearest neighbours that are tested |
//! | sigmas | 3.0 | > 0 | standard deviations | half-axes of an ellipsoid |
//! | deviations | 1.0 | >= 0 | standard deviations | a Gaussian is redundant only if R is this far above the mean R |
//! | min_redundancy | 3.0 | >= 0 | Gaussians | a Gaussian is redundant only if R is above this |
//! | faint_share | 0.03 | 0 to 1 | Gaussians | a Gaussian is faint only if it is below this quantile of opacity |
//! | faint_opacity | 0.05 | 0 to 1 | | a Gaussian is faint only if it is below this opacity; 0: none is |
//! | opacity_term | 0.001 | >= 0 | loss | coefficient of the mean opacity |
//! | victims | "lowest" | lowest, random | | which Gaussians are pruned: redundant and faint ones, or as many random ones |
//! | random_keep | 0 | >= 0 | Gaussians | final number of `random`; 0: each prune removes as many as `lowest` |
//!
//! Defaults in steps are for a run of 30,000 iterations and scale with its length; intervals
//! (`…_every`) do not shrink below 100 steps.

use crate::parameters::StepParameter::{self, Interval, Step};
use crate::parameters::extended;
use crate::plan::{EditPlan, Reset};
use crate::policy::{
    DensityPolicy, LossTerms, Needs, PolicyResult, SceneInfo, Signal, SignalSet, Snapshot,
};
use crate::prune::Victims;
use crate::registry::ConfiguredPolicy;
use crate::rng::PolicyRng;
use crate::sample::quantile;
use crate::vanilla::Vanilla;
use redundancy::Ellipsoids;

mod parameters;
mod redundancy;

pub use parameters::ReducedParams;

crate::register_policy!(
    "reduced-3dgs",
    Reduced,
    summary: "growth as in vanilla, with regular pruning of Gaussians where many share a pixel",
    source: "Reduced-3DGS, Papantonakis et al. 2024, arXiv 2406.17074",
    doc: include_str!("mod.rs"),
);

/// Smallest alpha that is rendered.
const MIN_RENDERED_ALPHA: f32 = 1.0 / 255.0;

/// Growth as in `vanilla`, with pruning of redundant and faint rows.
#[derive(Debug)]
pub struct Reduced {
    params: ReducedParams,
    growth: Vanilla,
}

impl ConfiguredPolicy for Reduced {
    type Params = ReducedParams;

    const STEP_PARAMETERS: &'static [StepParameter] =
        &extended::<8>(Vanilla::STEP_PARAMETERS, &[Interval("prune_every"), Step("prune_until")]);

    fn new(params: ReducedParams, scene: &SceneInfo) -> PolicyResult<Self> {
        params.check()?;
        Ok(Self { growth: Vanilla::new(params.growth.clone(), scene)?, params })
    }
}

impl DensityPolicy for Reduced {
    fn needs(&self, scene: &SceneInfo) -> Needs {
        let growth = self.growth.needs(scene);
        let shape = [Signal::Position, Signal::LogScale, Signal::Orientation, Signal::PixelSizeMin];
        let opacity = self.params.opacity_term as f32;
        Needs {
            signals: growth.signals.union(shape.into()),
            loss_terms: LossTerms { opacity, ..LossTerms::default() },
            ..growth
        }
    }

    fn is_due(&self, step: u32) -> bool {
        self.growth.is_due(step) || self.prunes_at(step)
    }

    fn plan(&mut self, now: &Snapshot<'_>, rng: &PolicyRng, plan: &mut EditPlan) -> PolicyResult {
        self.growth.plan(now, rng, plan)?;
        if self.prunes_at(now.step) {
            self.prune(now, rng, plan)?;
            plan.reset(Reset::Only(SignalSet::default().with(Signal::PixelSizeMin)));
        }
        Ok(())
    }
}

impl Reduced {
    fn prunes_at(&self, step: u32) -> bool {
        let ReducedParams { prune_every, prune_until, .. } = self.params;
        let is_due = prune_every > 0 && step <= prune_until && step.is_multiple_of(prune_every);
        // Right after a reset all opacities are similar.
        is_due && step > 0 && !self.growth.resets.is_due(step)
    }

    /// Prunes redundant and faint rows, or the same number at random, among those without an edit.
    fn prune(&self, now: &Snapshot<'_>, rng: &PolicyRng, plan: &mut EditPlan) -> PolicyResult {
        if let Some(count) = self.random_count(now, plan) {
            Victims::Random.prune(plan, &[], count, rng);
            return Ok(());
        }
        let opacity = now.signal(Signal::Opacity)?;
        let mut order = vec![f32::INFINITY; now.rows()];
        let mut count = 0;
        for row in self.victims(now)? {
            if plan.is_free(row) && order[row as usize].is_infinite() {
                // The order of pruning: if all rows are victims, the most opaque one is kept.
                order[row as usize] = opacity[row as usize];
                count += 1;
            }
        }
        self.params.victims.prune(plan, &order, count, rng);
        Ok(())
    }

    /// The rows that are redundant or faint; some may be listed twice.
    fn victims(&self, now: &Snapshot<'_>) -> PolicyResult<Vec<u32>> {
        let opacity = now.signal(Signal::Opacity)?;
        let mut victims = self.redundant(&self.redundancy(now)?, opacity);
        let faint = quantile(opacity, self.params.faint_share)
            .map_or(0.0, |limit| limit.min(self.params.faint_opacity) as f32);
        let is_after_growth = now.step >= self.params.growth.grow_until;
        let invisible = if is_after_growth { MIN_RENDERED_ALPHA } else { 0.0 };
        let is_faint = |opacity: f32| opacity < faint.max(invisible);
        victims.extend((0..).zip(opacity).filter(|(_, o)| is_faint(**o)).map(|(row, _)| row));
        Ok(victims)
    }

    /// The redundancy R of every row, >= 1. Shape: `[rows]`.
    fn redundancy(&self, now: &Snapshot<'_>) -> PolicyResult<Vec<f32>> {
        let ellipsoids = Ellipsoids {
            means: now.positions()?,
            log_scales: now.log_scales()?,
            orientations: now.orientations()?,
            pixel_sizes: now.signal(Signal::PixelSizeMin)?,
            sigmas: self.params.sigmas,
        };
        Ok(ellipsoids.redundancy(self.params.neighbours as usize))
    }

    /// The redundant rows below their median opacity.
    fn redundant(&self, redundancy: &[f32], opacity: &[f32]) -> Vec<u32> {
        let (mean, deviation) = mean_and_deviation(redundancy);
        let limit = (mean + self.params.deviations * deviation).max(self.params.min_redundancy);
        let rows = (0..redundancy.len() as u32)
            .filter(|&row| f64::from(redundancy[row as usize]) > limit)
            .filter(|&row| opacity[row as usize].is_finite());
        let mut rows: Vec<u32> = rows.collect();
        let opacities: Vec<f32> = rows.iter().map(|&row| opacity[row as usize]).collect();
        let median = quantile(&opacities, 0.5).unwrap_or(0.0);
        rows.retain(|&row| f64::from(opacity[row as usize]) < median);
        rows
    }

    /// Number of rows that the random control prunes now so that it ends at `random_keep`: the same share at each
    /// prune after growth. `None` during growth or without `random_keep`.
    fn random_count(&self, now: &Snapshot<'_>, plan: &EditPlan) -> Option<usize> {
        let ReducedParams { victims, random_keep, prune_until, prune_every, .. } = self.params;
        let (step, until) = (now.step, prune_until.min(now.scene.iterations));
        if victims != Victims::Random || random_keep == 0 || step < self.params.growth.grow_until {
            return None;
        }
        let left = plan.rows() - plan.pruned();
        let later = (step / prune_every + 1..=until / prune_every)
            .filter(|event| self.prunes_at(event * prune_every));
        let prunes = later.count() + 1;
        let kept = left as f64 * (f64::from(random_keep) / left as f64).powf(1.0 / prunes as f64);
        Some(left.saturating_sub(kept.round() as usize))
    }
}

/// Mean and sample standard deviation; each is 0 if there are too few values for it.
fn mean_and_deviation(values: &[f32]) -> (f64, f64) {
    let count = values.len() as f64;
    let mean = values.iter().map(|&v| f64::from(v)).sum::<f64>() / count.max(1.0);
    let squares: f64 = values.iter().map(|&v| (f64::from(v) - mean).powi(2)).sum();
    (mean, (squares / (count - 1.0).max(1.0)).sqrt())
}

#[cfg(test)]
mod tests;
