//! Stages 6–8 combined, block by block: parameter gradients, signals, Adam. A block's gradients
//! stay in the cache; there is no gradient buffer of the model's size, unless a policy requests
//! gradients summed between optimiser steps.

use std::sync::atomic::{AtomicU32, Ordering::Relaxed};

use densify_policies::rng::PolicyRng;
use pulp::{Simd, WithSimd};

use super::adam::{self, BiasCorrection};
use super::blocks::{Scratch, plane, planes};
use super::mask::MaskTask;
use super::moments::MomentTask;
use super::narrow::Draws;
use super::parameters::{ParameterTask, ParameterView};
use super::project::ViewParams;
use super::project_bwd::BlockGradient;
use super::rasterize_bwd::field;
use super::regularise::{Noise, Terms};
use super::simd::WIDTH;
use super::summed::{Stepping, TaskSums};
use crate::LearningRates;
use crate::signals::{Field, RecordLayout, SignalPlanes};
use densify_core::gaussians::sh_coefficients;
use densify_core::pose::TWIST_VALUES;

/// Tolerance of a quaternion's squared length if parameters are stored in fewer bits. If quaternions were normalised
/// and rounded at each step, even a row without a gradient would rotate randomly.
const NARROW_SLACK: f32 = 1.0 / 16.0;

/// An optimiser step for consecutive blocks.
pub(super) struct Optimise<'a> {
    pub(super) params: ParameterTask<'a>,
    pub(super) moments: MomentTask<'a>,
    /// Random numbers for stochastic rounding.
    pub(super) rounding_rng: &'a PolicyRng,
    pub(super) ages: &'a mut [u16],
    /// Signal accumulators of these blocks; empty if there are none.
    pub(super) signals: &'a mut [f32],
    pub(super) planes: SignalPlanes,
    /// Number of pixels in which each row has the largest weight; empty if they are not counted. Shape: `[rows]`.
    pub(super) dominant: &'a [AtomicU32],
    /// Shape: `[rows, layout.stride()]`.
    pub(super) sums: &'a [f32],
    pub(super) layout: RecordLayout,
    /// Shape: `[blocks]`.
    pub(super) visible: &'a [u16],
    pub(super) view: &'a ViewParams,
    pub(super) rates: &'a LearningRates,
    pub(super) bias: &'a BiasCorrection,
    /// Masks of these rows, if declared.
    pub(super) masks: Option<MaskTask<'a>>,
    /// Gradients kept for a later step.
    pub(super) summed: TaskSums<'a>,
    /// The parameter groups that step now.
    pub(super) due: Stepping,
    /// Loss terms of every row, if there are any.
    pub(super) terms: Option<Terms>,
    /// Noise on the means, if there is any.
    pub(super) noise: Option<Noise>,
    /// The first row of the first block; the numbers of frozen rows and of all rows, counted from it.
    pub(super) first_row: usize,
    pub(super) frozen: usize,
    pub(super) rows: usize,
}

