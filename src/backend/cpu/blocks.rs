//! Parameters in blocks of sixteen rows: `[block][plane][lane]`.
//!
//! A kernel works on sixteen rows at a time and finds each parameter of theirs in one aligned
//! line; a thread owns whole blocks, so that stages split without locks; and one row's parameters
//! lie within four kilobytes, where planes over all rows would touch sixty pages.

use std::ops::Range;

use super::simd::WIDTH;
use crate::gaussians::{Gaussians, sh_coefficients};

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

/// `capacity` rows of `planes` numbers each.
#[derive(Debug, Clone)]
pub(super) struct Blocks {
    planes: usize,
    data: Vec<f32>,
}

impl Blocks {
    pub(super) fn zeros(capacity: usize, planes: usize) -> Self {
        Self { planes, data: vec![0.0; capacity.div_ceil(WIDTH) * WIDTH * planes] }
    }

    /// Bytes for `capacity` rows.
    pub(super) fn bytes(capacity: usize, planes: usize) -> u64 {
        (capacity.div_ceil(WIDTH) * WIDTH * planes * size_of::<f32>()) as u64
    }

    /// Numbers per block.
    pub(super) fn stride(&self) -> usize {
        self.planes * WIDTH
    }

    /// The blocks that hold rows `0..rows`.
    pub(super) fn of_rows(&self, rows: usize) -> &[f32] {
        &self.data[..rows.div_ceil(WIDTH) * self.stride()]
    }

    /// The blocks that hold rows `0..rows`.
    pub(super) fn of_rows_mut(&mut self, rows: usize) -> &mut [f32] {
        let end = rows.div_ceil(WIDTH) * self.stride();
        &mut self.data[..end]
    }

    fn at(&self, row: usize, plane: usize) -> usize {
        (row / WIDTH * self.planes + plane) * WIDTH + row % WIDTH
    }

    pub(super) fn get(&self, row: usize, plane: usize) -> f32 {
        self.data[self.at(row, plane)]
    }

    pub(super) fn set(&mut self, row: usize, plane: usize, value: f32) {
        let at = self.at(row, plane);
        self.data[at] = value;
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

    pub(super) fn copy_row(&mut self, from: usize, to: usize) {
        for plane in 0..self.planes {
            self.set(to, plane, self.get(from, plane));
        }
    }

    pub(super) fn clear_row(&mut self, row: usize) {
        for plane in 0..self.planes {
            self.set(row, plane, 0.0);
        }
    }

    /// Some planes of the first `rows` rows, row by row. Shape: `[rows, planes.len()]`.
    pub(super) fn to_rows(&self, rows: usize, planes: Range<usize>) -> Vec<f32> {
        (0..rows).flat_map(|row| planes.clone().map(move |p| self.get(row, p))).collect()
    }

    /// The opposite of [`to_rows`](Self::to_rows).
    pub(super) fn set_rows(&mut self, rows: usize, planes: Range<usize>, values: &[f32]) {
        let mut values = values.iter();
        for row in 0..rows {
            for (plane, &value) in planes.clone().zip(&mut values) {
                self.set(row, plane, value);
            }
        }
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
}
