//! Parameters in blocks of sixteen rows: `[block][plane][lane]`. A plane is one parameter, a lane one row of the block.
//!
//! A kernel processes sixteen rows at a time and finds each of their parameters in one aligned cache line. A thread
//! owns whole blocks, so that stages need no locks. The parameters of a row are within four kilobytes, while planes
//! over all rows would touch sixty pages.
//!
//! Parameters and moments may be [stored](crate::Storage) in fewer bits. A kernel then
//! converts the planes that it needs to an array of f32 and works on that; see
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
    /// Number of planes at degree 3.
    pub(in super::super) const MOST: usize = 59;
}

/// Number of planes at a spherical-harmonic degree.
pub(super) const fn planes(sh_degree: u8) -> usize {
    plane::SH + 3 * sh_coefficients(sh_degree)
}

/// Scratch memory for the planes of a block, converted to f32.
#[derive(Clone)]
#[repr(align(64))]
pub(super) struct Scratch(pub(super) [f32; plane::MOST * WIDTH]);

impl Scratch {
    pub(super) const ZERO: Self = Self([0.0; plane::MOST * WIDTH]);
}

/// An edit of whole rows, which is applied to every array of rows in the same way.
#[derive(Debug, Clone, Copy)]
pub(super) enum RowEdit<'a> {
    /// Sets a row to 0.
    Clear(usize),
    /// Copies the stored bits of a row to another: from, to.
    Copy(usize, usize),
    /// Moves row `order[i]` to row i.
    Reorder(&'a [u32]),
}

/// Rows of `planes` numbers each, from a first row on; earlier rows are not stored.
#[derive(Debug, Clone)]
pub(super) struct Blocks<T = f32> {
    /// Numbers per row.
    pub(super) planes: usize,
    /// The first row, a multiple of [`ROWS_PER_TASK`], so that blocks and tasks are aligned with those of arrays that
    /// store all rows.
    pub(super) first: usize,
    data: Vec<T>,
}

impl<T: Copy + Default> Blocks<T> {
    pub(super) fn zeros(rows: Range<usize>, planes: usize) -> Self {
        assert!(rows.start.is_multiple_of(ROWS_PER_TASK), "the first row is {}", rows.start);
        let data = vec![T::default(); rows.len().next_multiple_of(WIDTH) * planes];
        Self { planes, first: rows.start, data }
    }

    /// Bytes for a range of rows.
    pub(super) fn bytes(rows: Range<usize>, planes: usize) -> u64 {
        (rows.len().next_multiple_of(WIDTH) * planes * size_of::<T>()) as u64
    }

    /// Allocated bytes.
    #[cfg(test)]
    pub(super) fn allocated_bytes(&self) -> u64 {
        (self.data.capacity() * size_of::<T>()) as u64
    }

    /// Numbers per block.
    pub(super) fn stride(&self) -> usize {
        self.planes * WIDTH
    }

    /// Numbers in the blocks of the rows before row `rows`.
    fn numbers(&self, rows: usize) -> usize {
        rows.saturating_sub(self.first).div_ceil(WIDTH) * self.stride()
    }

    /// The blocks of the rows before row `rows`.
    pub(super) fn of_rows_mut(&mut self, rows: usize) -> &mut [T] {
        let numbers = self.numbers(rows);
        &mut self.data[..numbers]
    }

