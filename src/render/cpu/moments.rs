//! Adam's two moments: as f32, or in a byte each; see [`MomentStorage`].
//!
//! The first moment is at most 7.3 times the root of the second, whatever the gradients were. A step uses only
//! this ratio, and [`MomentStorage::Both8`] stores it in place of the first moment, in steps of 0.057.
//! If gradients are pure noise, the ratio is about 0.23, and rounding increases its variance by 5 %. Numbers share
//! no scale, so that an outlier cannot spoil its neighbours.

use std::ops::Range;

use rayon::prelude::*;

use super::blocks::{BlockTask, BlockView, Blocks, RowEdit, Scratch};
use super::narrow::{Draws, F8, Narrow, first_moment, first_moments, narrow, ratios, widen};
use super::simd::WIDTH;
use crate::{MomentStorage, StateError, Tensor};

/// The moments of the trainable rows.
#[derive(Debug)]
pub(super) struct Moments {
    /// The first and the second moments; no planes if they are stored in bytes.
    wide: [Blocks; 2],
    /// The first moments as multiples of the roots of the second, if they are stored in bytes.
    ratios: Blocks<i8>,
    /// The second moments, if they are stored in bytes.
    seconds: Blocks<F8>,
}

/// Numbers of planes stored as f32 and in bytes.
fn split(planes: usize, storage: MomentStorage) -> [usize; 2] {
    match storage {
        MomentStorage::F32 => [planes, 0],
        MomentStorage::Both8 => [0, planes],
    }
}

impl Moments {
    pub(super) fn zeros(rows: Range<usize>, planes: usize, storage: MomentStorage) -> Self {
        let [wide, narrow] = split(planes, storage);
        Self {
            wide: [0, 1].map(|_| Blocks::zeros(rows.clone(), wide)),
            ratios: Blocks::zeros(rows.clone(), narrow),
            seconds: Blocks::zeros(rows, narrow),
        }
    }

    /// Bytes for a range of rows.
    pub(super) fn bytes(rows: Range<usize>, planes: usize, storage: MomentStorage) -> u64 {
        let [wide, narrow] = split(planes, storage);
        2 * (Blocks::<f32>::bytes(rows.clone(), wide) + Blocks::<F8>::bytes(rows, narrow))
    }

    /// Allocated bytes.
    #[cfg(test)]
    pub(super) fn allocated_bytes(&self) -> u64 {
        let wide: u64 = self.wide.iter().map(Blocks::allocated_bytes).sum();
        wide + self.ratios.allocated_bytes() + self.seconds.allocated_bytes()
    }

    /// The first row with moments.
    pub(super) fn first(&self) -> usize {
        self.ratios.first
    }

    fn is_narrow(&self) -> bool {
        self.ratios.planes > 0
    }

    pub(super) fn edit(&mut self, edit: RowEdit<'_>) {
        self.wide.iter_mut().for_each(|blocks| blocks.edit(edit));
        self.ratios.edit(edit);
        self.seconds.edit(edit);
    }

    /// Resets the moments of one parameter.
    pub(super) fn reset(&mut self, row: usize, plane: usize) {
        if self.is_narrow() {
            self.ratios.set(row, plane, 0);
            self.seconds.set(row, plane, F8::default());
        } else {
            self.wide.iter_mut().for_each(|blocks| blocks.set(row, plane, 0.0));
        }
    }

    /// The first and the second moment of one parameter.
    pub(super) fn get(&self, row: usize, plane: usize) -> [f32; 2] {
        if !self.is_narrow() {
            return self.wide.each_ref().map(|blocks| blocks.get(row, plane));
        }
        let second = self.seconds.get(row, plane).to_f32();
        [first_moment(self.ratios.get(row, plane), second), second]
    }

