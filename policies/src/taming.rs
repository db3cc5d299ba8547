//! # taming — growth along a curve, by a score measured in rendered views
//!
//! *Taming 3DGS: High-Quality Radiance Fields with Limited Resources*, Mallick, Goel, Kerbl, Vicente
//! Carrasco, Steinberger, De la Torre, SIGGRAPH Asia 2024, arXiv 2406.15643, with the constants of its
//! public code.
//!
//! ## What it does
//!
//! After every `grow_every` steps, between `grow_from` and `grow_until`:
//!
//! 1. `views` training views, chosen at random, are rendered for the score
//!    s = Σ over views v of 50·L_v·[z(25, g_p) + z(100, opacity) + z(5, depth) + z(10, radius) +
//!    z(25, s_x·s_y·s_z) + z(50, Σ distance) + z(10, Σ M_v) + z(0.1, pixels) + z(50, Σ α·T)],
//!    over the views that show the row, with L_v the view's loss, z(c, x) = c·x / median of the x > 0
//!    (0 for x <= 0), Σ over the pixels that the row is blended into, and the pixel map
//!    M_v = 50·n(|I − G|) + 50·n(edge), n bringing a map to 0..1. The coefficients are parameters
//!    (`…_weight`).
//! 2. Rows whose screen gradient g_p is at least `tau` qualify, and are cloned where small, split
//!    where large, as by `vanilla`. The model grows by G rows, up to the curve
//!    N(x) = S + (B − S)(2x/M − (x/M)²) at event x of M, from the initial rows S to the budget B, and
//!    by no more than qualify. Of the small and the large, each has its share of G, and is drawn
//!    without replacement in proportion to s.
//! 3. Before step `prune_until`, half (`prune_share`) of those that `vanilla` would prune are pruned,
//!    drawn in proportion to 1/(10⁻⁶ + s).
//! 4. The gradient statistics start anew.
//!
//! Opacities are reset as by `vanilla`. The colour bands 1–3 have the step size `sh_rest` and step once
//! for `sh_every` iterations, on the sum of their gradients (`--lr` and `--sh-every` win over these).
//!
//! With `multiplier` m > 0, B is ⌊m · S⌋, but never more than the budget.
//!
//! ## Where we depart from the source
//!
//! - `prune = "published"`: the code draws the rows to prune from all, and removes those dead ones
//!   that happen to be among them; and it takes the scores of the rows as they were before splits
//!   removed parents, so that they belong to other rows. Both are done by this choice; `candidates`
//!   draws among the dead, by their own scores.
//! - Rows that are dead do not grow.
//! - One render per view gives colour, map and sums; the code renders twice.
//! - Edges at the border of an image are found by repeating its outermost pixels; the code's filter
//!   leaves the luma itself there.
//! - Opacities are trained to the end. In the code they stop at step 15,000, by what seems to be a slip.
//! - All rows step at every iteration; the code has a mode in which those off screen rest.
//!
//! ## Parameters
//!
//! | name | default | range | unit | what |
//! |---|---|---|---|---|
//! | grow_from | 500 | >= 0 | step | start of growth (exclusive) |
//! | grow_until | 15000 | >= 0 | step | end of growth and opacity resets (exclusive) |
//! | grow_every | 500 | >= 0 | steps | interval of growth; 0: never |
//! | multiplier | 0.0 | >= 0 | initial rows | final rows; 0: the budget |
//! | tau | 0.0002 | >= 0 | 1 / NDC | screen gradient from which a row qualifies |
//! | small | 0.01 | >= 0 | scene extent | up to this size a row is cloned, beyond it split |
//! | split_factor | 1.6 | 1 to 100 | | by which a split divides the scales |
//! | views | 10 | >= 0 | views | views rendered per event; 0: all |
//! | error_weight | 50.0 | >= 0 | | weight of the error in M |
//! | edge_weight | 50.0 | >= 0 | | weight of the edges in M |
//! | gradient_weight | 25.0 | >= 0 | | coefficient of g_p |
//! | opacity_weight | 100.0 | >= 0 | | coefficient of the opacity |
//! | depth_weight | 5.0 | >= 0 | | coefficient of the depth |
//! | radius_weight | 10.0 | >= 0 | | coefficient of the radius |
//! | scale_weight | 25.0 | >= 0 | | coefficient of the product of the standard deviations |
//! | distance_weight | 50.0 | >= 0 | | coefficient of the sum of distances |
//! | map_weight | 10.0 | >= 0 | | coefficient of the sum of M |
//! | count_weight | 0.1 | >= 0 | | coefficient of the number of pixels |
//! | blend_weight | 50.0 | >= 0 | | coefficient of the sum of blend weights |
//! | min_opacity | 0.005 | 0 to 1 | | opacity below which a row is dead |
//! | max_scale | 0.1 | > 0 | scene extent | size beyond which a row is dead |
//! | max_scale_from | 3000 | >= 0 | step | start of death by size (exclusive) |
//! | prune | "candidates" | candidates, published | | among whom the pruned are drawn |
//! | prune_share | 0.5 | 0 to 1 | the dead | share of the dead that is drawn |
//! | prune_until | 14500 | >= 0 | step | end of pruning (exclusive) |
//! | reset_every | 3000 | >= 0 | steps | interval of opacity resets; 0: never |
//! | reset_opacity | 0.01 | 0 to 1, both excluded | | largest opacity after a reset |
//! | white_reset_at | 500 | >= 0 | step | one more reset, on a white background only; 0: never |
//! | sh_every | 16 | 1 to 1000 | steps | iterations per step of the colour bands 1–3 |
//! | sh_rest | 0.00025 | > 0 | | step size of the colour bands 1–3 |
//!
//! Defaults that are steps are for a run of 30,000 and scale with its length, intervals (`…_every`)
//! down to 100 steps at most; `sh_every` does not.

