//! The plain vector: one struct per row and a direct implementation of the documented semantics of plans.

use densify_policies::plan::{
    Decay, MIN_DECAYED_OPACITY, Offspring, OpacityRule, ParentFate, Placement, ScaleRule, Seed,
};
use densify_policies::policy::{Signal, SignalKind, SignalSet};
use densify_policies::rng::{PolicyRng, Purpose};
use glam::{DQuat, DVec3};

use super::calls::Call;
use super::{SEEN, SIGNALS};

/// One row of the plain vector.
#[derive(Debug, Clone)]
pub(super) struct Row {
    pub(super) mean: [f32; 3],
    pub(super) log_scale: [f32; 3],
    pub(super) quat: [f32; 4],
    pub(super) logit: f32,
    pub(super) sh: Vec<f32>,
    pub(super) signals: [f32; SIGNALS.len()],
    /// The row of the unedited twin (see `mod.rs`) that has the moments of this row; `None` if they are zero.
    pub(super) moments: Option<usize>,
    /// True if the moments of the opacity are zero, regardless of the other moments.
    pub(super) opacity_rests: bool,
    /// The first of the SH coefficients whose moments are zero, regardless of the other moments.
    pub(super) sh_rests_from: usize,
    /// True if the opacity has decayed.
    pub(super) has_decayed: bool,
    /// Steps at which the row was created and last edited.
    pub(super) steps: [u32; 2],
}

fn sigmoid(logit: f32) -> f64 {
    1.0 / (1.0 + (-f64::from(logit)).exp())
}

fn logit(opacity: f64) -> f32 {
    (opacity / (1.0 - opacity)).ln() as f32
}

fn longest(log_scale: [f32; 3]) -> usize {
    (1..3).fold(0, |best, axis| if log_scale[axis] > log_scale[best] { axis } else { best })
}

fn to_dquat(quat: [f32; 4]) -> DQuat {
    let [w, x, y, z] = quat.map(f64::from);
    DQuat::from_xyzw(x, y, z, w)
}

fn from_dquat(quat: DQuat) -> [f32; 4] {
    [quat.w, quat.x, quat.y, quat.z].map(|v| v as f32)
}

impl Row {
    fn rescale(&mut self, rule: ScaleRule) {
        let long_axis = longest(self.log_scale);
        for (axis, value) in self.log_scale.iter_mut().enumerate() {
            let factor = match rule {
                ScaleRule::Uniform(factor) => factor,
                ScaleRule::LongAxis { long, .. } if axis == long_axis => long,
                ScaleRule::LongAxis { other, .. } => other,
                ScaleRule::Axes(factors) => factors[axis],
                ScaleRule::Set(scale) => {
                    *value = scale.ln();
                    continue;
                }
            };
            *value = (f64::from(*value) + f64::from(factor).ln()) as f32;
        }
    }

    fn apply_opacity_rule(&mut self, rule: OpacityRule, siblings: u32) {
        let opacity = sigmoid(self.logit);
        self.logit = match rule {
            OpacityRule::Same => return,
            OpacityRule::Set(opacity) => logit(f64::from(opacity)),
            OpacityRule::Scaled(factor) => logit(opacity * f64::from(factor)),
            OpacityRule::Conserved => logit(1.0 - (1.0 - opacity).powf(1.0 / f64::from(siblings))),
        };
    }

    fn decay(&mut self, how: Decay) {
        if how.opacity > 0.0 {
            let least = f64::from(MIN_DECAYED_OPACITY);
            let left = logit((sigmoid(self.logit) - f64::from(how.opacity)).max(least));
            self.logit = self.logit.min(left);
            self.has_decayed = true;
        }
        self.rescale(ScaleRule::Uniform(1.0 - how.scale));
    }

    /// Resets moments and signals (the age is a signal).
    fn newborn(mut self) -> Self {
        self.moments = None;
        self.signals = SIGNALS.map(empty);
        self
    }

    /// The child `number` of this parent, whose index is `row`.
    fn child(&self, row: u32, number: u32, how: &Offspring, rng: &PolicyRng) -> Self {
        let mut child = self.clone().newborn();
        let axis = longest(self.log_scale);
        let offset = match how.placement {
            Placement::Offset(_) if number == 0 => DVec3::ZERO,
            Placement::Offset(offset) => offset.map(f64::from).into(),
            Placement::Sampled => {
                let xi = rng.normal3(row, Purpose::Place, number);
                self.turned(
                    [0, 1, 2].map(|i| f64::from(self.log_scale[i]).exp() * f64::from(xi[i])),
                )
            }
            Placement::LongAxis { sigmas } => {
                let sign = if number.is_multiple_of(2) { 1.0 } else { -1.0 };
                let mut local = [0.0; 3];
                local[axis] = sign * f64::from(sigmas) * f64::from(self.log_scale[axis]).exp();
                self.turned(local)
            }
            Placement::Axes(sigmas) => {
                let sign = if number.is_multiple_of(2) { 1.0 } else { -1.0 };
                let scale = |i: usize| f64::from(self.log_scale[i]).exp();
                self.turned([0, 1, 2].map(|i| sign * f64::from(sigmas[i]) * scale(i)))
            }
        };
        child.mean = [0, 1, 2].map(|i| (f64::from(self.mean[i]) + offset[i]) as f32);
        child.rescale(how.scale);
        child.quat = from_dquat(to_dquat(self.quat) * to_dquat(how.turn).normalize());
        child.apply_opacity_rule(how.opacity, how.siblings());
        child
    }