impl WithSimd for Optimise<'_> {
    /// The sum of dL/d(twist of the camera) over these rows; 0 if the view does not ask for it.
    type Output = [f64; TWIST_VALUES];

    #[inline(always)]
    fn with_simd<S: Simd>(self, s: S) -> Self::Output {
        let Self { params: mut stored, mut moments, ages, signals, sums, .. } = self;
        let Self { layout, visible, view, rates, bias, due, terms, noise, .. } = self;
        let Self { mut masks, mut summed, planes: signal_planes, .. } = self;
        let trained = planes(view.sh_degree);
        let mut gradient = BlockGradient::ZERO;
        let mut was_zero = true;
        let signal_stride = signals.len() / visible.len().max(1);
        let slack = if stored.is_narrow { NARROW_SLACK } else { 0.0 };
        let is_narrow = stored.is_narrow || moments.is_narrow;
        let mut scratch = Scratch::ZERO;
        let mut moment_scratch = [Scratch::ZERO; 2];
        let mut kept = Scratch::ZERO;
        let mut twist = [0.0; TWIST_VALUES];
        for (b, &seen) in visible.iter().enumerate() {
            let frozen = self.frozen.saturating_sub(b * WIDTH).min(WIDTH);
            if frozen == WIDTH {
                continue;
            }
            // Frozen rows have no gradient.
            let seen = seen & (u16::MAX << frozen);
            let params = stored.open(b, trained, &mut scratch);
            if frozen > 0 {
                kept.0[..trained * WIDTH].copy_from_slice(&params[..trained * WIDTH]);
            }
            let per_block = WIDTH * layout.stride();
            let sums = &sums[b * per_block..(b + 1) * per_block];
            if seen != 0 || !was_zero {
                gradient.compute(s, params, sums, layout, seen, view);
                was_zero = seen == 0;
            }
            if view.differentiates_pose && seen != 0 {
                gradient.add_twist(&mut twist);
            }
            if seen != 0 && signal_stride > 0 {
                let block = &mut signals[b * signal_stride..(b + 1) * signal_stride];
                let pixels = self.dominant.iter().skip(self.first_row + b * WIDTH);
                for (to, pixels) in gradient.dominant.iter_mut().zip(pixels) {
                    *to = pixels.load(Relaxed) as f32;
                }
                signal_planes.accumulate(s, block, &gradient, view);
            }
            if let Some(masks) = &mut masks {
                let ages = &ages[b * WIDTH..(b + 1) * WIDTH];
                masks.step(b, params, &gradient.params, ages, bias);
            }
            if let Some(terms) = &terms {
                terms.add(s, params, &mut gradient.params);
                was_zero = false;
            }
            if due.uses_sums() {
                was_zero &= !summed.take_gradient(b, &mut gradient.params, trained, due);
            }
            let lanes = b * WIDTH..(b + 1) * WIDTH;
            let [m, v] = moments.open(b, trained, &mut moment_scratch);
            let ages = &mut ages[lanes.clone()];
            let (main, rest) = (0..trained.min(plane::SH_REST), plane::SH_REST..trained);
            let g = &gradient.params;
            match summed.rest_ages(lanes.clone()) {
                // Bands 1–3 step with the other parameters.
                None if due.main => {
                    adam::step(s, params, [m, v], ages, g, 0..trained, rates, bias);
                }
                None => {}
                Some(rest_ages) => {
                    if due.main {
                        adam::step(s, params, [&mut *m, &mut *v], ages, g, main, rates, bias);
                    }
                    if due.rest {
                        adam::step(s, params, [m, v], rest_ages, g, rest, rates, bias);
                    }
                }
            }
            if due.main {
                adam::confine(s, params, slack);
                if let Some(noise) = &noise {
                    let first = self.first_row + b * WIDTH;
                    noise.add(params, first, self.rows.saturating_sub(b * WIDTH).min(WIDTH));
                }
            }
            // Restore the frozen rows of this block, which loss terms, masks, noise and clamping have changed too.
            if frozen > 0 {
                for plane in (0..trained * WIDTH).step_by(WIDTH) {
                    params[plane..plane + frozen].copy_from_slice(&kept.0[plane..plane + frozen]);
                }
                ages[..frozen].fill(0);
                if let Some(rest_ages) = summed.rest_ages(lanes) {
                    rest_ages[..frozen].fill(0);
                }
            }
            if is_narrow && (due.main || due.rest) {
                let first_row = self.first_row + b * WIDTH;
                let [mut param_draws, mut m_draws, mut v_draws] =
                    Draws::of_block(self.rounding_rng, first_row);
                stored.close(b, trained, &scratch, &mut param_draws);
                moments.close(b, trained, &moment_scratch, [&mut m_draws, &mut v_draws]);
            }
        }
        twist
    }
}

/// Differentiates consecutive blocks with respect to the pose, without a step.
pub(super) struct DifferentiatePose<'a> {
    pub(super) params: ParameterView<'a>,
    /// Shape: `[rows, layout.stride()]`.
    pub(super) sums: &'a [f32],
    pub(super) layout: RecordLayout,
    /// Shape: `[blocks]`.
    pub(super) visible: &'a [u16],
    pub(super) view: &'a ViewParams,
}

impl WithSimd for DifferentiatePose<'_> {
    type Output = [f64; TWIST_VALUES];

    #[inline(always)]
    fn with_simd<S: Simd>(self, s: S) -> Self::Output {
        let Self { params, sums, layout, visible, view } = self;
        let per_block = WIDTH * layout.stride();
        let (mut gradient, mut scratch) = (BlockGradient::ZERO, Scratch::ZERO);
        let mut twist = [0.0; TWIST_VALUES];
        for (b, (&seen, sums)) in visible.iter().zip(sums.chunks_exact(per_block)).enumerate() {
            if seen != 0 {
                let block = params.open(b, planes(view.sh_degree), &mut scratch);
                gradient.compute(s, block, sums, layout, seen, view);
                gradient.add_twist(&mut twist);
            }
        }
        twist
    }
}

