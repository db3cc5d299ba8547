//! # vanilla — the original adaptive density control
//!
//! Kerbl, Kopanas, Leimkühler, Drettakis, *3D Gaussian Splatting for Real-Time Radiance Field
//! Rendering*, SIGGRAPH 2023, section 5.2, with the constants and the order of its public code.
//!
//! ## What it does
//!
//! After every `grow_every` steps, between `grow_from` and `grow_until`:
//!
//! 1. Rows whose screen gradient g (mean over the views that saw them of the norm of the loss
//!    gradient with respect to their mean on screen (NDC)) is at least `tau` need detail. Small ones
//!    (largest standard deviation at most `small` · scene extent) are cloned: an exact copy, at the
//!    same place. Larger ones are split into two samples of themselves, smaller by `split_factor`.
//! 2. Rows less opaque than `min_opacity` are pruned; after step `max_scale_from` also rows larger
//!    than `max_scale` · scene extent. (Pruning by size on screen is dead code in the original.)
//!    The last row is never pruned.
//! 3. The gradient statistics start anew.
//!
//! After every `reset_every` steps until `grow_until`, and on a white background once at
//! `white_reset_at`, no opacity may be above `reset_opacity`; opacity moments become zero.
//!
//! ## Under a budget
//!
//! Hard stop (default): growth comes before pruning, as in the original, and takes place as far as
//! there is room, the largest g first; at the budget nothing grows until pruning has made room. What
//! is refused is counted as denied. With `governor`, `tau` is not used: each event grows the rows
//! with the largest g, as many as bring the model up to a curve that rises from the initial rows to
//! the budget, N(x) = S + (B − S)(2x/M − (x/M)²) at event x of M (*Taming 3DGS*, Mallick et al.
//! 2024, equation 2). A hard stop spends the budget on whatever grows first, which some hold to be
//! an unfair baseline.
//!
//! ## Parameters
//!
//! | name | default | range | unit | what |
//! |---|---|---|---|---|
//! | grow_from | 500 | >= 0 | step | start of growth and pruning (exclusive) |
//! | grow_until | 15000 | >= 0 | step | end of growth, pruning and opacity resets (exclusive) |
//! | grow_every | 100 | >= 0 | steps | interval of growth and pruning; 0: never |
//! | tau | 0.0002 | >= 0 | 1 / NDC | screen gradient from which a row grows |
//! | small | 0.01 | >= 0 | scene extent | up to this size a row is cloned, beyond it split |
//! | split_factor | 1.6 | 1 to 100 | | by which a split divides the scales |
//! | min_opacity | 0.005 | 0 to 1 | | opacity below which a row is pruned |
//! | max_scale | 0.1 | > 0 | scene extent | size beyond which a row is pruned |
//! | max_scale_from | 3000 | >= 0 | step | start of pruning by size (exclusive) |
//! | reset_every | 3000 | >= 0 | steps | interval of opacity resets; 0: never |
//! | reset_opacity | 0.01 | 0 to 1, both excluded | | largest opacity after a reset |
//! | white_reset_at | 500 | >= 0 | step | one more reset, on a white background only; 0: never |
//! | governor | false | | | follow a growth curve rather than `tau` |
//!
//! Defaults that are steps are for a run of 30,000 and scale with its length, intervals (`…_every`)
//! down to 100 steps at most.

use std::ops::Bound::{Excluded, Unbounded};

use serde::{Deserialize, Serialize};

use crate::adc::{
    Mortality, OpacityResets, Window, clone_at, concave_curve, mean_over_views, spare_one, split_by,
};
use crate::parameters::in_range;
use crate::plan::{EditPlan, Reset};
use crate::policy::{
    DensityPolicy, Needs, PolicyError, PolicyState, SceneInfo, Signal, SignalSet, Snapshot,
    restore_nothing,
};
use crate::registry::ConfiguredPolicy;
use crate::rng::PolicyRng;
use crate::sample::largest;

crate::register_policy!(
    "vanilla",
    Vanilla,
    summary: "the original adaptive density control; hard stop or governed growth under a budget",
    source: "Kerbl et al. 2023, arXiv 2308.04079",
    doc: include_str!("vanilla.rs"),
);

/// Parameters of [`Vanilla`]; its manual page says what they mean.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
#[expect(missing_docs, reason = "the manual page documents every parameter, and a test checks it")]
pub struct VanillaParams {
    pub grow_from: u32,
    pub grow_until: u32,
    pub grow_every: u32,
    pub tau: f64,
    pub small: f64,
    pub split_factor: f64,
    pub min_opacity: f64,
    pub max_scale: f64,
    pub max_scale_from: u32,
    pub reset_every: u32,
    pub reset_opacity: f64,
    pub white_reset_at: u32,
    pub governor: bool,
}

