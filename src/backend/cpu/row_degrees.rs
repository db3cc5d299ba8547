//! Bands of colour that rows do not need, dropped once along a run, so that memory falls.
//!
//! A row is given the lowest degree at which its colour changes by no more than
//! [a tolerance](crate::backend::Shortcuts::row_degrees), as the root mean square over all directions of
//! view. The basis is orthonormal, so that this is √(Σ c² / 4π) over the coefficients that are dropped
//! (Parseval). Reduced-3DGS (Papantonakis et al. 2024, *Reducing the Memory Footprint of 3D Gaussian
//! Splatting*) has the same rule with the mean over the training views in the place of that over all
//! directions, and so must render them; here nothing is rendered. That colours end at 0 is left out of
//! account: it can only bring them nearer to each other.
//!
//! Rows are put in order of falling degree, those of one degree as they were. A block of sixteen then
//! has the degree of its first row, and its rows keep all that the block holds. Blocks without rows go on
//! as the last one that has some, so that no row could have fewer bands where none were dropped. A row
//! that an edit puts elsewhere has the degree of its new block: it loses bands there, or begins them at 0.

use std::f64::consts::PI;

use super::CpuBackend;
use super::blocks::{Degrees, plane};
use super::simd::WIDTH;
use crate::backend::{RowDegrees, StateError, Tensor};
use crate::gaussians::{MAX_SH_DEGREE, sh_coefficients};

impl CpuBackend {
    /// Drops what rows do not need of the bands up to `in_use`, and all bands beyond it. `None`, and
    /// nothing done, where this was not asked for or has been done before.
    pub(super) fn lower_degrees(&mut self, in_use: u8) -> Option<RowDegrees> {
        let tolerance = self.shortcuts.row_degrees?;
        if self.params.degrees() != Degrees::ALL {
            return None;
        }
        let before = self.held();
        let needed: Vec<u8> = (0..self.rows)
            .map(|row| {
                let sh = |i: usize| f64::from(self.params.get(row, plane::SH + i));
                degree_needed(sh, in_use.min(self.sh_degree), tolerance)
            })
            .collect();
        let order = by_falling(&needed);
        let firsts = order.iter().step_by(WIDTH).map(|&row| needed[row as usize]);
        let degrees = Degrees::falling(&firsts.collect::<Vec<u8>>(), self.sh_degree);
        if degrees != Degrees::ALL {
            self.reorder(order);
            self.drop_to(degrees);
        }
        let mut rows = [0; MAX_SH_DEGREE as usize + 1];
        for block in 0..self.rows.div_ceil(WIDTH) {
            rows[usize::from(self.degree(block))] += WIDTH.min(self.rows - block * WIDTH);
        }
        Some(RowDegrees { tolerance, rows, bytes: [before, self.held()] })
    }

    /// Bytes of parameters and moments that are there.
    fn held(&self) -> u64 {
        self.params.held() + self.moments.held()
    }

    fn degree(&self, block: usize) -> u8 {
        self.params.degrees().of(block).min(self.sh_degree)
    }

    /// Puts rows in another order, with all that is theirs and outlives a step.
    fn reorder(&mut self, order: Vec<u32>) {
        let Self { params, moments, ages, signals, summed, .. } = self;
        arrange(order, |a, b| {
            params.swap_rows(a, b);
            moments.swap_rows(a, b);
            ages.swap(a, b);
            signals.blocks.swap_rows(a, b);
            summed.swap_rows(a, b);
        });
    }

    /// One buffer after the other, in place.
    fn drop_to(&mut self, degrees: Degrees) {
        let (rows, of_model) = (self.rows, self.sh_degree);
        self.params.drop_bands(rows, of_model, degrees);
        self.moments.drop_bands(rows, of_model, degrees);
        self.summed.drop_bands(rows, of_model, degrees);
    }

    /// The degree of each block up to the budget. Shape: `[blocks]`.
    pub(super) fn degrees_tensor(&self, name: &str) -> Tensor {
        let degrees: Vec<u8> = (0..self.blocks()).map(|block| self.degree(block)).collect();
        Tensor::u8(name, &[degrees.len()], degrees)
    }

    /// Takes back what [`degrees_tensor`](Self::degrees_tensor) returned, before any other array.
    pub(super) fn restore_degrees(&mut self, tensor: Tensor) -> Result<(), StateError> {
        let refused = tensor.error(format!(
            "it is not a list of degrees that fall from block to block, from {} at most",
            self.sh_degree
        ));
        let done = tensor.error("this backend has dropped other bands");
        let degrees = tensor.into_u8(&[self.blocks()])?;
        let falls = degrees.is_sorted_by(|a, b| a >= b);
        if !falls || degrees.first().is_some_and(|&degree| degree > self.sh_degree) {
            return Err(refused);
        }
        let degrees = Degrees::falling(&degrees, self.sh_degree);
        match self.params.degrees() {
            now if now == degrees => {}
            Degrees::ALL => self.drop_to(degrees),
            _ => return Err(done),
        }
        Ok(())
    }

    fn blocks(&self) -> usize {
        self.budget.div_ceil(WIDTH)
    }
}

/// The lowest degree whose colour is within `tolerance` `[1/255]` of that at the degree in use, as the
/// distance of two colours whose channels all differ by as much. `sh` are the coefficients, channel by
/// channel. Of what is no number nothing is dropped.
fn degree_needed(sh: impl Fn(usize) -> f64, in_use: u8, tolerance: f32) -> u8 {
    let allowed = 3.0 * (f64::from(tolerance) / 255.0).powi(2) * 4.0 * PI;
    let dropped = |degree: u8| -> f64 {
        let coefficients = 3 * sh_coefficients(degree)..3 * sh_coefficients(in_use);
        coefficients.map(|i| sh(i).powi(2)).sum()
    };
    (0..in_use).find(|&degree| dropped(degree) <= allowed).unwrap_or(in_use)
}

/// The rows in order of falling degree; of equal ones as they were.
fn by_falling(degrees: &[u8]) -> Vec<u32> {
    let of = |degree: u8| (0_u32..).zip(degrees).filter(move |(_, d)| **d == degree);
    (0..=MAX_SH_DEGREE).rev().flat_map(of).map(|(row, _)| row).collect()
}

/// Swaps pairs until each place i has what was in place `order[i]`.
fn arrange(mut order: Vec<u32>, mut swap: impl FnMut(usize, usize)) {
    for start in 0..order.len() {
        // Along the cycle; what began it goes along to its end.
        let mut at = start;
        loop {
            let from = std::mem::replace(&mut order[at], at as u32) as usize;
            if from == start {
                break;
            }
            swap(at, from);
            at = from;
        }
    }
}

#[cfg(test)]
mod tests;
