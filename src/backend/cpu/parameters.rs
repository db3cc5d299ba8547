//! The model's parameters: f32 in blocks; or the means so, and all other planes in 16 bits. Colour
//! then is f16. Log-scales, quaternions and opacity logits, which the optimiser keeps within bounds,
//! are in fixed point: of f16, log-scales of −5 would lie 0.004 apart, four times an ordinary step, and
//! the rounding of it would be more than the step.
//!
//! Kernels read and write planes of f32. Where a block is f32 they get the block itself; else its
//! planes are widened to an array ([`open`](ParameterTask::open)) and stored from it, rounded at
//! random ([`close`](ParameterTask::close)). Edits, which happen once, are rounded to the nearest.

use std::ops::Range;

use super::blocks::{Blocks, Scratch, plane};
use super::narrow::{Draws, F16, Narrow, fixed, narrow, narrow_fixed, widen, widen_fixed};
use super::passes::parts;
use super::simd::WIDTH;
use super::{BLOCKS_PER_TASK, ROWS_PER_TASK};
use crate::backend::ParameterStorage;
use crate::gaussians::{Gaussians, sh_coefficients};

/// Planes of means: the ones that are f32 in any case.
const MEANS: usize = plane::LOG_SCALE;
/// Planes of what is bounded.
const BOUNDED: usize = plane::SH - plane::LOG_SCALE;

/// Digits after the point of the bounded planes: from −16 to 16, and quaternions from −2 to 2.
const fn digits(bounded: usize) -> u32 {
    match bounded + MEANS {
        plane::QUAT..plane::OPACITY => 14,
        _ => 11,
    }
}

/// The parameters of all rows.
#[derive(Debug)]
pub(super) struct Parameters {
    /// All planes, or the means.
    wide: Blocks,
    /// None, or the bounded planes.
    fixed: Blocks<i16>,
    /// None, or the planes of colour.
    half: Blocks<F16>,
}

/// Planes of f32, in fixed point, and of f16.
fn split(planes: usize, storage: ParameterStorage) -> [usize; 3] {
    match storage {
        ParameterStorage::F32 => [planes, 0, 0],
        ParameterStorage::F16 => [MEANS, BOUNDED, planes - plane::SH],
    }
}

impl Parameters {
    pub(super) fn zeros(capacity: usize, planes: usize, storage: ParameterStorage) -> Self {
        let [wide, fixed, half] = split(planes, storage);
        Self {
            wide: Blocks::zeros(capacity, wide),
            fixed: Blocks::zeros(capacity, fixed),
            half: Blocks::zeros(capacity, half),
        }
    }

    /// Bytes for `capacity` rows.
    pub(super) fn bytes(capacity: usize, planes: usize, storage: ParameterStorage) -> u64 {
        let [wide, fixed, half] = split(planes, storage);
        Blocks::<f32>::bytes(capacity, wide)
            + Blocks::<i16>::bytes(capacity, fixed)
            + Blocks::<F16>::bytes(capacity, half)
    }

    /// Bytes that are there.
    #[cfg(test)]
    pub(super) fn held(&self) -> u64 {
        self.wide.held() + self.fixed.held() + self.half.held()
    }

    /// Numbers per block of the three.
    fn strides(&self) -> [usize; 3] {
        [self.wide.stride(), self.fixed.stride(), self.half.stride()]
    }

    fn is_wide(&self, plane: usize) -> bool {
        plane < MEANS || self.fixed.stride() == 0
    }

    pub(super) fn get(&self, row: usize, plane: usize) -> f32 {
        match plane.checked_sub(plane::SH) {
            _ if self.is_wide(plane) => self.wide.get(row, plane),
            None => {
                let bounded = plane - MEANS;
                fixed::to_f32(self.fixed.get(row, bounded), digits(bounded))
            }
            Some(colour) => self.half.get(row, colour).to_f32(),
        }
    }

    pub(super) fn set(&mut self, row: usize, plane: usize, value: f32) {
        match plane.checked_sub(plane::SH) {
            _ if self.is_wide(plane) => self.wide.set(row, plane, value),
            None => {
                let bounded = plane - MEANS;
                self.fixed.set(row, bounded, fixed::nearest(value, digits(bounded)));
            }
            Some(colour) => self.half.set(row, colour, F16::nearest(value)),
        }
    }