impl Default for VanillaParams {
    fn default() -> Self {
        Self {
            grow_from: 500,
            grow_until: 15_000,
            grow_every: 100,
            tau: 2e-4,
            small: 0.01,
            split_factor: 1.6,
            min_opacity: 0.005,
            max_scale: 0.1,
            max_scale_from: 3000,
            reset_every: 3000,
            reset_opacity: 0.01,
            white_reset_at: 500,
            governor: false,
        }
    }
}

/// The original adaptive density control.
#[derive(Debug)]
pub struct Vanilla {
    params: VanillaParams,
    grow: Window,
    resets: OpacityResets,
}

impl ConfiguredPolicy for Vanilla {
    type Params = VanillaParams;

    const STEP_PARAMETERS: &'static [&'static str] = &[
        "grow_from",
        "grow_until",
        "grow_every",
        "max_scale_from",
        "reset_every",
        "white_reset_at",
    ];

    fn new(params: VanillaParams, scene: &SceneInfo) -> Result<Self, PolicyError> {
        in_range("tau", params.tau, 0.0..)?;
        in_range("small", params.small, 0.0..)?;
        in_range("split_factor", params.split_factor, 1.0..=100.0)?;
        in_range("min_opacity", params.min_opacity, 0.0..=1.0)?;
        in_range("max_scale", params.max_scale, (Excluded(0.0), Unbounded))?;
        let resets = (params.reset_every, params.grow_until, params.white_reset_at);
        let resets = OpacityResets::new(resets, params.reset_opacity, scene)?;
        let VanillaParams { grow_from: from, grow_until: until, .. } = params;
        Ok(Self { grow: Window { from, until, every: params.grow_every }, resets, params })
    }
}

impl DensityPolicy for Vanilla {
    fn needs(&self, _scene: &SceneInfo) -> Needs {
        let signals = SignalSet::of(&[
            Signal::VisibleCount,
            Signal::ScreenGradient,
            Signal::Opacity,
            Signal::ScaleMax,
        ]);
        Needs { signals, ..Needs::default() }
    }

    fn is_due(&self, step: u32) -> bool {
        self.grow.is_due(step) || self.resets.is_due(step)
    }

    fn plan(
        &mut self,
        now: &Snapshot<'_>,
        _rng: &PolicyRng,
        plan: &mut EditPlan,
    ) -> Result<(), PolicyError> {
        if self.grow.is_due(now.step) {
            plan.cause("densify");
            self.densify(now, plan)?;
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

impl Vanilla {
    /// Growth, then pruning. In the original, too, rows are pruned as they are after growth: a huge
    /// row that has been split is judged by its children's size.
    fn densify(&self, now: &Snapshot<'_>, plan: &mut EditPlan) -> Result<(), PolicyError> {
        let opacity = now.signal(Signal::Opacity)?;
        let scale = now.signal(Signal::ScaleMax)?;
        let screen_gradient = now.signal(Signal::ScreenGradient)?;
        let gradient = mean_over_views(screen_gradient, now.signal(Signal::VisibleCount)?);
        let mortality = self.mortality(now);
        let small = (self.params.small * f64::from(now.scene.extent)) as f32;
        let factor = self.params.split_factor as f32;

        let is_small = |row: usize| scale[row] <= small;
        let would_die = |row: usize| {
            let grown_scale = if is_small(row) { scale[row] } else { scale[row] / factor };
            mortality.is_dead(opacity[row], grown_scale)
        };
        let is_wanted = |row: usize| match self.params.governor {
            true => gradient[row] > 0.0,
            false => gradient[row] >= self.params.tau as f32,
        };
        let wanted = (0..now.rows()).filter(|&row| is_wanted(row) && !would_die(row));
        let wanted: Vec<u32> = wanted.map(|row| row as u32).collect();
        let most = match self.params.governor {
            true => self.governed_rows(now.scene, now.step).saturating_sub(now.rows()),
            false => wanted.len(),
        };
        for row in largest(wanted, &gradient, most) {
            let offspring =
                if is_small(row as usize) { clone_at([0.0; 3]) } else { split_by(factor) };
            // A refusal is counted by the plan.
            let _ = plan.grow(row, offspring);
        }

        let is_dead = |row: usize| mortality.is_dead(opacity[row], scale[row]);
        let dead = (0..now.rows() as u32).filter(|&r| plan.is_free(r) && is_dead(r as usize));
        let mut dead: Vec<u32> = dead.collect();
        spare_one(&mut dead, opacity);
        for row in dead {
            let _ = plan.prune(row);
        }
        Ok(())
    }

    fn mortality(&self, now: &Snapshot<'_>) -> Mortality {
        let by_size = now.step > self.params.max_scale_from;
        let max_scale = (self.params.max_scale * f64::from(now.scene.extent)) as f32;
        Mortality {
            min_opacity: self.params.min_opacity as f32,
            max_scale: if by_size { max_scale } else { f32::INFINITY },
        }
    }

    /// Rows that the growth curve allows at the growth event of this step.
    fn governed_rows(&self, scene: &SceneInfo, step: u32) -> usize {
        concave_curve(self.grow, step, scene.initial_rows, scene.budget)
    }
}

#[cfg(test)]
mod tests;
