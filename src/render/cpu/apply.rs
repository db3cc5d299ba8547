//! Stage 9: executes a compiled plan in place. No other code changes the number of rows.

use std::ops::Range;

use densify_policies::plan::{
    Decay, MIN_DECAYED_OPACITY, NO_ROTATION, Offspring, OpacityRule, ParentFate, Placement, RowOps,
    ScaleRule, Seed,
};
use densify_policies::policy::Signal;
use densify_policies::rng::{PolicyRng, Purpose};

use super::blocks::{Blocks, RowEdit, plane, planes};
use super::mask::Masks;
use super::moments::Moments;
use super::parameters::Parameters;
use super::signals::Accumulators;
use super::summed::GradientSums;
use super::threads::Threads;
use densify_core::gaussians::{logit, rgb_to_dc, sigmoid};

/// The buffers that an edit changes together.
pub(super) struct Model<'a> {
    pub(super) params: &'a mut Parameters,
    pub(super) moments: &'a mut Moments,
    pub(super) ages: &'a mut Blocks<u16>,
    pub(super) masks: &'a mut Masks,
    pub(super) signals: &'a mut Accumulators,
    pub(super) summed: &'a mut GradientSums,
    pub(super) threads: &'a Threads,
}

/// Executes `ops`; the order and the invariants are those of [`RowOps`].
pub(super) fn apply(model: &mut Model<'_>, ops: &RowOps, rng: &PolicyRng) {
    for family in &ops.families {
        model.write_family(family.parent, &ops.offspring(family), ops.children(family), rng);
    }
    for &(row, update) in &ops.updates {
        let row = row as usize;
        let scales = scales_of(model.params.get_n(row, plane::LOG_SCALE), update.scale);
        model.params.set_n(row, plane::LOG_SCALE, scales);
        model.set_opacity(row, update.opacity, 1);
        if let Some(position) = update.position {
            model.params.set_n(row, plane::MEAN, position);
        }
        if let Some(colour) = update.colour {
            model.params.set_n(row, plane::SH, colour.map(rgb_to_dc));
        }
        if let Some(degree) = update.sh_degree {
            model.drop_bands(row, degree);
        }
        if !update.keep_moments {
            model.reset_row(row);
        }
    }
    for &(row, seed) in &ops.seeds {
        model.insert(row as usize, &seed);
    }
    for &(from, to) in &ops.moves {
        model.edit_rows(RowEdit::Copy(from as usize, to as usize));
    }
    model.edit_rows(RowEdit::Reorder(&ops.order()));
    if let Some(decay) = ops.decay {
        model.decay(decay, ops.first_row..ops.rows_after);
    }
    if let Some(most) = ops.clamp_opacity {
        for row in ops.first_row..ops.rows_after {
            let clamped = model.params.get(row, plane::OPACITY).min(logit(most));
            model.params.set(row, plane::OPACITY, clamped);
            model.moments.reset(row, plane::OPACITY);
            model.summed.reset(row, plane::OPACITY);
        }
    }
    model.signals.reset(ops.reset_signals, model.threads, ops.rows_after);
}

