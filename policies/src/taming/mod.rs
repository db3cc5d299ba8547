//! # taming — growth along a curve, by a score measured in rendered views
//!
//! Densifies Gaussians with large screen gradients, drawn by a score that measures their importance in badly
//! rendered views. The number of Gaussians follows a concave curve up to the budget.
//!
//! Source: *Taming 3DGS: High-Quality Radiance Fields with Limited Resources*, Mallick, Goel, Kerbl,
//! Vicente Carrasco, Steinberger, De la Torre, SIGGRAPH Asia 2024, arXiv 2406.15643, with the constants
//! of its public code.
//!
//! ## Method
//!
//! Every `grow_every` steps between `grow_from` and `grow_until`:
//!
//! 1. `views` random training views are rendered for the score
//!    s = Σ over views v of 50·L_v·[z(25, g_p) + z(100, opacity) + z(5, depth) + z(10, radius) +
//!    z(25, s_x·s_y·s_z) + z(50, Σ distance) + z(10, Σ M_v) + z(0.1, pixels) + z(50, Σ α·T)],
//!    over the views that show the Gaussian. L_v is the view's loss, g_p the screen gradient,
//!    z(c, x) = c·x / median of the positive x (0 for x <= 0), and the inner sums run over the pixels that the
//!    Gaussian is blended into, with distances from the projected mean. M_v = 50·n(|I − G|) + 50·n(edge) is a
//!    pixel map, where edge is the Laplacian of the photograph's luma, and n scales to 0..1. The coefficients
//!    are parameters (`…_weight`).
//! 2. Gaussians with g_p of at least `tau` are candidates; as in `vanilla`, small ones are cloned and
//!    large ones split. The model grows by at most the number of candidates and at most up to the curve
//!    N(x) = S + (B − S)(2x/M − (x/M)²) after x of M intervals, from the S initial Gaussians to the budget B.
//!    Small and large candidates share the growth in proportion to their numbers, and are drawn
//!    without replacement in proportion to s.
//! 3. Before step `prune_until`, half (`prune_share`) of the dead Gaussians (those that `vanilla` would prune)
//!    are pruned, drawn in proportion to 1/(10⁻⁶ + s).
//! 4. The gradient statistics are reset.
//!
//! Opacities are reset as in `vanilla`. SH bands 1–3 have the learning rate `sh_rest` and step once per
//! `sh_every` iterations, on the summed gradients (`--lr` overrides the rate).
//!
//! With `multiplier` m > 0 the curve ends at ⌊m · S⌋ instead, but never above the budget.
//!
//! ## Differences from the published code
//!
//! - The published code draws from all Gaussians and prunes the dead ones among those
//!   drawn. Its scores date from before splits removed the parents, so their indices refer to other Gaussians.
//!   `prune = "published"` does both; the default, `candidates`, draws from the dead by their own scores.
//! - Dead Gaussians do not grow.
//! - Colour, map and sums come from one render per view; the published code renders twice.
//! - The edge filter repeats the outermost pixels of an image; the published code takes their luma as the edge there.
//! - Opacities are trained to the end. The published code stops at step 15,000, apparently by mistake.
//! - All Gaussians are updated at every iteration; the published code has a mode that skips those off
//!   screen.
//!
//! ## Parameters
//!
//! | name | default | range | unit | meaning |
//! |---|---|---|---|---|
//! | grow_from | 500 | >= 0 | step | start of growth (exclusive) |
//! | grow_until | 15000 | >= 0 | step | end of growth and opacity resets (exclusive) |
//! | grow_every | 500 | >= 0 | steps | interval of growth; 0: never |
//! | multiplier | 0.0 | >= 0 | initial Gaussians | final number of Gaussians; 0: the budget |
//! | tau | 0.0002 | >= 0 | 1 / NDC | screen gradient from which a Gaussian is a candidate |
//! | small | 0.01 | >= 0 | scene extent | Gaussians up to this size are cloned, larger ones split |
//! | split_factor | 1.6 | 1 to 100 | | a split divides the scales by this |
//! | views | 10 | >= 0 | views | views rendered per event; 0: all |
//! | error_weight | 50.0 | >= 0 | | weight of the error in M_v |
//! | edge_weight | 50.0 | >= 0 | | weight of the edges in M_v |
//! | gradient_weight | 25.0 | >= 0 | | coefficient of g_p |
//! | opacity_weight | 100.0 | >= 0 | | coefficient of the opacity |
//! | depth_weight | 5.0 | >= 0 | | coefficient of the depth |
//! | radius_weight | 10.0 | >= 0 | | coefficient of the radius |
//! | scale_weight | 25.0 | >= 0 | | coefficient of the product of the standard deviations |
//! | distance_weight | 50.0 | >= 0 | | coefficient of the sum of distances |
//! | map_weight | 10.0 | >= 0 | | coefficient of the sum of M_v |
//! | count_weight | 0.1 | >= 0 | | coefficient of the number of pixels |
//! | blend_weight | 50.0 | >= 0 | | coefficient of the sum of blend weights |
//! | min_opacity | 0.005 | 0 to 1 | | Gaussians below this opacity are dead |
//! | max_scale | 0.1 | > 0 | scene extent | Gaussians above this size are dead |
//! | max_scale_from | 3000 | >= 0 | step | start of pruning by size (exclusive) |
//! | prune | "candidates" | candidates, published | | Gaussians that the prune draws from |
//! | prune_share | 0.5 | 0 to 1 | dead Gaussians | share that is drawn |
//! | prune_until | 14500 | >= 0 | step | end of pruning (exclusive) |
//! | reset_every | 3000 | >= 0 | steps | interval of opacity resets; 0: never |
//! | reset_opacity | 0.01 | 0 to 1, both excluded | | largest opacity after a reset |
//! | white_reset_at | 500 | >= 0 | step | one more reset, on a white background only; 0: never |
//! | sh_every | 16 | 1 to 1000 | steps | iterations per optimiser step of SH bands 1–3 |
//! | sh_rest | 0.00025 | > 0 | | learning rate of SH bands 1–3 |
//!
//! Defaults in steps are for a run of 30,000 iterations and scale with its length; intervals
//! (`…_every`) do not shrink below 100 steps. `sh_every` does not scale.

