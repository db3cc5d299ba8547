//! Parameters in blocks of sixteen rows: `[block][plane][lane]`.
//!
//! A kernel works on sixteen rows at a time and finds each parameter of theirs in one aligned
//! line; a thread owns whole blocks, so that stages split without locks; and one row's parameters
//! lie within four kilobytes, where planes over all rows would touch sixty pages.
//!
//! Parameters and moments may be [stored](crate::Storage) in fewer bits. A kernel then
//! widens the planes of a block that it needs to an array of f32 and works on that; see
//! [`Parameters`](super::parameters::Parameters) and [`Moments`](super::moments::Moments).

use std::ops::Range;

use rayon::prelude::*;

use super::simd::WIDTH;
use super::{BLOCKS_PER_TASK, ROWS_PER_TASK};
use densify_core::gaussians::sh_coefficients;

/// First plane of each parameter class.
pub(super) mod plane {
    pub(in super::super) const MEAN: usize = 0;
    pub(in super::super) const LOG_SCALE: usize = 3;
    pub(in super::super) const QUAT: usize = 6;
    pub(in super::super) const OPACITY: usize = 10;
    /// Coefficient k of channel c is plane SH + 3k + c.
    pub(in super::super) const SH: usize = 11;
    /// First plane of bands 1–3.
    pub(in super::super) const SH_REST: usize = SH + 3;
    /// Planes at degree 3.
    pub(in super::super) const MOST: usize = 59;
}

/// Planes per row at a spherical-harmonic degree.
pub(super) const fn planes(sh_degree: u8) -> usize {
    plane::SH + 3 * sh_coefficients(sh_degree)
}

/// Numbers of whole planes of a block, as a kernel reads them: an array that they are widened to.
#[derive(Clone)]
#[repr(align(64))]
pub(super) struct Scratch(pub(super) [f32; plane::MOST * WIDTH]);

impl Scratch {
    pub(super) const ZERO: Self = Self([0.0; plane::MOST * WIDTH]);
}

/// Rows of `planes` numbers each, from a first one on: those before it have none.
#[derive(Debug, Clone)]
pub(super) struct Blocks<T = f32> {
    planes: usize,
    /// A multiple of [`ROWS_PER_TASK`], so that blocks and tasks are those of all rows.
    first: usize,
    data: Vec<T>,
}

impl<T: Copy + Default> Blocks<T> {
    pub(super) fn zeros(rows: Range<usize>, planes: usize) -> Self {
        assert!(rows.start.is_multiple_of(ROWS_PER_TASK), "the first row is {}", rows.start);
        let data = vec![T::default(); rows.len().next_multiple_of(WIDTH) * planes];
        Self { planes, first: rows.start, data }
    }

    /// Bytes for these rows.
    pub(super) fn bytes(rows: Range<usize>, planes: usize) -> u64 {
        (rows.len().next_multiple_of(WIDTH) * planes * size_of::<T>()) as u64
    }

    /// Bytes that are there.
    #[cfg(test)]
    pub(super) fn held(&self) -> u64 {
        (self.data.capacity() * size_of::<T>()) as u64
    }

    /// Numbers per block.
    pub(super) fn stride(&self) -> usize {
        self.planes * WIDTH
    }

    /// Numbers per row.
    pub(super) fn planes(&self) -> usize {
        self.planes
    }

    /// The first row that has numbers.
    pub(super) fn first(&self) -> usize {
        self.first
    }

    /// Numbers of the blocks that hold the rows before `rows`.
    fn numbers(&self, rows: usize) -> usize {
        rows.saturating_sub(self.first).div_ceil(WIDTH) * self.stride()
    }

    /// The blocks that hold the rows before `rows`.
    pub(super) fn of_rows_mut(&mut self, rows: usize) -> &mut [T] {
        let numbers = self.numbers(rows);
        &mut self.data[..numbers]
    }

