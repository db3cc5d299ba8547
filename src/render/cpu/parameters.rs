//! The model's parameters in blocks: all as f32, or all but the means in 16 bits.
//!
//! In 16 bits, colour is f16. Log-scales, quaternions and opacity logits, which the optimiser keeps
//! within bounds, are in fixed point, because f16 would be too coarse: around −5 its spacing is 0.004,
//! four times a typical step of a log-scale.
//!
//! Kernels read and write planes of f32. They access f32 blocks directly; the planes of other blocks are
//! converted to scratch memory ([`open`](ParameterTask::open)) and stored from there with stochastic
//! rounding ([`close`](ParameterTask::close)). Edits are rare, and are rounded to nearest.

use std::ops::Range;

use rayon::prelude::*;

use super::BLOCKS_PER_TASK;
use super::blocks::{BlockTask, BlockView, Blocks, RowEdit, Scratch, plane};
use super::narrow::{Draws, F16, Narrow, fixed, narrow, narrow_fixed, widen, widen_fixed};
use super::simd::WIDTH;
use crate::ParameterStorage;
use densify_core::gaussians::Gaussians;

/// Number of planes of the means, which are always f32.
pub(crate) const MEANS: usize = plane::LOG_SCALE;
/// Number of planes of bounded parameters.
const BOUNDED: usize = plane::SH - plane::LOG_SCALE;

/// Fractional bits of a bounded plane: 14 for quaternions within ±2, 11 for the others within ±16.
const fn fractional_bits(bounded: usize) -> u32 {
    match bounded + MEANS {
        plane::QUAT..plane::OPACITY => 14,
        _ => 11,
    }
}

/// A parameter that is no mean, counted as in [`ModelArray`](densify_core::gaussians::ModelArray), rounded to its 16 bits.
#[cfg(feature = "gpu")]
pub(crate) fn narrowed(parameter: usize, x: f32) -> u16 {
    match parameter.checked_sub(plane::SH) {
        None => fixed::nearest(x, fractional_bits(parameter - MEANS)).cast_unsigned(),
        Some(_) => F16::nearest(x).0,
    }
}

/// The inverse of [`narrowed`].
#[cfg(feature = "gpu")]
pub(crate) fn widened(parameter: usize, bits: u16) -> f32 {
    match parameter.checked_sub(plane::SH) {
        None => fixed::to_f32(bits.cast_signed(), fractional_bits(parameter - MEANS)),
        Some(_) => F16(bits).to_f32(),
    }
}

/// The parameters of all rows.
#[derive(Debug)]
pub(super) struct Parameters {
    /// All planes, or only the means.
    wide: Blocks,
    /// The bounded planes, if stored in 16 bits.
    fixed: Blocks<i16>,
    /// The colour planes, if stored in 16 bits.
    half: Blocks<F16>,
}

/// Numbers of planes in f32, in fixed point and in f16.
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
            wide: Blocks::zeros(0..capacity, wide),
            fixed: Blocks::zeros(0..capacity, fixed),
            half: Blocks::zeros(0..capacity, half),
        }
    }

    /// Bytes for `capacity` rows.
    pub(super) fn bytes(capacity: usize, planes: usize, storage: ParameterStorage) -> u64 {
        let [wide, fixed, half] = split(planes, storage);
        Blocks::<f32>::bytes(0..capacity, wide)
            + Blocks::<i16>::bytes(0..capacity, fixed)
            + Blocks::<F16>::bytes(0..capacity, half)
    }

    /// Allocated bytes.
    #[cfg(test)]
    pub(super) fn allocated_bytes(&self) -> u64 {
        self.wide.allocated_bytes() + self.fixed.allocated_bytes() + self.half.allocated_bytes()
    }

    /// Numbers per row.
    pub(super) fn planes(&self) -> usize {
        self.wide.planes + self.fixed.planes + self.half.planes
    }

    fn is_narrow(&self) -> bool {
        self.fixed.planes > 0
    }

    fn is_wide(&self, plane: usize) -> bool {
        plane < MEANS || !self.is_narrow()
    }

    pub(super) fn get(&self, row: usize, plane: usize) -> f32 {
        match plane.checked_sub(plane::SH) {
            _ if self.is_wide(plane) => self.wide.get(row, plane),
            None => {
                let bounded = plane - MEANS;
                fixed::to_f32(self.fixed.get(row, bounded), fractional_bits(bounded))
            }
            Some(colour) => self.half.get(row, colour).to_f32(),
        }
    }

    pub(super) fn set(&mut self, row: usize, plane: usize, value: f32) {
        match plane.checked_sub(plane::SH) {
            _ if self.is_wide(plane) => self.wide.set(row, plane, value),
            None => {
                let bounded = plane - MEANS;
                self.fixed.set(row, bounded, fixed::nearest(value, fractional_bits(bounded)));
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

    pub(super) fn edit(&mut self, edit: RowEdit<'_>) {
        self.wide.edit(edit);
        self.fixed.edit(edit);
        self.half.edit(edit);
    }

    /// Stores a host model; `self` must have room for its rows, and the same number of planes.
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

    /// Copies some planes of some rows, row-major.
    pub(super) fn to_rows(&self, rows: Range<usize>, planes: Range<usize>) -> Vec<f32> {
        let mut values = Vec::with_capacity(rows.len() * planes.len());
        for row in rows {
            values.extend(planes.clone().map(|plane| self.get(row, plane)));
        }
        values
    }

    /// Sets the numbers that [`to_rows`](Self::to_rows) returns.
    pub(super) fn set_rows(&mut self, rows: Range<usize>, planes: Range<usize>, values: &[f32]) {
        for (row, values) in rows.zip(values.chunks_exact(planes.len())) {
            for (plane, &value) in planes.clone().zip(values) {
                self.set(row, plane, value);
            }
        }
    }

    /// A read-only view of the blocks of the first `rows` rows.
    pub(super) fn view(&self, rows: usize) -> ParameterView<'_> {
        ParameterView {
            blocks: rows.div_ceil(WIDTH),
            is_narrow: self.is_narrow(),
            wide: self.wide.view(rows),
            fixed: self.fixed.view(rows),
            half: self.half.view(rows),
        }
    }

    /// The blocks of the first `rows` rows, split for the optimiser's tasks.
    pub(super) fn tasks(
        &mut self,
        rows: usize,
    ) -> impl IndexedParallelIterator<Item = ParameterTask<'_>> {
        let is_narrow = self.is_narrow();
        let Self { wide, fixed, half } = self;
        let all = (wide.tasks(rows), fixed.tasks(rows), half.tasks(rows)).into_par_iter();
        all.map(move |(wide, fixed, half)| ParameterTask { is_narrow, wide, fixed, half })
    }
}

