//! # diet — growth by replacing the least important Gaussians, at a fixed budget
//!
//! Densifies Gaussians with large gradients. At the budget it replaces the least important Gaussians, and
//! later it places new ones at the pixels with the largest errors.
//!
//! Source: *Gaussians on a Diet: High-Quality Memory-Bounded 3D Gaussian Splatting Training*, arXiv
//! 2604.20046. Where the paper and its public code differ, or either is in doubt, the default is the
//! rule that we consider right, and a parameter selects the other rules.
//!
//! ## Method
//!
//! **Growth**, every `grow_every` steps between `grow_from` and `grow_until`. Candidates are
//! Gaussians with g >= `tau`, where g = g_p + `colour_weight` · g_c. g_p and g_c are the norms of the
//! loss gradient with respect to the projected mean (NDC) and to the colour, averaged over the views
//! that saw the Gaussian; a view in which its depth is below `full_depth` is weighted by (depth /
//! `full_depth`)² (as in *Pixel-GS*, Zhang et al. 2024). Gaussians below `min_opacity` are pruned and are never
//! candidates. If there are more candidates than room, the least important Gaussians are evicted: at most `rho`
//! · budget over the whole run, an equal number at each growth step. Then the candidates with the largest g are
//! densified: small ones (up to `small` · scene extent) are cloned, the others split in two (`split`). The
//! remaining candidates are counted as denied, and the gradient statistics are reset.
//!
//! **Eviction** prunes the least important Gaussians that are not candidates. Importance is the
//! largest blend weight α·T over all pixels of the views chosen by `importance`. New Gaussians are
//! protected for an epoch, but at most `protect` steps; if there are not enough others, they are
//! evicted too, the oldest first.
//!
//! **Compensation**, every `insert_every` steps between `compensate_from` and `compensate_until`.
//! Within this window each step collects the pixels of its view with the largest errors, one per
//! `rows_per_candidate` Gaussians, together with the surface points seen there. At each insertion the worst
//! pixels collected since the previous one become new Gaussians with the ground-truth colour: at most
//! `rho_c` · budget over the whole run, an equal number at each insertion. Where there is no room, the
//! least important Gaussians are evicted. The list of collected pixels is then cleared.
//!
//! **Pruning**, every `prune_every` steps until growth and compensation have ended, evicts the Gaussians in excess
//! of the budget. (There are such Gaussians only if the loaded model was too large.)
//!
//! Some defaults differ from paper and code, based on runs of 2,000 to 7,000 steps:
//! `split` is `long-axis`; `full_depth` suppresses floaters that fit a single photograph; `rho` and
//! `rho_c` limit the whole run, as replacing too many Gaussians overfits; and `max_scale` is 0, as
//! pruning by size (0.1 after step `max_scale_from` in paper and code) can remove an entire wall, which
//! is then never replaced. docs/studies has the figures.
//!
//! Each event is one plan in which Gaussians are pruned before new ones take their places, so the budget holds
//! at all times. The published code exceeds it between insertion and the next pruning; this is not
//! reproduced. Opacities are never reset. The published settings also use a learning rate of 0.025 for
//! opacities (`--lr opacity=0.025`), and L1 as the pixel term of the loss (`pixel_loss = "l1"`), where this policy uses
//! Huber's function from 40 training views on, with larger learning rates in runs of fewer than 30,000 iterations
//! (docs/studies/short-runs.tsv).
//!
//! ## Choices
//!
//! - `mixed_gradient = false`: g = 2 g_p, as the published code does (its mixed form is switched off).
//! - `growth = "all"`: every candidate grows as long as there is room or a Gaussian to evict, without the
//!   limit `rho`, as in the paper and the code.
//! - `split`: how a candidate larger than `small` is split.
//!   - `random`: two samples of the parent, with scales divided by `split_factor`, as in `vanilla`.
//!   - `long-axis`: two halves along the parent's longest axis that keep its two ends, with `child_opacity`
//!     times the parent's opacity, as in `igs`. With d = `split_share` they are placed at ±3d standard
//!     deviations; their longest axis is 1 − d times the parent's, the others √(1 − d²) times.
//! - `shift`: the offset of a clone from its parent. Below, Σ sums over the views since the last growth step, dL/dμ is
//!   the loss gradient with respect to the mean, s the parent's largest standard deviation. Splits
//!   are not shifted.
//!   - `descent`: −`kappa` · s · Σ dL/dμ / Σ |dL/dμ|: against the gradient, by at most `kappa` · s, and by
//!     less where the views disagree.
//!   - `paper`: + Σ dL/dμ, the sum over the views: along the gradient, by about 10⁻⁶ of the scene extent.
//!   - `code`: + Σ dL/dμ / n², n the number of views. The code divides the gradient of the last view
//!     by n; here the mean over all views takes the place of that gradient.
//!   - `none`: no shift.
//! - `clone_opacity = "conserve"`: parent and clone both get the opacity o′ = 1 − √(1 − o), and scales
//!   multiplied by o / (2o′ − o′²/√2), so that together they are as opaque as the parent was (*3D
//!   Gaussian Splatting as Markov Chain Monte Carlo*, Kheradmand et al. 2024, equation 9). Both start
//!   with zero moments.
//! - `importance`: the views in which importance is measured.
//!   - `epochs`: the training renders of the previous and the current epoch, at no extra cost.
//!   - `fresh`: `fresh_views` random training views, rendered for each event that may evict, as in the
//!     code. This costs up to a hundred renders per growth step, and a Gaussian visible only in other views
//!     counts as unimportant.
//! - `reinit_at`: at this step the whole model is replaced, as the code does at step 5000 for outdoor
//!   scenes, following Mini-Splatting. All training views are rendered; in each,
//!   ⌊`reinit_share` · budget / views⌋ pixels (at least 1) are drawn without replacement in proportion
//!   to their accumulated alpha. Each becomes a Gaussian with the ground-truth colour at the point where
//!   its ray is closest to the Gaussian with the largest blend weight. Its size is the root mean
//!   square distance to its three nearest neighbours, its opacity is `newborn_opacity`, and its moments and
//!   age are zero. Learning rates and SH degree are unaffected. Nothing else happens at that step.
//! - `error`: `l1-dssim` (0.8 · L1 + 0.2 · (1 − SSIM)), `l1`, or `grad`, the norm of the loss gradient
//!   with respect to the pixel's colour, as in the code; `grad` finds blurred structure but not a constant
//!   colour offset.
//! - `depth`: the surface is the point of the ray closest to one Gaussian: that with the largest blend
//!   weight (`max-weight`), or that at which transmittance falls below one half (`median`).
//! - `nms`: non-maximum suppression; only pixels with the largest error of their 3 × 3 neighbourhood count.
//! - `newborn_size`: the standard deviation of an inserted Gaussian.
//!   - `pixel`: `size_pixels` times the width of the pixel at that depth.
//!   - `code`: the square of the geometric mean, over all Gaussians, of each one's largest standard
//!     deviation. The code does this for each axis; only the longest axis is available here. The result
//!     depends on the unit of length.
//!
//! ## Parameters
//!
//! | name | default | range | unit | meaning |
//! |---|---|---|---|---|
//! | grow_from | 500 | >= 0 | step | start of growth and pruning (exclusive) |
//! | grow_until | 10000 | >= 0 | step | end of growth (exclusive) |
//! | grow_every | 100 | >= 0 | steps | interval of growth; 0: never |
//! | tau | 0.0003 | >= 0 | 1 / NDC | gradient g from which a Gaussian is a candidate |
//! | mixed_gradient | true | | | g = g_p + colour_weight · g_c rather than 2 g_p |
//! | colour_weight | 30.0 | >= 0 | | weight of the colour gradient |
//! | full_depth | 0.8 | >= 0 | scene extent | depth below which a view counts less in g; 0: all count equally |
//! | growth | "turnover" | turnover, all | | how many candidates grow |
//! | rho | 0.25 | >= 0 | budget | maximum number of Gaussians that growth replaces in the whole run |
//! | small | 0.01 | >= 0 | scene extent | Gaussians up to this size are cloned, larger ones split |
//! | split | "long-axis" | random, long-axis | | how a large Gaussian is split |
//! | split_factor | 1.6 | 1 to 100 | | a `random` split divides the scales by this |
//! | split_share | 0.45 | 0 to 1, both excluded | | d of a `long-axis` split |
//! | child_opacity | 0.6 | 0 to 1, 0 excluded | | factor on the opacity in a `long-axis` split |
//! | shift | "descent" | descent, paper, code, none | | offset of clones |
//! | kappa | 0.1 | >= 0 | standard deviations | longest shift of `descent` |
//! | clone_opacity | "unchanged" | unchanged, conserve | | opacity of clones and their parents |
//! | min_opacity | 0.005 | 0 to 1 | | Gaussians below this opacity are pruned at growth steps |
//! | max_scale | 0.0 | >= 0 | scene extent | Gaussians above this size are pruned at growth steps; 0: no limit |
//! | max_scale_from | 3000 | >= 0 | step | start of pruning by size (exclusive) |
//! | importance | "epochs" | epochs, fresh | | views in which importance is measured |
//! | fresh_views | 100 | >= 1 | views | random views per event for `fresh`; all if there are fewer |
//! | protect | 100 | 0 to 65535 | steps | longest protection of new Gaussians; 0: none |
//! | prune_every | 50 | >= 0 | steps | interval of pruning; 0: never |
//! | compensate_from | 10000 | >= 0 | step | start of compensation (exclusive) |
//! | compensate_until | 15000 | >= 0 | step | end of compensation (exclusive) |
//! | insert_every | 500 | >= 0 | steps | interval of insertions; 0: no compensation |
//! | rho_c | 0.1 | >= 0 | budget | maximum number of Gaussians inserted in the whole run; 0: no compensation |
//! | rows_per_candidate | 3000 | >= 1 | Gaussians | Gaussians per pixel that a step collects |
//! | error | "l1-dssim" | l1-dssim, l1, grad | | error that ranks pixels |
//! | depth | "max-weight" | max-weight, median | | surface point on a pixel's ray |
//! | nms | true | | | non-maximum suppression of pixels |
//! | min_alpha | 0.5 | 0 to 1 | | smallest accumulated alpha of a collected pixel |
//! | newborn_size | "pixel" | pixel, code | | size of inserted Gaussians |
//! | size_pixels | 2.0 | > 0 | pixels | size of inserted Gaussians for `pixel` |
//! | newborn_opacity | 0.1 | 0 to 1, both excluded | | opacity of inserted Gaussians |
//! | reinit_at | 0 | >= 0 | step | step at which the whole model is replaced; 0: never |
//! | reinit_share | 0.8 | 0 to 1, 0 excluded | budget | maximum number of Gaussians after the replacement |
//! | pixel_loss | "auto" | auto, l1, huber | | pixel term of the loss; `auto`: `huber` from 40 training views on |
//!
//! ## Ablations
//!
//! Each ingredient can be switched off: the colour gradient with `mixed_gradient = false`, the weighting of
//! near views with `full_depth = 0`, the shift with `shift = "none"`, the error map with
//! `error = "grad"`, the alpha limit with `min_alpha = 0`, the size rule with `newborn_size = "code"`,
//! protection with `protect = 0`, turnover with `rho = 0`, compensation with `rho_c = 0`, spacing with
//! `nms = false`. Re-initialisation is off by default.
//!
//! Defaults in steps are for a run of 30,000 iterations and scale with its length; intervals
//! (`…_every`) do not shrink below 100 steps. `protect` does not scale.

