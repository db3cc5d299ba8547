//! # diet — growth by turnover and by compensation, at a fixed budget
//!
//! *Gaussians on a Diet: High-Quality Memory-Bounded 3D Gaussian Splatting Training*,
//! arXiv 2604.20046. Where the paper and its public code differ, or either is in doubt, the default
//! is the rule that we hold to be right, and the others are named choices.
//!
//! ## What it does
//!
//! **Growth**, every `grow_every` steps between `grow_from` and `grow_until`. Candidates are rows
//! with g >= `tau`, where g = g_p + `colour_weight` · g_c; g_p and g_c are the means, over the
//! views that saw the row, of the norms of the loss gradient by its mean on screen (NDC) and by its
//! colour; a view from which the row is nearer than `full_depth` counts in them by the square of
//! the ratio (as in *Pixel-GS*, Zhang et al. 2024). Dead rows (less opaque than `min_opacity`) are
//! pruned; they are no candidates. If there are more candidates than room, some are paid for by as
//! many victims, in all growths together up to `rho` · budget, in each an equal part of it. Then
//! the candidates grow, the largest g first: small ones (up to `small` · scene extent) are cloned,
//! the others split in two (`split`). What is left over counts as denied; statistics start anew.
//!
//! **Victims** are the least important rows, candidates excepted: those whose largest blend weight
//! α·T, over all pixels of the views of `importance`, is smallest. Newborns are protected until
//! they are as old as an epoch is long, or `protect` steps if that is less. If there are not enough
//! others, newborns fall too, the oldest first.
//!
//! **Compensation**, every `insert_every` steps between `compensate_from` and `compensate_until`:
//! during the window each step collects the pixels of its view with the largest error, one per
//! `rows_per_candidate` rows, with the point of the surface that they show. The worst of those
//! collected since the last insertion become new rows of the pixel's ground-truth colour, in all
//! insertions together up to `rho_c` · budget, in each an equal part; if there is no room, victims
//! make it. The list then starts anew.
//!
//! **Pruning**, every `prune_every` steps until both have ended: rows above the budget are pruned,
//! the least important first. (There are none, unless a model was loaded that is too large.)
//!
//! Some defaults are not those of paper and code, by measurement in runs of 2,000 to 7,000 steps:
//! `split` is `long-axis`; `full_depth` keeps out fog that explains single photographs; `rho` and
//! `rho_c` are for the whole run, as who exchanges the model many times over learns photographs by
//! heart; `max_scale` is 0, as paper and code (0.1, after step `max_scale_from`) prune what may be all
//! that there is of a wall, and nothing takes its place. docs/comparison.md has the figures.
//!
//! Each event is one plan: pruned rows free their slots before others are born, so that the budget
//! holds at every instant. The published code overshoots it between insertion and the next pruning;
//! this is not offered. Opacities are never reset. The published settings also use a learning rate
//! of 0.025 for opacities, which is the trainer's to set.
//!
//! ## Choices
//!
//! - `mixed_gradient = false`: g = 2 g_p, as the code runs (its mixed form is switched off there).
//! - `growth = "all"`: every candidate grows for which there is room or a victim, without the bound
//!   `rho`, as in the paper and the code.
//! - `split`: what becomes of a candidate that is larger than `small`.
//!   - `random`: two samples of the parent, smaller by `split_factor`, as in the original.
//!   - `long-axis`: two halves along the parent's longest axis, whose ends stay where they were, with
//!     `child_opacity` times its opacity, as `igs` does. With d = `split_share` they stand at ±3d
//!     standard deviations; their longest axis is 1 − d times the parent's, the others √(1 − d²).
//! - `shift`: how far a clone stands from its parent, Σ over the views since the last growth, dL/dμ
//!   the loss gradient by the mean, s the parent's largest standard deviation. Splits are not
//!   shifted: their samples are apart already.
//!   - `descent`: −`kappa` · s · Σ dL/dμ / Σ |dL/dμ|: downhill, no farther than `kappa` · s, and
//!     less the less the views agree.
//!   - `paper`: + Σ dL/dμ, the sum over the views. Uphill, and about 10⁻⁶ of the scene.
//!   - `code`: + Σ dL/dμ / n², n the number of views. The code divides the gradient of the last view
//!     by n; signals keep sums only, so the mean of all views stands for the last one.
//!   - `none`: no shift.
//! - `clone_opacity = "conserve"`: parent and clone both get 1 − √(1 − o), and scales multiplied by
//!   o / (2o′ − o′²/√2), so that together they are as opaque as the parent was (*3D Gaussian Splatting
//!   as Markov Chain Monte Carlo*, Kheradmand et al. 2024, equation 9). Both start with zero moments.
//! - `importance`: the views in which the importance of a row is measured.
//!   - `epochs`: the training renders of the previous and the current epoch, free of cost.
//!   - `fresh`: `fresh_views` training views, drawn at random and rendered anew for each event at
//!     which victims may be needed, as in the code. It costs so many passes, up to a hundred for
//!     each growth, and a row that only other views show counts as unimportant.
//! - `reinit_at`: at this step, which may be any, the whole model is replaced, as the code does at
//!   step 5000 of outdoor scenes (after Mini-Splatting). All training views are rendered; in each,
//!   ⌊`reinit_share` · budget / views⌋ pixels (at least 1) are drawn without replacement in proportion
//!   to their accumulated alpha; each becomes a row of the pixel's ground-truth colour, where its ray
//!   passes most closely by the Gaussian with the largest blend weight there. Its size is the root mean
//!   square distance to its three nearest neighbours, its opacity `newborn_opacity`; moments and age
//!   are zero. Learning rates and spherical-harmonic degree go on. Nothing else happens at that step.
//! - `error`: `l1-dssim` (0.8 · L1 + 0.2 · (1 − SSIM)), `l1`, or `grad`, the norm of the loss gradient
//!   by the pixel's colour, as in the code: it ranks blurred structure and is blind to a constant
//!   offset of colour.
//! - `depth`: `max-weight`, the Gaussian with the largest blend weight in the pixel, or `median`, the one
//!   at which half of the light is used up; in both, where the ray passes it most closely.
//! - `nms`: whether only pixels whose error is the largest of their 3 × 3 neighbours count.
//! - `newborn_size`: the standard deviation of an inserted row.
//!   - `pixel`: `size_pixels` times the width of the pixel at that depth.
//!   - `code`: (geometric mean of the largest standard deviation of all rows)². The code squares the
//!     mean of each axis; signals carry the largest one only. Depends on the unit of length.
//!
//! ## Parameters
//!
//! | name | default | range | unit | what |
//! |---|---|---|---|---|
//! | grow_from | 500 | >= 0 | step | start of growth and pruning (exclusive) |
//! | grow_until | 10000 | >= 0 | step | end of growth (exclusive) |
//! | grow_every | 100 | >= 0 | steps | interval of growth; 0: never |
//! | tau | 0.0003 | >= 0 | 1 / NDC | gradient from which a row grows |
//! | mixed_gradient | true | | | g = g_p + colour_weight · g_c rather than 2 g_p |
//! | colour_weight | 30.0 | >= 0 | | weight of the colour gradient |
//! | full_depth | 0.8 | >= 0 | scene extent | nearer views of a row count less in g; 0: all in full |
//! | growth | "turnover" | turnover, all | | how many candidates grow |
//! | rho | 0.25 | >= 0 | budget | most rows that all growths exchange |
//! | small | 0.01 | >= 0 | scene extent | up to this size a row is cloned, beyond it split |
//! | split | "long-axis" | random, long-axis | | how a large row is split |
//! | split_factor | 1.6 | 1 to 100 | | by which a split divides the scales, for `random` |
//! | split_share | 0.45 | 0 to 1, both excluded | | d of the split, for `long-axis` |
//! | child_opacity | 0.6 | 0 to 1, 0 excluded | | factor of the children's opacity, for `long-axis` |
//! | shift | "descent" | descent, paper, code, none | | where clones stand |
//! | kappa | 0.1 | >= 0 | standard deviations | longest shift of `descent` |
//! | clone_opacity | "unchanged" | unchanged, conserve | | opacity of clones and their parents |
//! | min_opacity | 0.005 | 0 to 1 | | opacity below which a row is dead |
//! | max_scale | 0.0 | >= 0 | scene extent | size beyond which a row is dead; 0: none |
//! | max_scale_from | 3000 | >= 0 | step | start of pruning by size (exclusive) |
//! | importance | "epochs" | epochs, fresh | | views in which the importance of a row is measured |
//! | fresh_views | 100 | >= 1 | views | random views per event, for `fresh`; all if there are fewer |
//! | protect | 100 | >= 0 | steps | longest protection of newborns; 0: none |
//! | prune_every | 50 | >= 0 | steps | interval of pruning; 0: never |
//! | compensate_from | 10000 | >= 0 | step | start of compensation (exclusive) |
//! | compensate_until | 15000 | >= 0 | step | end of compensation (exclusive) |
//! | insert_every | 500 | >= 0 | steps | interval of insertions; 0: no compensation |
//! | rho_c | 0.1 | >= 0 | budget | most rows that all insertions add; 0: no compensation |
//! | rows_per_candidate | 3000 | >= 1 | rows | one candidate pixel per step for so many rows |
//! | error | "l1-dssim" | l1-dssim, l1, grad | | what makes a pixel a bad one |
//! | depth | "max-weight" | max-weight, median | | where on a pixel's ray the surface is |
//! | nms | true | | | whether neighbouring pixels exclude each other |
//! | min_alpha | 0.5 | 0 to 1 | | least accumulated alpha of a candidate pixel |
//! | newborn_size | "pixel" | pixel, code | | size of inserted rows |
//! | size_pixels | 2.0 | > 0 | pixels | size of inserted rows, for `pixel` |
//! | newborn_opacity | 0.1 | 0 to 1, both excluded | | opacity of inserted rows |
//! | reinit_at | 0 | >= 0 | step | replacement of the whole model; 0: never |
//! | reinit_share | 0.8 | 0 to 1, 0 excluded | budget | most rows after it |
//!
//! ## Switching ingredients off
//!
//! For an ablation, each ingredient has a value without it: the colour gradient
//! `mixed_gradient = false`, the weighing of depths `full_depth = 0`, the shift `shift = "none"`, the error map `error = "grad"`, the guard of
//! depths `min_alpha = 0`, the size rule `newborn_size = "code"`, the protection of newborns
//! `protect = 0`, exact importance `importance = "epochs"` (the default), turnover `rho = 0`,
//! compensation `rho_c = 0`, spacing `nms = false`, re-initialisation `reinit_at = 0` (the default).
//!
//! Defaults that are steps are for runs of 30,000 and scale with the length, intervals (`…_every`)
//! down to 100 at most, and `protect`, which counts views, not at all.