impl Model<'_> {
    /// Writes a family: the children of a parent, then the parent itself if it becomes child 0.
    fn write_family(&mut self, row: u32, offspring: &Offspring, children: &[u32], rng: &PolicyRng) {
        let parent = row as usize;
        let mean: [f32; 3] = self.params.get_n(parent, plane::MEAN);
        let log_scale: [f32; 3] = self.params.get_n(parent, plane::LOG_SCALE);
        let quat: [f32; 4] = self.params.get_n(parent, plane::QUAT);
        let scales = scales_of(log_scale, offspring.scale);
        let rotated = rotated(quat, offspring.turn);
        let siblings = offspring.siblings();
        let position = |child: u32| -> [f32; 3] {
            let offset = match offspring.placement {
                Placement::Offset(_) if child == 0 => [0.0; 3],
                Placement::Offset(offset) => offset,
                Placement::Sampled => {
                    let xi = rng.normal3(row, Purpose::Place, child);
                    let local = [0, 1, 2].map(|i| log_scale[i].exp() * xi[i]);
                    rotate(quat, local)
                }
                Placement::LongAxis { sigmas } => {
                    let long = longest(log_scale);
                    let mut local = [0.0; 3];
                    let sign = if child.is_multiple_of(2) { 1.0 } else { -1.0 };
                    local[long] = sign * sigmas * log_scale[long].exp();
                    rotate(quat, local)
                }
                Placement::Axes(sigmas) => {
                    let sign = if child.is_multiple_of(2) { 1.0 } else { -1.0 };
                    rotate(quat, [0, 1, 2].map(|i| sign * sigmas[i] * log_scale[i].exp()))
                }
            };
            [0, 1, 2].map(|i| mean[i] + offset[i])
        };
        let rewrite = |model: &mut Self, to: usize, child: u32| {
            model.params.set_n(to, plane::MEAN, position(child));
            model.params.set_n(to, plane::LOG_SCALE, scales);
            model.params.set_n(to, plane::QUAT, rotated);
            model.set_opacity(to, offspring.opacity, siblings);
            model.reset_row(to);
        };
        for (child, &to) in (1..).zip(children) {
            let to = to as usize;
            self.params.edit(RowEdit::Copy(parent, to));
            self.masks.inherit(parent, to);
            rewrite(self, to, child);
        }
        if offspring.parent == ParentFate::BecomesChild {
            rewrite(self, parent, 0);
        }
    }

    /// Writes a new row that has no parent.
    fn insert(&mut self, row: usize, seed: &Seed) {
        self.params.edit(RowEdit::Clear(row));
        self.masks.edit(RowEdit::Clear(row));
        self.params.set_n(row, plane::MEAN, seed.position);
        self.params.set_n(row, plane::LOG_SCALE, seed.scales.map(f32::ln));
        self.params.set_n(row, plane::QUAT, rotated(NO_ROTATION, seed.orientation));
        self.params.set(row, plane::OPACITY, logit(seed.opacity));
        self.params.set_n(row, plane::SH, seed.colour.map(rgb_to_dc));
        self.reset_row(row);
    }

    fn set_opacity(&mut self, row: usize, rule: OpacityRule, siblings: u32) {
        let old = self.params.get(row, plane::OPACITY);
        let opacity = sigmoid(old);
        let logit = match rule {
            OpacityRule::Same => old,
            OpacityRule::Set(o) => logit(o),
            OpacityRule::Scaled(factor) => logit(opacity * factor),
            // 1 − o is computed from the logit, so that it does not round to 0.
            OpacityRule::Conserved => logit(1.0 - sigmoid(-old).powf(1.0 / siblings.max(1) as f32)),
        };
        self.params.set(row, plane::OPACITY, logit);
    }

    /// Clears the SH bands above a degree, and their moments.
    fn drop_bands(&mut self, row: usize, degree: u8) {
        for plane in planes(degree)..self.params.planes() {
            self.params.set(row, plane, 0.0);
            self.moments.reset(row, plane);
            self.summed.reset(row, plane);
        }
    }

    fn decay(&mut self, decay: Decay, rows: Range<usize>) {
        let seen = self.signals.planes.current(Signal::VisibleCount);
        let log_factor = (1.0 - decay.scale).ln();
        for row in rows {
            let was_seen = seen.is_some_and(|plane| self.signals.blocks.get(row, plane) > 0.0);
            if decay.seen_only && !was_seen {
                continue;
            }
            let old = self.params.get(row, plane::OPACITY);
            // Non-finite numbers are left to the audit, and a decay of 0 must leave every bit unchanged.
            if decay.opacity > 0.0 && old.is_finite() {
                let opacity = sigmoid(old);
                let decayed = (opacity - decay.opacity).max(MIN_DECAYED_OPACITY);
                // 1 − o is computed from the logit, so that nothing cancels.
                let transparency = sigmoid(-old) + (opacity - decayed);
                self.params.set(row, plane::OPACITY, old.min((decayed / transparency).ln()));
            }
            if decay.scale > 0.0 {
                let scales = self.params.get_n::<3>(row, plane::LOG_SCALE).map(|x| x + log_factor);
                self.params.set_n(row, plane::LOG_SCALE, scales);
            }
        }
    }

    /// Resets a row's moments, age, signals and summed gradients.
    fn reset_row(&mut self, row: usize) {
        self.masks.reset_moments(row);
        self.edit_training_state(RowEdit::Clear(row));
    }

    /// Edits rows of all arrays.
    fn edit_rows(&mut self, edit: RowEdit<'_>) {
        self.params.edit(edit);
        self.masks.edit(edit);
        self.edit_training_state(edit);
    }

    fn edit_training_state(&mut self, edit: RowEdit<'_>) {
        self.moments.edit(edit);
        self.ages.edit(edit);
        self.signals.blocks.edit(edit);
        self.summed.edit(edit);
    }
}

fn longest(log_scale: [f32; 3]) -> usize {
    (1..3).fold(0, |best, i| if log_scale[i] > log_scale[best] { i } else { best })
}

fn scales_of(log_scale: [f32; 3], rule: ScaleRule) -> [f32; 3] {
    match rule {
        // A factor of 1 must leave every bit unchanged.
        ScaleRule::Uniform(factor) => log_scale.map(|x| x + factor.ln()),
        ScaleRule::LongAxis { long, other } => {
            let longest = longest(log_scale);
            let mut scales = log_scale.map(|x| x + other.ln());
            scales[longest] = log_scale[longest] + long.ln();
            scales
        }
        ScaleRule::Axes(factors) => [0, 1, 2].map(|i| log_scale[i] + factors[i].ln()),
        ScaleRule::Set(scale) => [scale.ln(); 3],
    }
}

fn quaternion([w, x, y, z]: [f32; 4]) -> glam::Quat {
    glam::Quat::from_xyzw(x, y, z, w)
}

/// Rotates an orientation about its own axes; the length of the quaternion is preserved.
fn rotated(quat: [f32; 4], turn: [f32; 4]) -> [f32; 4] {
    // The identity must leave every bit unchanged.
    if turn.map(f32::to_bits) == NO_ROTATION.map(f32::to_bits) {
        return quat;
    }
    let [x, y, z, w] = (quaternion(quat) * quaternion(turn).normalize()).to_array();
    [w, x, y, z]
}

/// R(q)·v for a quaternion (w, x, y, z) of any length but 0.
fn rotate(quat: [f32; 4], v: [f32; 3]) -> [f32; 3] {
    (quaternion(quat).normalize() * glam::Vec3::from(v)).to_array()
}