use std::ops::Bound::{Excluded, Unbounded};

use crate::adc::{
    Mortality, OpacityResets, Window, clone_at, concave_curve, mean_over_views, spare_one, split_by,
};
use crate::parameters::in_range;
use crate::plan::{EditPlan, Reset};
use crate::policy::{
    AuxRequest, AuxView, Cadence, DensityPolicy, Needs, PixelMap, PolicyError, PolicyState,
    RateOverrides, SceneInfo, Signal, SignalSet, Snapshot, restore_nothing,
};
use crate::registry::ConfiguredPolicy;
use crate::rng::PolicyRng;
use crate::sample::weighted;
use score::Score;

mod parameters;
mod score;

pub use parameters::{PruneDraw, TamingParams};

crate::register_policy!(
    "taming",
    Taming,
    summary: "growth along a concave curve, drawn by a score measured in rendered views",
    source: "Taming 3DGS, Mallick et al. 2024, arXiv 2406.15643",
    doc: include_str!("taming.rs"),
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

    const STEP_PARAMETERS: &'static [&'static str] = &[
        "grow_from",
        "grow_until",
        "grow_every",
        "max_scale_from",
        "prune_until",
        "reset_every",
        "white_reset_at",
    ];

    fn new(params: TamingParams, scene: &SceneInfo) -> Result<Self, PolicyError> {
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
        let resets = (params.reset_every, params.grow_until, params.white_reset_at);
        let resets = OpacityResets::new(resets, params.reset_opacity, scene)?;
        in_range("sh_every", params.sh_every.into(), 1.0..=1000.0)?;
        in_range("sh_rest", params.sh_rest, (Excluded(0.0), Unbounded))?;
        let TamingParams { grow_from: from, grow_until: until, .. } = params;
        Ok(Self {
            grow: Window { from, until, every: params.grow_every },
            resets,
            score: Score::default(),
            params,
        })
    }
}