// Long, because more than a third is the manual page, and because growth, compensation and pruning meet in `plan`.

use crate::adc::{
    GROWTH_SIGNALS, PruneLimits, Window, add_colour_gradient, mean_over_views, spare_one,
};
use crate::parameters::StepParameter::{self, Interval, Step};
use crate::plan::{EditPlan, Reset};
use crate::policy::{
    AuxColumn, AuxRequest, AuxView, Candidate, DensityPolicy, Needs, PixelLossChoice, PolicyResult,
    SceneInfo, Signal, SignalSet, Snapshot,
};
use crate::quota::event_quota;
use crate::registry::ConfiguredPolicy;
use crate::rng::PolicyRng;
use crate::sample::largest;

mod compensate;
mod eviction;
mod offspring;
mod parameters;
mod reinit;

pub use parameters::{CloneOpacity, DietParams, Growth, Importance, NewbornSize, Shift, Split};

crate::register_policy!(
    "diet",
    Diet,
    summary: "replaces the least important Gaussians, then adds new ones at the worst pixels",
    source: "Gaussians on a Diet, arXiv 2604.20046",
    doc: include_str!("mod.rs"),
);

/// Growth by replacement and by compensation.
#[derive(Debug)]
pub struct Diet {
    params: DietParams,
    grow: Window,
    prune: Window,
    insert: Window,
    /// Rows younger than this are protected `[steps]`.
    protected_age: f32,
    /// Surface points for the current re-initialisation. Not saved, as they are collected and used in one event.
    surface: Vec<Candidate>,
    /// Largest blend weight of each row in the auxiliary views of the current event. Not saved, as they are
    /// collected and used in one event.
    weight_max: Vec<f32>,
}