use crate::adc::{Mortality, Window, mean_over_views, spare_one};
use crate::plan::{EditPlan, Reset};
use crate::policy::{
    AuxView, Candidate, DensityPolicy, Needs, PolicyError, PolicyState, SceneInfo, Signal,
    SignalSet, Snapshot, restore_nothing,
};
use crate::registry::ConfiguredPolicy;
use crate::rng::PolicyRng;
use crate::sample::largest;
use shares::part;

mod compensate;
mod offspring;
mod parameters;
mod reinit;
mod shares;
mod victims;

pub use parameters::{CloneOpacity, DietParams, Growth, Importance, NewbornSize, Shift, Split};

crate::register_policy!(
    "diet",
    Diet,
    summary: "growth by turnover of the least important rows, then compensation of the worst pixels",
    source: "Gaussians on a Diet, arXiv 2604.20046",
    doc: include_str!("diet.rs"),
);

/// Growth by turnover and by compensation.
#[derive(Debug)]
pub struct Diet {
    params: DietParams,
    grow: Window,
    prune: Window,
    insert: Window,
    /// Age below which a row is protected `[steps]`.
    protected_age: f32,
    /// Surface points of the re-initialisation at hand. No state: they are gone with the event.
    surface: Vec<Candidate>,
}

impl ConfiguredPolicy for Diet {
    type Params = DietParams;

