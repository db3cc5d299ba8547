//! Stage 7: Adam (Kingma and Ba 2015, algorithm 1). Each row's bias is corrected by its own age, the number of its
//! steps.
//!
//! A new row starts with zero moments and age 0, so that its first step has the length of one learning rate. With
//! the shared step counter of other implementations it would have 3.2 times that length
//! (√((1 − β₁)²/(1 − β₂))).
//!
//! After the step, parameters are confined to a range in which the renderer's arithmetic is safe: unit
//! quaternions, and opacities and scales beyond which nothing visible changes.

use std::ops::Range;

use pulp::Simd;

use super::blocks::plane;
use super::simd::{V, WIDTH, each};
use crate::LearningRates;

pub(super) const BETA1: f32 = 0.9;
pub(super) const BETA2: f32 = 0.999;
pub(super) const EPSILON: f32 = 1e-15;
/// Keeps opacities 1e-4 away from 0 and 1, where their gradient still has full precision.
pub(super) const LOGIT_MAX: f32 = 9.2;
/// Allows standard deviations from 1e-6 to 10 times the scene's size; scenes are normalised to size 1.
const LOG_SCALE_RANGE: [f32; 2] = [-13.8, 2.3];
/// The age from which 1 − 0.999^age is 1 in f32: ln(2⁻²⁵)/ln(0.999) = 17,320.
const MATURE: usize = 17_400;

/// 1/(1 − β₁^age) and √(1/(1 − β₂^age)), by age.
#[derive(Debug)]
pub(crate) struct BiasCorrection {
    pub(crate) table: Vec<[f32; 2]>,
}

impl BiasCorrection {
    pub(crate) fn new() -> Self {
        let table = (0..=MATURE as i32)
            .map(|age| {
                let age = age.max(1);
                let first = 1.0 / (1.0 - f64::from(BETA1).powi(age));
                let second = 1.0 / (1.0 - f64::from(BETA2).powi(age));
                [first as f32, second.sqrt() as f32]
            })
            .collect();
        Self { table }
    }

    pub(crate) fn bytes() -> u64 {
        ((MATURE + 1) * size_of::<[f32; 2]>()) as u64
    }

    pub(super) fn at(&self, age: u16) -> [f32; 2] {
        self.table[usize::from(age).min(MATURE)]
    }
}

/// The learning rate of plane `p`: the parameter with index `p` of every row.
fn rate(rates: &LearningRates, p: usize) -> f32 {
    match p {
        0..plane::LOG_SCALE => rates.mean,
        plane::LOG_SCALE..plane::QUAT => rates.log_scale,
        plane::QUAT..plane::OPACITY => rates.quat,
        plane::OPACITY => rates.opacity,
        plane::SH..=13 => rates.sh_dc,
        _ => rates.sh_rest,
    }
}

/// Steps the parameters in `planes` of the sixteen rows of a block.
#[inline(always)]
#[expect(clippy::too_many_arguments, reason = "a kernel: each argument is a buffer of its own")]
pub(super) fn step<S: Simd>(
    s: S,
    params: &mut [f32],
    moments: [&mut [f32]; 2],
    ages: &mut [u16],
    gradient: &[f32],
    planes: Range<usize>,
    rates: &LearningRates,
    bias: &BiasCorrection,
) {
    let c = |x: f32| V::splat(s, x);
    let mut correction = [[0.0_f32; WIDTH]; 2];
    for (lane, age) in ages.iter_mut().enumerate() {
        *age = age.saturating_add(1);
        let [first, second] = bias.at(*age);
        correction[0][lane] = first;
        correction[1][lane] = second;
    }
    let [m, v] = moments;
    for p in planes {
        let rate = rate(rates, p);
        for lane in (0..WIDTH).step_by(S::F32_LANES) {
            let at = p * WIDTH + lane;
            let g = V::load(s, &gradient[at..]);
            let m_new = V::load(s, &m[at..]).mul_add(c(BETA1), g * (1.0 - BETA1));
            let v_new = V::load(s, &v[at..]).mul_add(c(BETA2), g * g * (1.0 - BETA2));
            let x = V::load(s, &params[at..]);
            let m_hat = m_new * V::load(s, &correction[0][lane..]);
            let v_hat = v_new.sqrt() * V::load(s, &correction[1][lane..]);
            let step = m_hat * rate / (v_hat + EPSILON);
            m_new.store(&mut m[at..]);
            v_new.store(&mut v[at..]);
            (x - step).store(&mut params[at..]);
        }
    }
}

/// Confines the parameters of a block to their safe range. Quaternions whose squared length differs from 1 by
/// at most `slack` stay unchanged.
#[inline(always)]
pub(super) fn confine<S: Simd>(s: S, params: &mut [f32], slack: f32) {
    let c = |x: f32| V::splat(s, x);
    for lane in (0..WIDTH).step_by(S::F32_LANES) {
        let at = |p: usize| p * WIDTH + lane;
        let q = each!(i in 4 => V::load(s, &params[at(plane::QUAT + i)..]));
        let norm2 = q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3];
        // A quaternion this short has no direction left, and is reset to the identity. Here and
        // below, NaN stays NaN, so that an audit finds it.
        let lost = norm2.le(c(1e-12));
        let inv = (norm2 - c(1.0)).abs().le(c(slack)).select(c(1.0), c(1.0) / norm2.sqrt());
        for (i, x) in q.into_iter().enumerate() {
            let identity = if i == 0 { 1.0 } else { 0.0 };
            lost.select(c(identity), x * inv).store(&mut params[at(plane::QUAT + i)..]);
        }
        for p in plane::LOG_SCALE..plane::QUAT {
            let x = V::load(s, &params[at(p)..]);
            clamp(s, x, LOG_SCALE_RANGE).store(&mut params[at(p)..]);
        }
        let x = V::load(s, &params[at(plane::OPACITY)..]);
        clamp(s, x, [-LOGIT_MAX, LOGIT_MAX]).store(&mut params[at(plane::OPACITY)..]);
    }
}

/// Clamps x to the bounds, which are included; NaN stays NaN.
#[inline(always)]
fn clamp<S: Simd>(s: S, x: V<S>, bounds: [f32; 2]) -> V<S> {
    let [min, max] = each!(i in 2 => V::splat(s, bounds[i]));
    let x = x.lt(min).select(min, x);
    max.lt(x).select(max, x)
}