impl ConfiguredPolicy for Diet {
    type Params = DietParams;

    const STEP_PARAMETERS: &'static [StepParameter] = &[
        Step("grow_from"),
        Step("grow_until"),
        Interval("grow_every"),
        Step("max_scale_from"),
        Interval("prune_every"),
        Step("compensate_from"),
        Step("compensate_until"),
        Interval("insert_every"),
        Step("reinit_at"),
    ];

    const ADDED_PARAMETERS: &'static [(&'static str, &'static str)] = &[PixelLossChoice::BEFORE];

    fn decided(mut params: DietParams, scene: &SceneInfo) -> DietParams {
        params.pixel_loss = params.pixel_loss.decided(scene.train_views);
        params
    }

    fn new(params: DietParams, scene: &SceneInfo) -> PolicyResult<Self> {
        params.check()?;
        let compensates = params.rho_c > 0.0;
        let DietParams { grow_from, grow_until, grow_every, prune_every, insert_every, .. } =
            params;
        let DietParams { compensate_from: from, compensate_until: until, .. } = params;
        Ok(Self {
            grow: Window { from: grow_from, until: grow_until, every: grow_every },
            prune: Window { until: grow_until.max(until), from: grow_from, every: prune_every },
            insert: Window { from, until, every: if compensates { insert_every } else { 0 } },
            protected_age: params.protect.min(scene.train_views) as f32,
            surface: Vec::new(),
            weight_max: Vec::new(),
            params,
        })
    }
}