    const STEP_PARAMETERS: &'static [&'static str] = &[
        "grow_from",
        "grow_until",
        "grow_every",
        "max_scale_from",
        "prune_every",
        "compensate_from",
        "compensate_until",
        "insert_every",
        "reinit_at",
    ];

    fn new(params: DietParams, scene: &SceneInfo) -> Result<Self, PolicyError> {
        params.check()?;
        let compensates = params.rho_c > 0.0;
        Ok(Self {
            grow: Window {
                from: params.grow_from,
                until: params.grow_until,
                every: params.grow_every,
            },
            prune: Window {
                from: params.grow_from,
                until: params.grow_until.max(params.compensate_until),
                every: params.prune_every,
            },
            insert: Window {
                from: params.compensate_from,
                until: params.compensate_until,
                every: if compensates { params.insert_every } else { 0 },
            },
            protected_age: params.protect.min(scene.train_views) as f32,
            surface: Vec::new(),
            params,
        })
    }
}

impl DensityPolicy for Diet {
    fn needs(&self, scene: &SceneInfo) -> Needs {
        let mut signals = SignalSet::of(&[
            Signal::VisibleCount,
            Signal::ScreenGradient,
            Signal::Opacity,
            Signal::ScaleMax,
            self.importance(),
        ]);
        if self.params.mixed_gradient {
            signals = signals.with(Signal::ColourGradient);
        }
        if self.params.shift != Shift::None {
            for axis in MEAN_GRADIENT {
                signals = signals.with(axis);
            }
        }
        if self.params.shift == Shift::Descent {
            signals = signals.with(Signal::MeanGradientNorm);
        }
        if self.protected_age > 0.0 {
            signals = signals.with(Signal::Age);
        }
        let fresh_views = match self.params.importance {
            Importance::Epochs => 0,
            Importance::Fresh => self.params.fresh_views,
        };
        Needs {
            signals,
            candidates: self.candidate_request(scene),
            fresh_views,
            full_depth: self.scene_units(self.params.full_depth, scene),
            aux: self.surface_request(scene),
            ..Needs::default()
        }
    }