/// A read-only view of consecutive blocks.
#[derive(Debug, Clone)]
pub(super) struct ParameterView<'a> {
    /// Number of blocks.
    pub(super) blocks: usize,
    is_narrow: bool,
    wide: BlockView<'a, f32>,
    fixed: BlockView<'a, i16>,
    half: BlockView<'a, F16>,
}

impl<'a> ParameterView<'a> {
    /// The blocks of a task.
    pub(super) fn task(&self, i: usize) -> Self {
        let first = (i * BLOCKS_PER_TASK).min(self.blocks);
        let part = first..self.blocks.min(first + BLOCKS_PER_TASK);
        Self {
            blocks: part.len(),
            is_narrow: self.is_narrow,
            wide: self.wide.part(part.clone()),
            fixed: self.fixed.part(part.clone()),
            half: self.half.part(part),
        }
    }

    /// A block as f32: at least the first `planes` planes.
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
        if !self.is_narrow {
            return self.wide.block(block);
        }
        let narrow = (self.fixed.block(block), self.half.block(block));
        to_scratch(self.wide.block(block), narrow, planes, scratch);
        &scratch.0
    }
}

/// The blocks of a task.
#[derive(Debug)]
pub(super) struct ParameterTask<'a> {
    /// True if the stored format is not f32.
    pub(super) is_narrow: bool,
    wide: BlockTask<'a, f32>,
    fixed: BlockTask<'a, i16>,
    half: BlockTask<'a, F16>,
}

impl ParameterTask<'_> {
    /// A block as f32: at least the first `planes` planes.
    #[inline(always)]
    pub(super) fn open<'b>(
        &'b mut self,
        block: usize,
        planes: usize,
        scratch: &'b mut Scratch,
    ) -> &'b mut [f32] {
        if !self.is_narrow {
            return self.wide.block(block);
        }
        let narrow = (&*self.fixed.block(block), &*self.half.block(block));
        to_scratch(self.wide.block(block), narrow, planes, scratch);
        &mut scratch.0
    }

    /// Converts the opened planes back to the stored formats, if these are not f32.
    #[inline(always)]
    pub(super) fn close(
        &mut self,
        block: usize,
        planes: usize,
        scratch: &Scratch,
        draws: &mut Draws,
    ) {
        if !self.is_narrow {
            return;
        }
        let all = &scratch.0[..planes * WIDTH];
        let (means, rest) = all.split_at(MEANS * WIDTH);
        let (bounded, colour) = rest.split_at(BOUNDED * WIDTH);
        self.wide.block(block).copy_from_slice(means);
        let to = self.fixed.block(block).as_chunks_mut().0;
        for (i, (from, to)) in bounded.as_chunks().0.iter().zip(to).enumerate() {
            narrow_fixed(from, to, fractional_bits(i), draws);
        }
        narrow(colour, &mut self.half.block(block)[..colour.len()], draws);
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
        widen_fixed(from, to, fractional_bits(i));
    }
    widen(&half[..colour.len()], colour);
}