impl DensityPolicy for Diet {
    fn needs(&self, scene: &SceneInfo) -> Needs {
        let mut signals = SignalSet::from(GROWTH_SIGNALS);
        if self.params.importance == Importance::Epochs {
            signals = signals.with(Signal::WeightMax);
        }
        if self.params.mixed_gradient {
            signals = signals.with(Signal::ColourGradient);
        }
        if self.params.shift != Shift::None {
            for axis in POSITION_GRADIENT {
                signals = signals.with(axis);
            }
        }
        if self.params.shift == Shift::Descent {
            signals = signals.with(Signal::MeanGradientNorm);
        }
        if self.protected_age > 0.0 {
            signals = signals.with(Signal::Age);
        }
        Needs {
            signals,
            candidates: self.candidate_request(scene),
            full_depth: self.scene_units(self.params.full_depth, scene),
            aux: self.aux_request(scene),
            pixel_loss: self.params.pixel_loss.term(scene.train_views),
            ..Needs::default()
        }
    }

    fn is_due(&self, step: u32) -> bool {
        [self.grow, self.prune, self.insert].iter().any(|window| window.is_due(step))
            || self.is_reinit(step)
    }

    fn aux_views(&self, step: u32, rows: usize, budget: usize) -> u32 {
        if self.is_reinit(step) {
            return u32::MAX;
        }
        // Rows are evicted only if there could be more of them than the budget after growth and
        // insertion.
        let grown = if self.grow.is_due(step) { rows } else { 0 };
        let inserted = event_quota(self.params.rho_c, self.insert, step, budget);
        let evicts = rows + grown + inserted > budget;
        if evicts && self.params.importance == Importance::Fresh {
            self.params.fresh_views
        } else {
            0
        }
    }