    /// The same, to be read block by block.
    pub(super) fn view(&self, rows: usize) -> BlockView<'_, T> {
        BlockView { stride: self.stride(), data: &self.data[..self.numbers(rows)] }
    }

    /// The same, cut for the optimiser's tasks.
    pub(super) fn tasks(
        &mut self,
        rows: usize,
    ) -> impl IndexedParallelIterator<Item = BlockTask<'_, T>>
    where
        T: Send,
    {
        let stride = self.stride();
        let tasks = rows.saturating_sub(self.first).div_ceil(ROWS_PER_TASK);
        let parts = parts(self.of_rows_mut(rows), stride * BLOCKS_PER_TASK, tasks);
        parts.map(move |data| BlockTask { stride, data })
    }

    fn at(&self, row: usize, plane: usize) -> usize {
        debug_assert!(plane < self.planes, "plane {plane} of {}", self.planes);
        let row = row - self.first;
        row / WIDTH * self.stride() + plane * WIDTH + row % WIDTH
    }

    pub(super) fn get(&self, row: usize, plane: usize) -> T {
        self.data[self.at(row, plane)]
    }

    pub(super) fn set(&mut self, row: usize, plane: usize, value: T) {
        let at = self.at(row, plane);
        self.data[at] = value;
    }

    pub(super) fn copy_row(&mut self, from: usize, to: usize) {
        for plane in 0..self.planes {
            self.set(to, plane, self.get(from, plane));
        }
    }

    /// Row i becomes what row `order[i]` was; rows before the first are where they were.
    pub(super) fn reorder(&mut self, order: &[u32]) {
        let order = order.get(self.first..).unwrap_or_default();
        let mut values = vec![T::default(); order.len()];
        // Plane by plane: rows mostly move a little, so that what is read lies mostly in a row.
        for plane in 0..self.planes {
            for (value, &row) in values.iter_mut().zip(order) {
                *value = self.get(row as usize, plane);
            }
            for (row, &value) in (self.first..).zip(&values) {
                self.set(row, plane, value);
            }
        }
    }

    pub(super) fn clear_row(&mut self, row: usize) {
        for plane in 0..self.planes {
            self.set(row, plane, T::default());
        }
    }

    /// Some planes of some rows, row by row; zeros of rows before the first. Shape: `[rows.len(), planes.len()]`.
    pub(super) fn to_rows(&self, rows: Range<usize>, planes: Range<usize>) -> Vec<T> {
        let mut values = Vec::with_capacity(rows.len() * planes.len());
        let without = rows.end.min(self.first).saturating_sub(rows.start);
        values.resize(without * planes.len(), T::default());
        for row in rows.start + without..rows.end {
            values.extend(planes.clone().map(|plane| self.get(row, plane)));
        }
        values
    }

    /// The opposite of [`to_rows`](Self::to_rows).
    pub(super) fn set_rows(&mut self, rows: Range<usize>, planes: Range<usize>, values: &[T]) {
        let without = rows.end.min(self.first).saturating_sub(rows.start);
        let mut values = values.iter().skip(without * planes.len());
        for row in rows.start + without..rows.end {
            for (plane, &value) in planes.clone().zip(&mut values) {
                self.set(row, plane, value);
            }
        }
    }
}

/// Blocks that follow each other, to read.
#[derive(Debug, Clone, Copy)]
pub(super) struct BlockView<'a, T> {
    stride: usize,
    data: &'a [T],
}

impl<'a, T> BlockView<'a, T> {
    /// Those of some numbers, from 0 on.
    pub(super) fn part(self, blocks: Range<usize>) -> Self {
        let data = &self.data[blocks.start * self.stride..blocks.end * self.stride];
        Self { data, ..self }
    }

    /// The one of a number, from 0 on.
    #[inline(always)]
    pub(super) fn block(&self, block: usize) -> &'a [T] {
        &self.data[block * self.stride..(block + 1) * self.stride]
    }
}

/// Blocks that follow each other, to change.
#[derive(Debug)]
pub(super) struct BlockTask<'a, T> {
    stride: usize,
    data: &'a mut [T],
}

impl<T> BlockTask<'_, T> {
    /// The one of a number, from 0 on.
    #[inline(always)]
    pub(super) fn block(&mut self, block: usize) -> &mut [T] {
        &mut self.data[block * self.stride..(block + 1) * self.stride]
    }
}

/// Cuts a buffer for so many tasks of a region, into parts of one length but the last; a buffer of nothing
/// has nothing for each task.
///
/// It is one type whatever the buffer has: were it one of two iterators, a region over ten buffers would be
/// compiled for each of their thousand combinations.
pub(super) fn parts<T: Send>(
    buffer: &mut [T],
    per_task: usize,
    tasks: usize,
) -> impl IndexedParallelIterator<Item = &mut [T]> {
    assert!(buffer.len() <= per_task * tasks, "{} over {per_task} · {tasks}", buffer.len());
    let per_task = per_task.max(1);
    let without = buffer.len().div_ceil(per_task)..tasks;
    let nothing = without.into_par_iter().map(|_| <&mut [T]>::default());
    buffer.par_chunks_mut(per_task).chain(nothing)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parts_are_chunks_and_nothing_where_there_is_nothing() {
        for length in [1, 6, 7, 63, 64] {
            let mut numbers: Vec<usize> = (0..length).collect();
            let chunks: Vec<Vec<usize>> = numbers.chunks(7).map(<[_]>::to_vec).collect();
            let found: Vec<Vec<usize>> =
                parts(&mut numbers, 7, chunks.len()).map(|part| part.to_vec()).collect();
            assert_eq!(found, chunks);
        }
        let nothing: &mut [u8] = &mut [];
        let lengths: Vec<usize> = parts(nothing, 0, 5).map(|part| part.len()).collect();
        assert_eq!(lengths, [0; 5]);
    }
}