    /// The values of `N` planes of one row, from `plane` on.
    pub(super) fn get_n<const N: usize>(&self, row: usize, plane: usize) -> [f32; N] {
        std::array::from_fn(|i| self.get(row, plane + i))
    }

    pub(super) fn set_n<const N: usize>(&mut self, row: usize, plane: usize, values: [f32; N]) {
        for (i, value) in values.into_iter().enumerate() {
            self.set(row, plane + i, value);
        }
    }

    /// Copies what is stored, to the bit.
    pub(super) fn copy_row(&mut self, from: usize, to: usize) {
        self.wide.copy_row(from, to);
        self.fixed.copy_row(from, to);
        self.half.copy_row(from, to);
    }

    pub(super) fn clear_row(&mut self, row: usize) {
        self.wide.clear_row(row);
        self.fixed.clear_row(row);
        self.half.clear_row(row);
    }

    /// Packs a host model; `self` must have room and the model's planes.
    pub(super) fn pack(&mut self, model: &Gaussians) {
        for row in 0..model.len() {
            self.set_n(row, plane::MEAN, model.means[row]);
            self.set_n(row, plane::LOG_SCALE, model.log_scales[row]);
            self.set_n(row, plane::QUAT, model.quats[row]);
            self.set(row, plane::OPACITY, model.opacity_logits[row]);
            for (i, &x) in model.sh_of(row).iter().enumerate() {
                self.set(row, plane::SH + i, x);
            }
        }
    }

    /// The first `rows` rows as a host model.
    pub(super) fn unpack(&self, rows: usize, sh_degree: u8) -> Gaussians {
        let sh_planes = 3 * sh_coefficients(sh_degree);
        Gaussians {
            sh_degree,
            means: (0..rows).map(|r| self.get_n(r, plane::MEAN)).collect(),
            log_scales: (0..rows).map(|r| self.get_n(r, plane::LOG_SCALE)).collect(),
            quats: (0..rows).map(|r| self.get_n(r, plane::QUAT)).collect(),
            opacity_logits: (0..rows).map(|r| self.get(r, plane::OPACITY)).collect(),
            sh: (0..rows)
                .flat_map(|r| (0..sh_planes).map(move |i| self.get(r, plane::SH + i)))
                .collect(),
        }
    }

    /// The blocks of the first `rows` rows, to read.
    pub(super) fn view(&self, rows: usize) -> ParameterView<'_> {
        ParameterView {
            strides: self.strides(),
            wide: self.wide.of_rows(rows),
            fixed: self.fixed.of_rows(rows),
            half: self.half.of_rows(rows),
        }
    }

    /// The blocks of the first `rows` rows, cut for so many of the optimiser's tasks.
    pub(super) fn tasks(&mut self, rows: usize, tasks: usize) -> Vec<ParameterTask<'_>> {
        let strides = self.strides();
        let per_task = strides.map(|stride| stride * BLOCKS_PER_TASK);
        let wide = parts(self.wide.of_rows_mut(rows), per_task[0], tasks);
        let fixed = parts(self.fixed.of_rows_mut(rows), per_task[1], tasks);
        let half = parts(self.half.of_rows_mut(rows), per_task[2], tasks);
        let all = wide.into_iter().zip(fixed).zip(half);
        all.map(|((wide, fixed), half)| ParameterTask { strides, wide, fixed, half }).collect()
    }
}

/// Some blocks, to read.
#[derive(Debug, Clone, Copy)]
pub(super) struct ParameterView<'a> {
    /// Numbers per block of the three below.
    strides: [usize; 3],
    wide: &'a [f32],
    fixed: &'a [i16],
    half: &'a [F16],
}

/// Numbers of a block.
fn of(block: usize, stride: usize) -> Range<usize> {
    block * stride..(block + 1) * stride
}

