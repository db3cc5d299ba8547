//! Learned masks: a number per row that decides whether the row is needed (*Compact 3D Gaussian Representation*,
//! Lee et al. 2024, section 3.1). If a policy declares them, they are optimised between stages 6
//! and 7.

use std::ops::Range;

use densify_policies::policy::MaskTerm;
use rayon::prelude::*;

use super::adam::{BETA1, BETA2, BiasCorrection, EPSILON, LOGIT_MAX};
use super::blocks::{BlockTask, Blocks, RowEdit, plane};
use super::simd::WIDTH;
use crate::{StateError, Tensor};
use densify_core::gaussians::{logit, sigmoid};

/// Plane of the mask's logit m, stored as the difference from its initial value, so that a new mask is 0.
const OFFSET: usize = 0;
/// Planes of its two moments.
const FIRST: usize = 1;
const SECOND: usize = 2;
const PLANES: usize = 3;

/// The masks of the trainable rows; empty unless they are declared.
#[derive(Debug)]
pub(super) struct Masks {
    term: Option<MaskTerm>,
    blocks: Blocks<f32>,
}

/// The masks of a task's blocks.
#[derive(Debug)]
pub(super) struct MaskTask<'a> {
    term: MaskTerm,
    /// Derivative of the loss term with respect to σ(m), per row.
    weight: f32,
    blocks: BlockTask<'a, f32>,
}

impl Masks {
    pub(super) fn new(rows: Range<usize>, term: Option<MaskTerm>) -> Self {
        Self { term, blocks: Blocks::zeros(rows, if term.is_some() { PLANES } else { 0 }) }
    }

    pub(super) fn bytes(rows: Range<usize>) -> u64 {
        Blocks::<f32>::bytes(rows, PLANES)
    }

    pub(super) fn is_declared(&self) -> bool {
        self.term.is_some()
    }

    /// σ(m) of a row.
    pub(super) fn value(&self, row: usize) -> f32 {
        self.term.map_or(0.0, |term| sigmoid(term.start + self.blocks.get(row, OFFSET)))
    }

    /// Splits the masks for the optimiser's tasks; the loss term is the mean over `trained` rows.
    pub(super) fn tasks(
        &mut self,
        rows: usize,
        trained: usize,
    ) -> impl IndexedParallelIterator<Item = Option<MaskTask<'_>>> {
        let term = self.term;
        self.blocks.tasks(rows).map(move |blocks| {
            let weight = term?.weight / trained.max(1) as f32;
            Some(MaskTask { term: term?, weight, blocks })
        })
    }

    /// Gives a new row its parent's mask.
    pub(super) fn inherit(&mut self, parent: usize, row: usize) {
        if self.is_declared() {
            self.blocks.set(row, OFFSET, self.blocks.get(parent, OFFSET));
        }
    }

    /// Resets the moments of a row's mask.
    pub(super) fn reset_moments(&mut self, row: usize) {
        if self.is_declared() {
            self.blocks.set(row, FIRST, 0.0);
            self.blocks.set(row, SECOND, 0.0);
        }
    }

    pub(super) fn edit(&mut self, edit: RowEdit<'_>) {
        self.blocks.edit(edit);
    }

    pub(super) fn tensor(&self, name: &str, rows: Range<usize>) -> Tensor {
        let shape = [rows.len(), PLANES];
        Tensor::f32(name, &shape, self.blocks.to_rows(rows, 0..PLANES))
    }

    pub(super) fn restore(&mut self, rows: Range<usize>, tensor: Tensor) -> Result<(), StateError> {
        let values = tensor.into_f32(&[rows.len(), PLANES])?;
        self.blocks.set_rows(rows, 0..PLANES, &values);
        Ok(())
    }
}

impl MaskTask<'_> {
    /// Takes an Adam step for the masks of a block, from the gradient of the image loss; `ages` are the rows' ages
    /// before the step. A row whose mask falls to the threshold becomes transparent.
    pub(super) fn step(
        &mut self,
        block: usize,
        params: &mut [f32],
        gradient: &[f32],
        ages: &[u16],
        bias: &BiasCorrection,
    ) {
        let masks = self.blocks.block(block);
        let MaskTerm { start, rate, threshold, .. } = self.term;
        let threshold = logit(threshold);
        for (lane, &age) in ages.iter().enumerate() {
            let at = |plane: usize| plane * WIDTH + lane;
            // Opacity and scales are multiplied by 1[σ(m) > threshold], whose derivative is approximated by that of
            // σ(m).
            let transparency = sigmoid(-params[at(plane::OPACITY)]);
            let by_scales: f32 = (plane::LOG_SCALE..plane::QUAT).map(|p| gradient[at(p)]).sum();
            let by_factor = gradient[at(plane::OPACITY)] / transparency + by_scales;
            let m = start + masks[at(OFFSET)];
            let slope = sigmoid(m) * sigmoid(-m);
            let g = (by_factor + self.weight) * slope;
            let first = masks[at(FIRST)] * BETA1 + g * (1.0 - BETA1);
            let second = masks[at(SECOND)] * BETA2 + g * g * (1.0 - BETA2);
            let [first_bias, second_bias] = bias.at(age.saturating_add(1));
            let step = first * first_bias * rate / (second.sqrt() * second_bias + EPSILON);
            masks[at(OFFSET)] -= step;
            masks[at(FIRST)] = first;
            masks[at(SECOND)] = second;
            if start + masks[at(OFFSET)] <= threshold {
                params[at(plane::OPACITY)] = -LOGIT_MAX;
            }
        }
    }
}