use std::ops::Bound::{Excluded, Unbounded};

use crate::adc::{
    GROWTH_SIGNALS, OpacityResets, PruneLimits, Window, clone_at, concave_curve, mean_over_views,
    spare_one, split_by,
};
use crate::parameters::StepParameter::{self, Interval, Step};
use crate::parameters::in_range;
use crate::plan::{EditPlan, Reset};
use crate::policy::{
    AuxRequest, AuxView, Cadence, DensityPolicy, Needs, PixelMap, PolicyResult, Rate,
    RateOverrides, SceneInfo, Signal, SignalSet, Snapshot,
};
use crate::registry::ConfiguredPolicy;
use crate::rng::PolicyRng;
use crate::sample::weighted;
use score::{COLUMNS, Score};

mod parameters;
mod score;

pub use parameters::{PruneDraw, TamingParams};

crate::register_policy!(
    "taming",
    Taming,
    summary: "growth along a concave curve, by a score measured in rendered views",
    source: "Taming 3DGS, Mallick et al. 2024, arXiv 2406.15643",
    doc: include_str!("mod.rs"),
);

/// Growth along a curve, by score.
#[derive(Debug)]
pub struct Taming {
    params: TamingParams,
    grow: Window,
    resets: OpacityResets,
    score: Score,
}

impl ConfiguredPolicy for Taming {
    type Params = TamingParams;

    const STEP_PARAMETERS: &'static [StepParameter] = &[
        Step("grow_from"),
        Step("grow_until"),
        Interval("grow_every"),
        Step("max_scale_from"),
        Step("prune_until"),
        Interval("reset_every"),
        Step("white_reset_at"),
    ];

    fn new(params: TamingParams, scene: &SceneInfo) -> PolicyResult<Self> {
        in_range("multiplier", params.multiplier, 0.0..)?;
        in_range("tau", params.tau, 0.0..)?;
        in_range("small", params.small, 0.0..)?;
        in_range("split_factor", params.split_factor, 1.0..=100.0)?;
        for (name, weight) in params.weights() {
            in_range(name, weight, 0.0..)?;
        }
        in_range("min_opacity", params.min_opacity, 0.0..=1.0)?;
        in_range("max_scale", params.max_scale, (Excluded(0.0), Unbounded))?;
        in_range("prune_share", params.prune_share, 0.0..=1.0)?;
        in_range("sh_every", params.sh_every.into(), 1.0..=1000.0)?;
        in_range("sh_rest", params.sh_rest, (Excluded(0.0), Unbounded))?;
        let TamingParams { grow_from: from, grow_until: until, grow_every: every, .. } = params;
        let TamingParams { reset_every, white_reset_at, reset_opacity, .. } = params;
        let resets = OpacityResets::new(reset_every, until, white_reset_at, reset_opacity, scene)?;
        Ok(Self { grow: Window { from, until, every }, resets, score: Score::default(), params })
    }
}

impl DensityPolicy for Taming {
    fn needs(&self, _scene: &SceneInfo) -> Needs {
        let params = &self.params;
        let (error, edge) = (params.error_weight as f32, params.edge_weight as f32);
        let map = PixelMap { error, edge, ..PixelMap::default() };
        let sh_rest = Some(Rate::constant(params.sh_rest));
        Needs {
            signals: SignalSet::from(GROWTH_SIGNALS).with(Signal::ScaleProduct),
            aux: Some(AuxRequest { map, columns: COLUMNS.to_vec(), ..AuxRequest::default() }),
            cadence: Cadence { all: 1, sh_rest: params.sh_every },
            rates: RateOverrides { sh_rest, ..RateOverrides::default() },
            ..Needs::default()
        }
    }

