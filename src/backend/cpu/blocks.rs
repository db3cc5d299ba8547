//! Parameters in blocks of sixteen rows: `[block][plane][lane]`.
//!
//! A kernel works on sixteen rows at a time and finds each parameter of theirs in one aligned
//! line; a thread owns whole blocks, so that stages split without locks; and one row's parameters
//! lie within four kilobytes, where planes over all rows would touch sixty pages.
//!
//! Parameters and moments may be [stored](crate::backend::Storage) in fewer bits. A kernel then
//! widens the planes of a block that it needs to an array of f32 and works on that; see
//! [`Parameters`](super::parameters::Parameters) and [`Moments`](super::moments::Moments).
//!
//! Blocks may have [lost](super::row_degrees) bands of colour. Those that hold more of them come first, so
//! that three numbers say what every block holds ([`Degrees`]) and where it begins ([`Shape`]).

use std::ops::Range;

use super::BLOCKS_PER_TASK;
use super::simd::WIDTH;
use crate::gaussians::{MAX_SH_DEGREE, sh_coefficients};

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

/// Planes of bands 1, 2 and 3.
const BANDS: [usize; MAX_SH_DEGREE as usize] = [9, 15, 21];

/// The degree of colour of each block, which is nowhere higher than in the block before.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Degrees {
    /// How many blocks, the first ones, hold bands 1, 2 and 3.
    holding: [usize; BANDS.len()],
}

impl Degrees {
    /// Every block holds what the model has.
    pub(super) const ALL: Self = Self { holding: [usize::MAX; BANDS.len()] };

    /// Those of the first blocks, none higher than the one before; all others are as the last of these.
    /// [`ALL`](Self::ALL) where no block has less than the model.
    pub(super) fn falling(degrees: &[u8], of_model: u8) -> Self {
        let last = degrees.last().copied().unwrap_or(of_model);
        let holding = |band: u8| match degrees.partition_point(|&degree| degree >= band) {
            _ if last >= band => usize::MAX,
            count => count,
        };
        if last >= of_model { Self::ALL } else { Self { holding: [1, 2, 3].map(holding) } }
    }

    /// The degree of a block; 3, and so at least the model's, where nothing was dropped.
    #[inline(always)]
    pub(super) fn of(self, block: usize) -> u8 {
        self.holding.iter().map(|&blocks| u8::from(block < blocks)).sum()
    }
}

/// How many planes blocks have, and where they begin.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Shape {
    /// Planes that every block has.
    all: usize,
    /// How many blocks have each of [`BANDS`] beside these; not more than have the one before.
    more: [usize; BANDS.len()],
}

impl Shape {
    /// Planes before a block.
    #[inline(always)]
    fn before(self, block: usize) -> usize {
        if self.more[0] == 0 {
            return block * self.all;
        }
        let bands = self.more.iter().zip(BANDS).map(|(&blocks, band)| block.min(blocks) * band);
        block * self.all + bands.sum::<usize>()
    }

    /// Planes of a block.
    #[inline(always)]
    fn of(self, block: usize) -> usize {
        let bands = self.more.iter().zip(BANDS);
        self.all + bands.map(|(&blocks, band)| if block < blocks { band } else { 0 }).sum::<usize>()
    }

    /// Numbers of some blocks, in a slice that begins with block `first`.
    #[inline(always)]
    fn numbers(self, blocks: Range<usize>, first: usize) -> Range<usize> {
        let first = self.before(first);
        let [start, end] = [blocks.start, blocks.end].map(|b| (self.before(b) - first) * WIDTH);
        start..end
    }
}

/// Numbers of whole planes of a block, as a kernel reads them: an array that they are widened to.
#[derive(Clone)]
#[repr(align(64))]
pub(super) struct Scratch(pub(super) [f32; plane::MOST * WIDTH]);

impl Scratch {
    pub(super) const ZERO: Self = Self([0.0; plane::MOST * WIDTH]);
}

/// `capacity` rows of `planes` numbers each, but for what was [dropped](Self::drop_bands).
#[derive(Debug, Clone)]
pub(super) struct Blocks<T = f32> {
    planes: usize,
    shape: Shape,
    data: Vec<T>,
}

impl<T: Copy + Default> Blocks<T> {
    pub(super) fn zeros(capacity: usize, planes: usize) -> Self {
        let shape = Shape { all: planes, more: [0; BANDS.len()] };
        let data = vec![T::default(); capacity.div_ceil(WIDTH) * WIDTH * planes];
        Self { planes, shape, data }
    }

    /// Bytes for `capacity` rows.
    pub(super) fn bytes(capacity: usize, planes: usize) -> u64 {
        (capacity.div_ceil(WIDTH) * WIDTH * planes * size_of::<T>()) as u64
    }

    /// Bytes that are there.
    pub(super) fn held(&self) -> u64 {
        (self.data.capacity() * size_of::<T>()) as u64
    }

    /// Numbers per block that has all planes.
    pub(super) fn stride(&self) -> usize {
        self.planes * WIDTH
    }

    /// Planes of a block that has all.
    pub(super) fn planes(&self) -> usize {
        self.planes
    }

    /// The blocks that hold rows `0..rows`.
    pub(super) fn of_rows(&self, rows: usize) -> &[T] {
        &self.data[self.shape.numbers(0..rows.div_ceil(WIDTH), 0)]
    }

    /// The blocks that hold rows `0..rows`.
    pub(super) fn of_rows_mut(&mut self, rows: usize) -> &mut [T] {
        let numbers = self.shape.numbers(0..rows.div_ceil(WIDTH), 0);
        &mut self.data[numbers]
    }