    fn observe(&mut self, view: &AuxView<'_>) -> PolicyResult {
        if self.is_reinit(view.step) {
            self.surface.extend_from_slice(view.points);
            return Ok(());
        }
        self.weight_max.resize(view.rows, 0.0);
        for (max, &weight) in self.weight_max.iter_mut().zip(view.column(AuxColumn::WeightMax)?) {
            *max = max.max(weight);
        }
        Ok(())
    }

    fn plan(&mut self, now: &Snapshot<'_>, _rng: &PolicyRng, plan: &mut EditPlan) -> PolicyResult {
        if self.is_reinit(now.step) {
            self.reinit(now.scene.extent, plan);
            return Ok(());
        }
        let mut weight_max = std::mem::take(&mut self.weight_max);
        let importance = match self.params.importance {
            Importance::Epochs => now.signal(Signal::WeightMax)?,
            Importance::Fresh => {
                weight_max.resize(now.rows(), 0.0);
                &weight_max
            }
        };
        let grows = self.grow.is_due(now.step);
        let gradient = if grows { self.gradient(now)? } else { vec![0.0; now.rows()] };
        let mut candidates = Vec::new();
        if grows {
            plan.cause("grow");
            let dead = self.dead(now)?;
            candidates = self.candidates(&gradient, &dead);
            plan.prune_all(dead);
        }
        let rows_left = plan.rows() - plan.pruned();
        if rows_left > plan.budget() {
            plan.cause("prune");
            let excess = rows_left - plan.budget();
            self.evict(now, plan, importance, (excess, &|_| false))?;
            candidates.retain(|&row| plan.is_free(row));
        }
        let is_candidate = |row: u32| grows && gradient[row as usize] >= self.params.tau as f32;
        if grows {
            let without_room = candidates.len().saturating_sub(plan.room());
            let max_evicted = match self.params.growth {
                Growth::Turnover => {
                    event_quota(self.params.rho, self.grow, now.step, plan.budget())
                }
                Growth::All => usize::MAX,
            };
            self.evict(now, plan, importance, (without_room.min(max_evicted), &is_candidate))?;
            for row in candidates {
                // A refusal is counted by the plan.
                let _ = plan.grow(row, self.offspring(now, row as usize)?);
            }
            plan.reset(Reset::Signals);
        }
        if self.insert.is_due(now.step) {
            plan.cause("insert");
            self.insert(now, plan, importance, &is_candidate)?;
            plan.reset(Reset::Candidates);
        }
        Ok(())
    }
}

/// The sum over the views of dL/dμ, the gradient with respect to the mean, axis by axis.
const POSITION_GRADIENT: [Signal; 3] =
    [Signal::MeanGradientX, Signal::MeanGradientY, Signal::MeanGradientZ];

impl Diet {
    /// The measurements in auxiliary views: surface points, weights, both or none.
    fn aux_request(&self, scene: &SceneInfo) -> Option<AuxRequest> {
        let points = self.surface_points(scene);
        let columns = match self.params.importance {
            Importance::Epochs => Vec::new(),
            Importance::Fresh => vec![AuxColumn::WeightMax],
        };
        let needs_views = points > 0 || !columns.is_empty();
        needs_views.then(|| AuxRequest { points, columns, ..AuxRequest::default() })
    }

    /// The gradient g of every row. Shape: `[rows]`.
    fn gradient(&self, now: &Snapshot<'_>) -> PolicyResult<Vec<f32>> {
        let views = now.signal(Signal::VisibleCount)?;
        let mut gradient = mean_over_views(now.signal(Signal::ScreenGradient)?, views);
        if self.params.mixed_gradient {
            add_colour_gradient(&mut gradient, now, self.params.colour_weight as f32)?;
        } else {
            for g in &mut gradient {
                *g *= 2.0;
            }
        }
        Ok(gradient)
    }

    /// The rows below the opacity limit or above the size limit, ascending; never all rows.
    fn dead(&self, now: &Snapshot<'_>) -> PolicyResult<Vec<u32>> {
        let DietParams { min_opacity, max_scale, max_scale_from, .. } = self.params;
        let limits = PruneLimits::at(now, min_opacity, max_scale, max_scale_from);
        let mut dead = limits.dead_rows(now)?;
        spare_one(&mut dead, now.signal(Signal::Opacity)?);
        Ok(dead)
    }

    /// Rows that are not in `dead` and have g >= `tau`, the largest g first.
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