/// Gradients of every parameter, and the values from which signals follow, for one view.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct ModelGradient {
    /// dL/d(mean). Shape: `[rows]`.
    pub means: Vec<[f32; 3]>,
    /// dL/d(log-scale). Shape: `[rows]`.
    pub log_scales: Vec<[f32; 3]>,
    /// dL/d(raw quaternion). Shape: `[rows]`.
    pub quats: Vec<[f32; 4]>,
    /// dL/d(opacity logit). Shape: `[rows]`.
    pub opacity_logits: Vec<f32>,
    /// dL/d(coefficients), coefficient-major, RGB last. Shape: `[rows, (degree + 1)², 3]`.
    pub sh: Vec<f32>,
    /// dL/d(projected mean) `[1/px]`. Shape: `[rows]`.
    pub mean2d: Vec<[f32; 2]>,
    /// Σ over pixels of the absolute values of dL/d(projected mean) `[1/px]`. Shape: `[rows]`.
    pub mean2d_abs: Vec<[f32; 2]>,
    /// dL/d(colour as blended). Shape: `[rows]`.
    pub colour: Vec<[f32; 3]>,
    /// Largest blend weight α·T over pixels. Shape: `[rows]`.
    pub max_weight: Vec<f32>,
    /// Sum of the blend weights. Shape: `[rows]`.
    pub sum_weight: Vec<f32>,
    /// Pixels that the row is blended into. Shape: `[rows]`.
    pub pixel_count: Vec<u32>,
    /// True if the row's projection is on screen. Shape: `[rows]`.
    pub visible: Vec<bool>,
}

impl ModelGradient {
    pub(super) fn zeros(rows: usize, sh_degree: u8) -> Self {
        Self {
            means: vec![[0.0; 3]; rows],
            log_scales: vec![[0.0; 3]; rows],
            quats: vec![[0.0; 4]; rows],
            opacity_logits: vec![0.0; rows],
            sh: vec![0.0; rows * 3 * sh_coefficients(sh_degree)],
            mean2d: vec![[0.0; 2]; rows],
            mean2d_abs: vec![[0.0; 2]; rows],
            colour: vec![[0.0; 3]; rows],
            max_weight: vec![0.0; rows],
            sum_weight: vec![0.0; rows],
            pixel_count: vec![0; rows],
            visible: vec![false; rows],
        }
    }
}

/// Computes the gradients of a whole model without a step.
pub(super) struct Differentiate<'a> {
    pub(super) params: ParameterView<'a>,
    /// Sums of records with every field except the error.
    pub(super) sums: &'a [f32],
    pub(super) visible: &'a [u16],
    pub(super) view: &'a ViewParams,
    pub(super) out: &'a mut ModelGradient,
}

impl WithSimd for Differentiate<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, s: S) {
        let Self { params, sums, visible, view, out } = self;
        let per_block = WIDTH * RecordLayout::DIFFERENTIATED.stride();
        let sh_planes = out.sh.len() / out.means.len().max(1);
        let mut g = BlockGradient::ZERO;
        let mut scratch = Scratch::ZERO;
        let used_sh_planes = planes(view.sh_degree) - plane::SH;
        for b in 0..params.blocks {
            let block = params.open(b, planes(view.sh_degree), &mut scratch);
            let sums = &sums[b * per_block..(b + 1) * per_block];
            g.compute(s, block, sums, RecordLayout::DIFFERENTIATED, visible[b], view);
            for lane in 0..WIDTH.min(out.means.len() - b * WIDTH) {
                let row = b * WIDTH + lane;
                let at = |p: usize| g.params[p * WIDTH + lane];
                let sum = |f: usize| g.sums[f][lane];
                out.means[row] = [0, 1, 2].map(|i| at(plane::MEAN + i));
                out.log_scales[row] = [0, 1, 2].map(|i| at(plane::LOG_SCALE + i));
                out.quats[row] = [0, 1, 2, 3].map(|i| at(plane::QUAT + i));
                out.opacity_logits[row] = at(plane::OPACITY);
                for i in 0..used_sh_planes {
                    out.sh[row * sh_planes + i] = at(plane::SH + i);
                }
                out.mean2d[row] = g.mean2d.map(|line| line[lane]);
                out.mean2d_abs[row] = g.mean2d_abs.map(|line| line[lane]);
                out.colour[row] = [0, 1, 2].map(|i| sum(field::COLOUR + i));
                out.max_weight[row] = sum(Field::WeightMax.number());
                out.sum_weight[row] = sum(Field::WeightSum.number());
                out.pixel_count[row] = sum(Field::PixelCount.number()) as u32;
                out.visible[row] = g.visible[lane] != 0.0;
            }
        }
    }
}