impl<'a> ParameterView<'a> {
    /// The blocks of task `i`, each of `ROWS_PER_TASK` rows but the last.
    pub(super) fn task(self, i: usize) -> Self {
        fn cut<T>(all: &[T], i: usize, stride: usize) -> &[T] {
            let Range { start, end } = of(i, stride * BLOCKS_PER_TASK);
            &all[start.min(all.len())..end.min(all.len())]
        }
        Self {
            strides: self.strides,
            wide: cut(self.wide, i, self.strides[0]),
            fixed: cut(self.fixed, i, self.strides[1]),
            half: cut(self.half, i, self.strides[2]),
        }
    }

    /// Planes of a row.
    pub(super) fn planes(&self) -> usize {
        self.strides.iter().sum::<usize>() / WIDTH
    }

    pub(super) fn blocks(&self) -> usize {
        self.wide.len() / self.strides[0]
    }

    /// The first `planes` planes, or more, of a block. Whole planes, one after the other.
    #[inline(always)]
    pub(super) fn open<'b>(
        &self,
        block: usize,
        planes: usize,
        scratch: &'b mut Scratch,
    ) -> &'b [f32]
    where
        'a: 'b,
    {
        let [wide, fixed, half] = self.strides;
        if fixed == 0 {
            return &self.wide[of(block, wide)];
        }
        let narrow = (&self.fixed[of(block, fixed)], &self.half[of(block, half)]);
        to_scratch(&self.wide[of(block, wide)], narrow, planes, scratch);
        &scratch.0
    }
}

/// Some blocks, to change.
#[derive(Debug)]
pub(super) struct ParameterTask<'a> {
    strides: [usize; 3],
    wide: &'a mut [f32],
    fixed: &'a mut [i16],
    half: &'a mut [F16],
}

impl ParameterTask<'_> {
    /// Numbers per block.
    pub(super) fn stride(&self) -> usize {
        self.strides.iter().sum()
    }

    /// Whether what is stored is not what was computed.
    #[inline(always)]
    pub(super) fn is_narrow(&self) -> bool {
        self.strides[1] > 0
    }

    /// The first `planes` planes, or more, of a block.
    #[inline(always)]
    pub(super) fn open<'b>(
        &'b mut self,
        block: usize,
        planes: usize,
        scratch: &'b mut Scratch,
    ) -> &'b mut [f32] {
        let [wide, fixed, half] = self.strides;
        if fixed == 0 {
            return &mut self.wide[of(block, wide)];
        }
        let narrow = (&self.fixed[of(block, fixed)], &self.half[of(block, half)]);
        to_scratch(&self.wide[of(block, wide)], narrow, planes, scratch);
        &mut scratch.0
    }

    /// Stores the planes that were opened, where they are not what is stored.
    #[inline(always)]
    pub(super) fn close(
        &mut self,
        block: usize,
        planes: usize,
        scratch: &Scratch,
        draws: &mut Draws,
    ) {
        let [wide, fixed, half] = self.strides;
        if fixed == 0 {
            return;
        }
        let all = &scratch.0[..planes * WIDTH];
        let (means, rest) = all.split_at(MEANS * WIDTH);
        let (bounded, colour) = rest.split_at(BOUNDED * WIDTH);
        self.wide[of(block, wide)].copy_from_slice(means);
        let to = self.fixed[of(block, fixed)].as_chunks_mut().0;
        for (i, (from, to)) in bounded.as_chunks().0.iter().zip(to).enumerate() {
            narrow_fixed(from, to, digits(i), draws);
        }
        narrow(colour, &mut self.half[of(block, half)][..colour.len()], draws);
    }
}

#[inline(always)]
fn to_scratch(wide: &[f32], narrow: (&[i16], &[F16]), planes: usize, scratch: &mut Scratch) {
    let all = &mut scratch.0[..planes * WIDTH];
    let (means, rest) = all.split_at_mut(MEANS * WIDTH);
    let (bounded, colour) = rest.split_at_mut(BOUNDED * WIDTH);
    means.copy_from_slice(wide);
    let (fixed, half) = narrow;
    for (i, (from, to)) in fixed.as_chunks().0.iter().zip(bounded.as_chunks_mut().0).enumerate() {
        widen_fixed(from, to, digits(i));
    }
    widen(&half[..colour.len()], colour);
}

const _: () = assert!(ROWS_PER_TASK == BLOCKS_PER_TASK * WIDTH, "a task is whole blocks");