    /// A read-only view of the blocks of the first `rows` rows.
    pub(super) fn view(&self, rows: usize) -> MomentView<'_> {
        MomentView {
            is_narrow: self.is_narrow(),
            wide: self.wide.each_ref().map(|blocks| blocks.view(rows)),
            ratios: self.ratios.view(rows),
            seconds: self.seconds.view(rows),
        }
    }

    /// The blocks of the first `rows` rows, split for the optimiser's tasks.
    pub(super) fn tasks(
        &mut self,
        rows: usize,
    ) -> impl IndexedParallelIterator<Item = MomentTask<'_>> {
        let is_narrow = self.is_narrow();
        let Self { wide: [first, second], ratios, seconds } = self;
        let all = (first.tasks(rows), second.tasks(rows), ratios.tasks(rows), seconds.tasks(rows));
        all.into_par_iter().map(move |(first, second, ratios, seconds)| MomentTask {
            is_narrow,
            wide: [first, second],
            ratios,
            seconds,
        })
    }

    /// The first (`moment` 0) or second (1) moments of some rows as they are stored: f32, or ratios in two's complement
    /// and codes of [`F8`]. Shape: `[rows.len(), planes]`.
    pub(super) fn tensor(
        &self,
        moment: usize,
        name: &str,
        rows: Range<usize>,
        planes: usize,
    ) -> Tensor {
        let (shape, planes) = ([rows.len(), planes], 0..planes);
        if !self.is_narrow() {
            return Tensor::f32(name, &shape, self.wide[moment].to_rows(rows, planes));
        }
        let codes = if moment == 0 {
            self.ratios.to_rows(rows, planes).into_iter().map(i8::cast_unsigned).collect()
        } else {
            self.seconds.to_rows(rows, planes).into_iter().map(|code| code.0).collect()
        };
        Tensor::u8(name, &shape, codes)
    }

    /// Restores an array that [`tensor`](Self::tensor) returned.
    pub(super) fn restore(
        &mut self,
        moment: usize,
        rows: Range<usize>,
        planes: usize,
        tensor: Tensor,
    ) -> Result<(), StateError> {
        let (shape, planes) = ([rows.len(), planes], 0..planes);
        if !self.is_narrow() {
            self.wide[moment].set_rows(rows, planes, &tensor.into_f32(&shape)?);
            return Ok(());
        }
        let codes = tensor.into_u8(&shape)?.into_iter();
        if moment == 0 {
            let ratios: Vec<i8> = codes.map(u8::cast_signed).collect();
            self.ratios.set_rows(rows, planes, &ratios);
        } else {
            self.seconds.set_rows(rows, planes, &codes.map(F8).collect::<Vec<F8>>());
        }
        Ok(())
    }
}

/// A read-only view of the moments of some blocks.
#[derive(Debug, Clone, Copy)]
pub(super) struct MomentView<'a> {
    is_narrow: bool,
    wide: [BlockView<'a, f32>; 2],
    ratios: BlockView<'a, i8>,
    seconds: BlockView<'a, F8>,
}

impl<'a> MomentView<'a> {
    /// Both moments of a block as f32: at least the first `planes` planes.
    pub(super) fn open<'b>(
        self,
        block: usize,
        planes: usize,
        scratch: &'b mut [Scratch; 2],
    ) -> [&'b [f32]; 2]
    where
        'a: 'b,
    {
        if !self.is_narrow {
            return self.wide.map(|blocks| blocks.block(block));
        }
        to_scratch(self.ratios.block(block), self.seconds.block(block), planes, scratch);
        let [m, v] = scratch;
        [&m.0, &v.0]
    }
}

/// The moments of a task's blocks.
#[derive(Debug)]
pub(super) struct MomentTask<'a> {
    /// True if the stored format is not f32.
    pub(super) is_narrow: bool,
    wide: [BlockTask<'a, f32>; 2],
    ratios: BlockTask<'a, i8>,
    seconds: BlockTask<'a, F8>,
}

impl MomentTask<'_> {
    /// Both moments of a block as f32: at least the first `planes` planes.
    #[inline(always)]
    pub(super) fn open<'b>(
        &'b mut self,
        block: usize,
        planes: usize,
        scratch: &'b mut [Scratch; 2],
    ) -> [&'b mut [f32]; 2] {
        if !self.is_narrow {
            let [first, second] = &mut self.wide;
            return [first.block(block), second.block(block)];
        }
        to_scratch(self.ratios.block(block), self.seconds.block(block), planes, scratch);
        let [m, v] = scratch;
        [&mut m.0, &mut v.0]
    }

    /// Converts the opened planes back to the stored format, if this is not f32. First moments become multiples of the
    /// roots of the rounded second moments.
    #[inline(always)]
    pub(super) fn close(
        &mut self,
        block: usize,
        planes: usize,
        [m, v]: &[Scratch; 2],
        [m_draws, v_draws]: [&mut Draws; 2],
    ) {
        if !self.is_narrow {
            return;
        }
        let used = planes * WIDTH;
        let second = &mut self.seconds.block(block)[..used];
        narrow(&v.0[..used], second, v_draws);
        ratios(&m.0[..used], second, &mut self.ratios.block(block)[..used], m_draws);
    }
}

#[inline(always)]
fn to_scratch(ratios: &[i8], seconds: &[F8], planes: usize, [m, v]: &mut [Scratch; 2]) {
    let used = planes * WIDTH;
    let v = &mut v.0[..used];
    widen(&seconds[..used], v);
    first_moments(&ratios[..used], v, &mut m.0[..used]);
}