impl DensityPolicy for Taming {
    fn needs(&self, _scene: &SceneInfo) -> Needs {
        let params = &self.params;
        Needs {
            signals: SignalSet::of(&[
                Signal::VisibleCount,
                Signal::ScreenGradient,
                Signal::Opacity,
                Signal::ScaleMax,
                Signal::ScaleProduct,
            ]),
            aux: Some(AuxRequest {
                map: PixelMap {
                    error: params.error_weight as f32,
                    edge: params.edge_weight as f32,
                },
                columns: score::COLUMNS.to_vec(),
                points: 0,
            }),
            cadence: Cadence { all: 1, sh_rest: params.sh_every },
            rates: RateOverrides {
                sh_rest: Some(params.sh_rest as f32),
                ..RateOverrides::default()
            },
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

    fn observe(&mut self, view: &AuxView<'_>) -> Result<(), PolicyError> {
        self.score.add(view, &self.params)
    }

    fn plan(
        &mut self,
        now: &Snapshot<'_>,
        rng: &PolicyRng,
        plan: &mut EditPlan,
    ) -> Result<(), PolicyError> {
        if self.grow.is_due(now.step) {
            plan.cause("densify");
            self.densify(now, rng, plan)?;
            plan.reset(Reset::Signals);
        }
        self.resets.plan(now.step, plan);
        Ok(())
    }

    fn save(&self) -> PolicyState {
        PolicyState::Null
    }

    fn restore(&mut self, state: PolicyState) -> Result<(), PolicyError> {
        restore_nothing(&state)
    }
}

impl Taming {
    /// B, the rows at the end of the curve.
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
    ) -> Result<(), PolicyError> {
        let views = now.signal(Signal::VisibleCount)?;
        let gradient = mean_over_views(now.signal(Signal::ScreenGradient)?, views);
        let scale = now.signal(Signal::ScaleMax)?;
        let score = std::mem::take(&mut self.score).total(now, &gradient, &self.params)?;
        let dead = self.dead(now)?;
        let extent = f64::from(now.scene.extent);
        let small = (self.params.small * extent) as f32;
        let qualifies = |row: &u32| {
            gradient[*row as usize] >= self.params.tau as f32 && dead.binary_search(row).is_err()
        };
        let (clones, splits): (Vec<u32>, Vec<u32>) =
            (0..now.rows() as u32).filter(qualifies).partition(|&row| scale[row as usize] <= small);

        let wanted = clones.len() + splits.len();
        let end = self.end(now.scene, plan.budget());
        let allowed = concave_curve(self.grow, now.step, now.scene.initial_rows, end);
        let births = allowed.min(now.rows() + wanted).saturating_sub(now.rows());
        let split = split_by(self.params.split_factor as f32);
        let mut is_split = vec![false; now.rows()];
        for (set, offspring) in [(clones, clone_at([0.0; 3])), (splits, split)] {
            // Nobody is wanted only where both sets are empty.
            let share = births * set.len() / wanted.max(1);
            for row in weighted(&among(&set, &score), share, rng) {
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

    /// Rows that `vanilla` would prune, ascending.
    fn dead(&self, now: &Snapshot<'_>) -> Result<Vec<u32>, PolicyError> {
        let opacity = now.signal(Signal::Opacity)?;
        let scale = now.signal(Signal::ScaleMax)?;
        let by_size = now.step > self.params.max_scale_from;
        let max_scale = (self.params.max_scale * f64::from(now.scene.extent)) as f32;
        let mortality = Mortality {
            min_opacity: self.params.min_opacity as f32,
            max_scale: if by_size { max_scale } else { f32::INFINITY },
        };
        let is_dead = |row: &u32| mortality.is_dead(opacity[*row as usize], scale[*row as usize]);
        Ok((0..now.rows() as u32).filter(is_dead).collect())
    }

    fn prune(
        &self,
        now: &Snapshot<'_>,
        score: &[f32],
        dead: Vec<u32>,
        is_split: &[bool],
        rng: &PolicyRng,
        plan: &mut EditPlan,
    ) -> Result<(), PolicyError> {
        let weights: Vec<f32> = score.iter().map(|s| 1.0 / (1e-6 + s)).collect();
        let count = (self.params.prune_share * dead.len() as f64).floor() as usize;
        let mut victims = match self.params.prune {
            PruneDraw::Candidates => weighted(&among(&dead, &weights), count, rng),
            PruneDraw::Published => {
                // Without the parents of splits, rows are counted anew; the scores are not.
                let survivors: Vec<u32> =
                    (0..now.rows() as u32).filter(|&row| !is_split[row as usize]).collect();
                let drawn = weighted(&weights, count, rng).into_iter();
                let hit = drawn.filter_map(|place| survivors.get(place as usize).copied());
                hit.filter(|row| dead.binary_search(row).is_ok()).collect()
            }
        };
        spare_one(&mut victims, now.signal(Signal::Opacity)?);
        for row in victims {
            let _ = plan.prune(row);
        }
        Ok(())
    }
}

/// The weights of these rows; 0 for all others.
fn among(rows: &[u32], weights: &[f32]) -> Vec<f32> {
    let mut masked = vec![0.0; weights.len()];
    for &row in rows {
        masked[row as usize] = weights[row as usize];
    }
    masked
}

#[cfg(test)]
mod tests;