    fn is_due(&self, step: u32) -> bool {
        [self.grow, self.prune, self.insert].iter().any(|window| window.is_due(step))
            || self.replaces_at(step)
    }

    /// Victims fall only where rows, those that may grow and those that may be inserted are
    /// together more than the budget.
    fn wants_fresh(&self, step: u32, rows: usize, budget: usize) -> bool {
        if self.replaces_at(step) {
            return false;
        }
        let grown = if self.grow.is_due(step) { rows } else { 0 };
        let inserted = part(self.params.rho_c, self.insert, step, budget);
        rows + grown + inserted > budget
    }

    fn aux_views(&self, step: u32, _rows: usize, _budget: usize) -> u32 {
        if self.replaces_at(step) { u32::MAX } else { 0 }
    }

    fn observe(&mut self, view: &AuxView<'_>) -> Result<(), PolicyError> {
        self.surface.extend_from_slice(view.points);
        Ok(())
    }

    fn plan(
        &mut self,
        now: &Snapshot<'_>,
        _rng: &PolicyRng,
        plan: &mut EditPlan,
    ) -> Result<(), PolicyError> {
        if self.replaces_at(now.step) {
            self.replace(now.scene.extent, plan);
            return Ok(());
        }
        let grows = self.grow.is_due(now.step);
        let gradient = if grows { self.gradient(now)? } else { vec![0.0; now.rows()] };
        let mut candidates = Vec::new();
        if grows {
            plan.cause("grow");
            let dead = self.dead(now)?;
            candidates = self.candidates(&gradient, &dead);
            for row in dead {
                // Here and below, a refusal is counted by the plan.
                let _ = plan.prune(row);
            }
        }
        let rows_left = plan.rows() - plan.pruned();
        if rows_left > plan.budget() {
            plan.cause("prune");
            let excess = rows_left - plan.budget();
            self.prune_victims(now, plan, excess, &|_| false)?;
            candidates.retain(|&row| plan.is_free(row));
        }
        let is_candidate = |row: u32| grows && gradient[row as usize] >= self.params.tau as f32;
        if grows {
            let beyond = candidates.len().saturating_sub(plan.room());
            let most = match self.params.growth {
                Growth::Turnover => part(self.params.rho, self.grow, now.step, plan.budget()),
                Growth::All => usize::MAX,
            };
            self.prune_victims(now, plan, beyond.min(most), &is_candidate)?;
            for row in candidates {
                let _ = plan.grow(row, self.offspring(now, row as usize)?);
            }
            plan.reset(Reset::Signals);
        }
        if self.insert.is_due(now.step) {
            plan.cause("insert");
            self.insert(now, plan, &is_candidate)?;
            plan.reset(Reset::Candidates);
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

const MEAN_GRADIENT: [Signal; 3] =
    [Signal::MeanGradientX, Signal::MeanGradientY, Signal::MeanGradientZ];

impl Diet {
    /// g of every row. Shape: `[rows]`.
    fn gradient(&self, now: &Snapshot<'_>) -> Result<Vec<f32>, PolicyError> {
        let views = now.signal(Signal::VisibleCount)?;
        let mut gradient = mean_over_views(now.signal(Signal::ScreenGradient)?, views);
        if self.params.mixed_gradient {
            let colour = mean_over_views(now.signal(Signal::ColourGradient)?, views);
            let weight = self.params.colour_weight as f32;
            for (g, c) in gradient.iter_mut().zip(colour) {
                *g += weight * c;
            }
        } else {
            for g in &mut gradient {
                *g *= 2.0;
            }
        }
        Ok(gradient)
    }

    /// The dead rows, ascending; never all of them.
    fn dead(&self, now: &Snapshot<'_>) -> Result<Vec<u32>, PolicyError> {
        let opacity = now.signal(Signal::Opacity)?;
        let scale = now.signal(Signal::ScaleMax)?;
        let by_size = self.params.max_scale > 0.0 && now.step > self.params.max_scale_from;
        let max_scale = self.scene_units(self.params.max_scale, now.scene);
        let mortality = Mortality {
            min_opacity: self.params.min_opacity as f32,
            max_scale: if by_size { max_scale } else { f32::INFINITY },
        };
        let is_dead = |row: usize| mortality.is_dead(opacity[row], scale[row]);
        let dead = (0..now.rows()).filter(|&row| is_dead(row)).map(|row| row as u32);
        let mut dead = dead.collect();
        spare_one(&mut dead, opacity);
        Ok(dead)
    }

    /// Living rows with g >= tau, the largest g first.
    fn candidates(&self, gradient: &[f32], dead: &[u32]) -> Vec<u32> {
        let tau = self.params.tau as f32;
        let rows = (0..gradient.len() as u32)
            .filter(|&row| gradient[row as usize] >= tau && dead.binary_search(&row).is_err());
        largest(rows.collect(), gradient, gradient.len())
    }

    fn scene_units(&self, fraction: f64, scene: &SceneInfo) -> f32 {
        (fraction * f64::from(scene.extent)) as f32
    }
}

#[cfg(test)]
mod tests;