    /// A read-only view of the blocks of the rows before row `rows`.
    pub(super) fn view(&self, rows: usize) -> BlockView<'_, T> {
        BlockView { stride: self.stride(), data: &self.data[..self.numbers(rows)] }
    }

    /// The blocks of the rows before row `rows`, split for the optimiser's tasks.
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

    pub(super) fn edit(&mut self, edit: RowEdit<'_>) {
        let planes = 0..self.planes;
        match edit {
            RowEdit::Clear(row) => planes.for_each(|plane| self.set(row, plane, T::default())),
            RowEdit::Copy(from, to) => {
                planes.for_each(|plane| self.set(to, plane, self.get(from, plane)));
            }
            RowEdit::Reorder(order) => self.reorder(order),
        }
    }

    /// Moves row `order[i]` to row i, for the rows that are stored.
    fn reorder(&mut self, order: &[u32]) {
        let order = order.get(self.first..).unwrap_or_default();
        let mut values = vec![T::default(); order.len()];
        // Plane by plane: most rows move only a little, so that most reads are sequential.
        for plane in 0..self.planes {
            for (value, &row) in values.iter_mut().zip(order) {
                *value = self.get(row as usize, plane);
            }
            for (row, &value) in (self.first..).zip(&values) {
                self.set(row, plane, value);
            }
        }
    }

    /// Copies some planes of some rows, row-major; 0 for rows that are not stored. Shape: `[rows.len(), planes.len()]`.
    pub(super) fn to_rows(&self, rows: Range<usize>, planes: Range<usize>) -> Vec<T> {
        let mut values = Vec::with_capacity(rows.len() * planes.len());
        let missing = rows.end.min(self.first).saturating_sub(rows.start);
        values.resize(missing * planes.len(), T::default());
        for row in rows.start + missing..rows.end {
            values.extend(planes.clone().map(|plane| self.get(row, plane)));
        }
        values
    }

    /// Sets the numbers that [`to_rows`](Self::to_rows) returns.
    pub(super) fn set_rows(&mut self, rows: Range<usize>, planes: Range<usize>, values: &[T]) {
        let missing = rows.end.min(self.first).saturating_sub(rows.start);
        let mut values = values.iter().skip(missing * planes.len());
        for row in rows.start + missing..rows.end {
            for (plane, &value) in planes.clone().zip(&mut values) {
                self.set(row, plane, value);
            }
        }
    }
}

/// A read-only view of consecutive blocks.
#[derive(Debug, Clone, Copy)]
pub(super) struct BlockView<'a, T> {
    stride: usize,
    data: &'a [T],
}

impl<'a, T> BlockView<'a, T> {
    /// A range of the blocks.
    pub(super) fn part(self, blocks: Range<usize>) -> Self {
        let data = &self.data[blocks.start * self.stride..blocks.end * self.stride];
        Self { data, ..self }
    }

    /// A block by its index.
    #[inline(always)]
    pub(super) fn block(&self, block: usize) -> &'a [T] {
        &self.data[block * self.stride..(block + 1) * self.stride]
    }
}

/// The consecutive blocks of a task.
#[derive(Debug)]
pub(super) struct BlockTask<'a, T> {
    stride: usize,
    data: &'a mut [T],
}

impl<T> BlockTask<'_, T> {
    /// A block by its index.
    #[inline(always)]
    pub(super) fn block(&mut self, block: usize) -> &mut [T] {
        &mut self.data[block * self.stride..(block + 1) * self.stride]
    }
}

/// Splits a buffer into a part of `per_task` items for each task of a parallel loop. Where the buffer ends, parts are
/// shorter or empty.
///
/// The iterator's type is the same for buffers with and without data: with two types, a loop over ten buffers
/// would be compiled for each of a thousand combinations.
pub(super) fn parts<T: Send>(
    buffer: &mut [T],
    per_task: usize,
    tasks: usize,
) -> impl IndexedParallelIterator<Item = &mut [T]> {
    assert!(buffer.len() <= per_task * tasks, "{} over {per_task} · {tasks}", buffer.len());
    let per_task = per_task.max(1);
    let idle_tasks = buffer.len().div_ceil(per_task)..tasks;
    let nothing = idle_tasks.into_par_iter().map(|_| <&mut [T]>::default());
    buffer.par_chunks_mut(per_task).chain(nothing)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parts_are_chunks_and_an_empty_buffer_gives_empty_parts() {
        for length in [1, 6, 7, 63, 64] {
            let mut numbers: Vec<usize> = (0..length).collect();
            let chunks: Vec<Vec<usize>> = numbers.chunks(7).map(<[_]>::to_vec).collect();
            let parts: Vec<Vec<usize>> =
                parts(&mut numbers, 7, chunks.len()).map(|part| part.to_vec()).collect();
            assert_eq!(parts, chunks);
        }
        let nothing: &mut [u8] = &mut [];
        let lengths: Vec<usize> = parts(nothing, 0, 5).map(|part| part.len()).collect();
        assert_eq!(lengths, [0; 5]);
    }
}