    fn is_due(&self, step: u32) -> bool {
        self.grow.is_due(step) || self.resets.is_due(step)
    }

    fn cadence(&self, _step: u32) -> Cadence {
        Cadence { all: 1, sh_rest: self.params.sh_every }
    }

    fn aux_views(&self, step: u32, _rows: usize, _budget: usize) -> u32 {
        match self.params.views {
            _ if !self.grow.is_due(step) => 0,
            0 => u32::MAX,
            views => views,
        }
    }

    fn observe(&mut self, view: &AuxView<'_>) -> PolicyResult {
        self.score.add(view, &self.params)
    }

    fn plan(&mut self, now: &Snapshot<'_>, rng: &PolicyRng, plan: &mut EditPlan) -> PolicyResult {
        if self.grow.is_due(now.step) {
            plan.cause("densify");
            self.densify(now, rng, plan)?;
            plan.reset(Reset::Signals);
        }
        self.resets.plan(now.step, plan);
        Ok(())
    }
}

impl Taming {
    /// B, the number of rows at the end of the curve.
    fn end(&self, scene: &SceneInfo, budget: usize) -> usize {
        match self.params.multiplier {
            m if m > 0.0 => budget.min((m * scene.initial_rows as f64).floor() as usize),
            _ => budget,
        }
    }

    fn densify(
        &mut self,
        now: &Snapshot<'_>,
        rng: &PolicyRng,
        plan: &mut EditPlan,
    ) -> PolicyResult {
        let views = now.signal(Signal::VisibleCount)?;
        let gradient = mean_over_views(now.signal(Signal::ScreenGradient)?, views);
        let scale = now.signal(Signal::ScaleMax)?;
        let score = std::mem::take(&mut self.score).total(now, &gradient, &self.params)?;
        let TamingParams { min_opacity, max_scale, max_scale_from, .. } = self.params;
        let limits = PruneLimits::at(now, min_opacity, max_scale, max_scale_from);
        let dead = limits.dead_rows(now)?;
        let small = (self.params.small * f64::from(now.scene.extent)) as f32;
        let is_candidate = |row: &u32| {
            gradient[*row as usize] >= self.params.tau as f32 && dead.binary_search(row).is_err()
        };
        let (clones, splits): (Vec<u32>, Vec<u32>) = (0..now.rows() as u32)
            .filter(is_candidate)
            .partition(|&row| scale[row as usize] <= small);

        let candidates = clones.len() + splits.len();
        let end = self.end(now.scene, plan.budget());
        let allowed = concave_curve(self.grow, now.step, now.scene.initial_rows, end);
        let growth = allowed.min(now.rows() + candidates).saturating_sub(now.rows());
        let split = split_by(self.params.split_factor as f32);
        let mut is_split = vec![false; now.rows()];
        for (rows, offspring) in [(clones, clone_at([0.0; 3])), (splits, split)] {
            let count = growth * rows.len() / candidates.max(1);
            for row in weighted(&masked(&score, &rows), count, rng) {
                // A refusal is counted by the plan.
                if plan.grow(row, offspring).is_ok() {
                    is_split[row as usize] = offspring == split;
                }
            }
        }
        if now.step < self.params.prune_until {
            self.prune(now, &score, dead, &is_split, rng, plan)?;
        }
        Ok(())
    }

    /// Prunes some of the `dead` rows, drawn by their scores.
    fn prune(
        &self,
        now: &Snapshot<'_>,
        score: &[f32],
        dead: Vec<u32>,
        is_split: &[bool],
        rng: &PolicyRng,
        plan: &mut EditPlan,
    ) -> PolicyResult {
        let weights: Vec<f32> = score.iter().map(|s| 1.0 / (1e-6 + s)).collect();
        let count = (self.params.prune_share * dead.len() as f64).floor() as usize;
        let mut pruned = match self.params.prune {
            PruneDraw::Candidates => weighted(&masked(&weights, &dead), count, rng),
            PruneDraw::Published => {
                // As published: rows are renumbered without the parents of splits, but scores are not.
                let kept: Vec<u32> =
                    (0..now.rows() as u32).filter(|&row| !is_split[row as usize]).collect();
                let drawn = weighted(&weights, count, rng).into_iter();
                let rows = drawn.filter_map(|index| kept.get(index as usize).copied());
                rows.filter(|row| dead.binary_search(row).is_ok()).collect()
            }
        };
        spare_one(&mut pruned, now.signal(Signal::Opacity)?);
        plan.prune_all(pruned);
        Ok(())
    }
}

/// The weights of these rows, and 0 for all others.
fn masked(weights: &[f32], rows: &[u32]) -> Vec<f32> {
    let mut masked = vec![0.0; weights.len()];
    for &row in rows {
        masked[row as usize] = weights[row as usize];
    }
    masked
}

#[cfg(test)]
mod tests;