    /// The same, to be read block by block.
    pub(super) fn view(&self, rows: usize) -> BlockView<'_, T> {
        BlockView { shape: self.shape, first: 0, data: self.of_rows(rows) }
    }

    /// The same, cut for the optimiser's tasks.
    pub(super) fn tasks(&mut self, rows: usize) -> Vec<BlockTask<'_, T>> {
        let (shape, blocks) = (self.shape, rows.div_ceil(WIDTH));
        let mut rest = self.of_rows_mut(rows);
        let cut = |first| {
            let end = blocks.min(first + BLOCKS_PER_TASK);
            let count = shape.numbers(first..end, first).end;
            let (data, after) = std::mem::take(&mut rest).split_at_mut(count);
            rest = after;
            BlockTask { shape, first, data }
        };
        (0..blocks).step_by(BLOCKS_PER_TASK).map(cut).collect()
    }

    /// Where a number is; `None` where its block does not hold the plane.
    fn at(&self, row: usize, plane: usize) -> Option<usize> {
        let (block, lane) = (row / WIDTH, row % WIDTH);
        (plane < self.shape.of(block)).then(|| (self.shape.before(block) + plane) * WIDTH + lane)
    }

    /// A number; 0 where it was dropped.
    pub(super) fn get(&self, row: usize, plane: usize) -> T {
        self.at(row, plane).map_or_else(T::default, |at| self.data[at])
    }

    /// Writes a number, where there is room for it.
    pub(super) fn set(&mut self, row: usize, plane: usize, value: T) {
        if let Some(at) = self.at(row, plane) {
            self.data[at] = value;
        }
    }

    /// Copies a row. It loses what its new block does not hold, and gets 0 for what the old one did not.
    pub(super) fn copy_row(&mut self, from: usize, to: usize) {
        for plane in 0..self.planes {
            self.set(to, plane, self.get(from, plane));
        }
    }

    pub(super) fn swap_rows(&mut self, a: usize, b: usize) {
        for plane in 0..self.planes {
            let (x, y) = (self.get(a, plane), self.get(b, plane));
            self.set(a, plane, y);
            self.set(b, plane, x);
        }
    }

    pub(super) fn clear_row(&mut self, row: usize) {
        for plane in 0..self.planes {
            self.set(row, plane, T::default());
        }
    }

    /// Drops the bands of colour that blocks do not hold any more, in place, and gives the memory back.
    /// Nothing may have been dropped before. `rows` are in use.
    ///
    /// What is behind them is not read: most of it has never been touched, and shall not become
    /// resident now.
    pub(super) fn drop_bands(&mut self, rows: usize, of_model: u8, degrees: Degrees) {
        let bands: usize = BANDS[..usize::from(of_model)].iter().sum();
        let Some(all) = self.planes.checked_sub(bands).filter(|_| degrees != Degrees::ALL) else {
            return;
        };
        let (was, shape) = (self.shape, Shape { all, more: degrees.holding });
        assert_eq!(was.all, self.planes, "bands are dropped once");
        let (live, blocks) = (rows.div_ceil(WIDTH), self.data.len() / self.stride().max(1));
        for block in 0..live {
            let (from, to) = (was.before(block) * WIDTH, shape.numbers(block..block + 1, 0));
            // Never behind where it was, and so on nothing that is still to be read.
            self.data.copy_within(from..from + to.len(), to.start);
        }
        let end = shape.before(blocks) * WIDTH;
        let left = shape.before(live) * WIDTH..end.min(was.before(live) * WIDTH);
        self.data[left].fill(T::default());
        self.data.truncate(end);
        self.data.shrink_to_fit();
        self.shape = shape;
    }

    /// Some planes of some rows, row by row. Shape: `[rows.len(), planes.len()]`.
    pub(super) fn to_rows(&self, rows: Range<usize>, planes: Range<usize>) -> Vec<T> {
        let mut values = Vec::with_capacity(rows.len() * planes.len());
        for row in rows {
            values.extend(planes.clone().map(|plane| self.get(row, plane)));
        }
        values
    }

    /// The opposite of [`to_rows`](Self::to_rows).
    pub(super) fn set_rows(&mut self, rows: Range<usize>, planes: Range<usize>, values: &[T]) {
        let mut values = values.iter();
        for row in rows {
            for (plane, &value) in planes.clone().zip(&mut values) {
                self.set(row, plane, value);
            }
        }
    }
}

/// Blocks that follow each other, to read.
#[derive(Debug, Clone, Copy)]
pub(super) struct BlockView<'a, T> {
    shape: Shape,
    first: usize,
    data: &'a [T],
}

impl<'a, T> BlockView<'a, T> {
    /// Those of some numbers, from 0 on.
    pub(super) fn part(self, blocks: Range<usize>) -> Self {
        let Self { shape, first, data } = self;
        let blocks = first + blocks.start..first + blocks.end;
        Self { shape, first: blocks.start, data: &data[shape.numbers(blocks, first)] }
    }

    /// The one of a number, from 0 on.
    #[inline(always)]
    pub(super) fn block(&self, block: usize) -> &'a [T] {
        let Self { shape, first, data } = *self;
        &data[shape.numbers(first + block..first + block + 1, first)]
    }
}

/// Blocks that follow each other, to change.
#[derive(Debug)]
pub(super) struct BlockTask<'a, T> {
    shape: Shape,
    first: usize,
    data: &'a mut [T],
}

impl<T> BlockTask<'_, T> {
    /// The one of a number, from 0 on.
    #[inline(always)]
    pub(super) fn block(&mut self, block: usize) -> &mut [T] {
        let Self { shape, first, ref mut data } = *self;
        &mut data[shape.numbers(first + block..first + block + 1, first)]
    }
}

#[cfg(test)]
mod tests;