    fn turned(&self, local: [f64; 3]) -> DVec3 {
        to_dquat(self.quat).normalize() * DVec3::from(local)
    }

    fn paint(&mut self, colour: [f32; 3]) {
        self.sh[..3].copy_from_slice(&colour.map(|c| (c - 0.5) / densify::core::sh::C0));
    }

    fn from_seed(seed: &Seed) -> Self {
        let mut sown = Self {
            mean: seed.position,
            log_scale: seed.scales.map(f32::ln),
            quat: from_dquat(to_dquat(seed.orientation).normalize()),
            logit: logit(f64::from(seed.opacity)),
            sh: vec![0.0; 12],
            signals: SIGNALS.map(empty),
            moments: None,
            opacity_rests: false,
            sh_rests_from: usize::MAX,
            has_decayed: false,
            steps: [0; 2],
        };
        sown.paint(seed.colour);
        sown
    }
}

/// The initial value of a signal.
fn empty(signal: Signal) -> f32 {
    if signal.kind() == SignalKind::Minimum { f32::INFINITY } else { 0.0 }
}

/// Applies the accepted calls of one event to the plain vector.
pub(super) fn execute(
    model: Vec<Row>,
    calls: &[Call],
    budget: usize,
    (rng, step): (&PolicyRng, u32),
) -> Vec<Row> {
    let before = model;
    let new = |row: Row| Row { steps: [step; 2], ..row };
    let mut slots: Vec<Option<Row>> = before.iter().cloned().map(Some).collect();
    let mut children: Vec<Vec<Row>> = vec![Vec::new(); before.len()];
    let mut seeds = Vec::new();
    let mut clamp = f32::INFINITY;
    let mut decay = None;
    let mut reset = SignalSet::default();
    for call in calls {
        match call {
            Call::Prune(row) => slots[*row as usize] = None,
            Call::Grow(row, how) => {
                let parent = &before[*row as usize];
                children[*row as usize] =
                    (1..=how.children).map(|n| new(parent.child(*row, n, how, rng))).collect();
                if how.parent == ParentFate::BecomesChild {
                    slots[*row as usize] = Some(new(parent.child(*row, 0, how, rng)));
                }
            }
            Call::Update(row, how) => {
                let mut updated = before[*row as usize].clone();
                updated.steps[1] = step;
                updated.rescale(how.scale);
                updated.apply_opacity_rule(how.opacity, 1);
                if let Some(degree) = how.sh_degree {
                    let kept = 3 * (usize::from(degree) + 1).pow(2);
                    updated.sh.iter_mut().skip(kept).for_each(|coefficient| *coefficient = 0.0);
                    updated.sh_rests_from = updated.sh_rests_from.min(kept);
                }
                updated.mean = how.position.unwrap_or(updated.mean);
                if let Some(colour) = how.colour {
                    updated.paint(colour);
                }
                slots[*row as usize] =
                    Some(if how.keep_moments { updated } else { updated.newborn() });
            }
            Call::Append(seed) => seeds.push(new(Row::from_seed(seed))),
            Call::Decay(how) => decay = Some(*how),
            Call::Clamp(max) => clamp = clamp.min(*max),
            Call::Reset(signals) => {
                reset = reset.union(signals.unwrap_or_else(|| Signal::ALL.into()));
            }
        }
    }
    let rows_with_children = slots.into_iter().zip(children);
    let mut model: Vec<Row> =
        rows_with_children.flat_map(|(row, children)| row.into_iter().chain(children)).collect();
    model.extend(seeds);
    assert!(model.len() <= budget, "{} rows, budget {budget}", model.len());
    for row in &mut model {
        if let Some(how) = decay.filter(|how| !how.seen_only || row.signals[SEEN] > 0.0) {
            row.decay(how);
        }
        if clamp < 1.0 {
            row.logit = row.logit.min(logit(f64::from(clamp)));
            row.opacity_rests = true;
        }
        for (signal, value) in SIGNALS.into_iter().zip(&mut row.signals) {
            if signal.is_resettable() && reset.contains(signal) {
                *value = empty(signal);
            }
        }
    }
    model
}
