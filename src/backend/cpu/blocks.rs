//! Parameters in blocks of sixteen rows: `[block][plane][lane]`.
//!
//! A kernel works on sixteen rows at a time and finds each parameter of theirs in one aligned
//! line; a thread owns whole blocks, so that stages split without locks; and one row's parameters
//! lie within four kilobytes, where planes over all rows would touch sixty pages.
//!
//! Parameters and moments may be [stored](crate::backend::Storage) in fewer bits. A kernel then
//! widens the planes of a block that it needs to an array of f32 and works on that; see
//! [`Parameters`](super::parameters::Parameters) and [`Moments`](super::moments::Moments).

use std::ops::Range;

use super::simd::WIDTH;
use crate::gaussians::sh_coefficients;

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

/// `capacity` rows of `planes` numbers each.
#[derive(Debug, Clone)]
pub(super) struct Blocks<T = f32> {
    planes: usize,
    data: Vec<T>,
}

impl<T: Copy + Default> Blocks<T> {
    pub(super) fn zeros(capacity: usize, planes: usize) -> Self {
        Self { planes, data: vec![T::default(); capacity.div_ceil(WIDTH) * WIDTH * planes] }
    }

    /// Bytes for `capacity` rows.
    pub(super) fn bytes(capacity: usize, planes: usize) -> u64 {
        (capacity.div_ceil(WIDTH) * WIDTH * planes * size_of::<T>()) as u64
    }

    /// Bytes that are there.
    #[cfg(test)]
    pub(super) fn held(&self) -> u64 {
        size_of_val(&self.data[..]) as u64
    }

    /// Numbers per block.
    pub(super) fn stride(&self) -> usize {
        self.planes * WIDTH
    }

    /// The blocks that hold rows `0..rows`.
    pub(super) fn of_rows(&self, rows: usize) -> &[T] {
        &self.data[..rows.div_ceil(WIDTH) * self.stride()]
    }

    /// The blocks that hold rows `0..rows`.
    pub(super) fn of_rows_mut(&mut self, rows: usize) -> &mut [T] {
        let end = rows.div_ceil(WIDTH) * self.stride();
        &mut self.data[..end]
    }

    fn at(&self, row: usize, plane: usize) -> usize {
        (row / WIDTH * self.planes + plane) * WIDTH + row % WIDTH
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

    pub(super) fn clear_row(&mut self, row: usize) {
        for plane in 0..self.planes {
            self.set(row, plane, T::default());
        }
    }

    /// Some planes of the first `rows` rows, row by row. Shape: `[rows, planes.len()]`.
    pub(super) fn to_rows(&self, rows: usize, planes: Range<usize>) -> Vec<T> {
        (0..rows).flat_map(|row| planes.clone().map(move |p| self.get(row, p))).collect()
    }

    /// The opposite of [`to_rows`](Self::to_rows).
    pub(super) fn set_rows(&mut self, rows: usize, planes: Range<usize>, values: &[T]) {
        let mut values = values.iter();
        for row in 0..rows {
            for (plane, &value) in planes.clone().zip(&mut values) {
                self.set(row, plane, value);
            }
        }
    }
}
