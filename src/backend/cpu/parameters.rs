//! The model's parameters: f32 in blocks, or the means so and all other planes as f16.
//!
//! Kernels read and write planes of f32. Where a block is f32 they get the block itself; else its
//! planes are widened to an array ([`open`](ParameterTask::open)) and stored from it, rounded at
//! random ([`close`](ParameterTask::close)). Edits, which happen once, are rounded to the nearest.

use super::blocks::{Blocks, Scratch, plane};
use super::narrow::{Draws, F16, Narrow, narrow, widen};
use super::passes::parts;
use super::simd::WIDTH;
use super::{BLOCKS_PER_TASK, ROWS_PER_TASK};
use crate::backend::ParameterStorage;
use crate::gaussians::{Gaussians, sh_coefficients};

/// Planes of means: the ones that are f32 in any case.
const MEANS: usize = plane::LOG_SCALE;

/// The parameters of all rows.
#[derive(Debug)]
pub(super) struct Parameters {
    /// All planes, or the means.
    wide: Blocks,
    /// None, or all planes after the means.
    narrow: Blocks<F16>,
}

/// Planes of f32 and of f16.
fn split(planes: usize, storage: ParameterStorage) -> [usize; 2] {
    match storage {
        ParameterStorage::F32 => [planes, 0],
        ParameterStorage::F16 => [MEANS, planes - MEANS],
    }
}

impl Parameters {
    pub(super) fn zeros(capacity: usize, planes: usize, storage: ParameterStorage) -> Self {
        let [wide, narrow] = split(planes, storage);
        Self { wide: Blocks::zeros(capacity, wide), narrow: Blocks::zeros(capacity, narrow) }
    }

    /// Bytes for `capacity` rows.
    pub(super) fn bytes(capacity: usize, planes: usize, storage: ParameterStorage) -> u64 {
        let [wide, narrow] = split(planes, storage);
        Blocks::<f32>::bytes(capacity, wide) + Blocks::<F16>::bytes(capacity, narrow)
    }

    /// Planes of f32; where there are more, they are f16.
    fn wide_planes(&self) -> usize {
        self.wide.stride() / WIDTH
    }

    fn planes(&self) -> usize {
        (self.wide.stride() + self.narrow.stride()) / WIDTH
    }

    pub(super) fn get(&self, row: usize, plane: usize) -> f32 {
        match plane.checked_sub(self.wide_planes()) {
            None => self.wide.get(row, plane),
            Some(plane) => self.narrow.get(row, plane).to_f32(),
        }
    }

    pub(super) fn set(&mut self, row: usize, plane: usize, value: f32) {
        match plane.checked_sub(self.wide_planes()) {
            None => self.wide.set(row, plane, value),
            Some(plane) => self.narrow.set(row, plane, F16::nearest(value)),
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
        self.narrow.copy_row(from, to);
    }

    pub(super) fn clear_row(&mut self, row: usize) {
        self.wide.clear_row(row);
        self.narrow.clear_row(row);
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
            planes: self.planes(),
            strides: [self.wide.stride(), self.narrow.stride()],
            wide: self.wide.of_rows(rows),
            narrow: self.narrow.of_rows(rows),
        }
    }

    /// The blocks of the first `rows` rows, cut for so many of the optimiser's tasks.
    pub(super) fn tasks(&mut self, rows: usize, tasks: usize) -> Vec<ParameterTask<'_>> {
        let strides = [self.wide.stride(), self.narrow.stride()];
        let wide = parts(self.wide.of_rows_mut(rows), strides[0] * BLOCKS_PER_TASK, tasks);
        let narrow = parts(self.narrow.of_rows_mut(rows), strides[1] * BLOCKS_PER_TASK, tasks);
        let both = wide.into_iter().zip(narrow);
        both.map(|(wide, narrow)| ParameterTask { strides, wide, narrow }).collect()
    }
}

/// Some blocks, to read.
#[derive(Debug, Clone, Copy)]
pub(super) struct ParameterView<'a> {
    planes: usize,
    /// Numbers per block of the two below.
    strides: [usize; 2],
    wide: &'a [f32],
    narrow: &'a [F16],
}

impl<'a> ParameterView<'a> {
    /// The blocks of task `i`, each of `ROWS_PER_TASK` rows but the last.
    pub(super) fn task(self, i: usize) -> Self {
        let from = |len: usize, stride: usize| {
            let per_task = stride * BLOCKS_PER_TASK;
            (i * per_task).min(len)..((i + 1) * per_task).min(len)
        };
        Self {
            wide: &self.wide[from(self.wide.len(), self.strides[0])],
            narrow: &self.narrow[from(self.narrow.len(), self.strides[1])],
            ..self
        }
    }

    /// Planes of a row.
    pub(super) fn planes(&self) -> usize {
        self.planes
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
        let wide = &self.wide[block * self.strides[0]..(block + 1) * self.strides[0]];
        if self.strides[1] == 0 {
            return wide;
        }
        let narrow = &self.narrow[block * self.strides[1]..(block + 1) * self.strides[1]];
        to_scratch(wide, narrow, planes, scratch);
        &scratch.0
    }
}

/// Some blocks, to change.
#[derive(Debug)]
pub(super) struct ParameterTask<'a> {
    strides: [usize; 2],
    wide: &'a mut [f32],
    narrow: &'a mut [F16],
}

impl ParameterTask<'_> {
    /// Numbers per block.
    pub(super) fn stride(&self) -> usize {
        self.strides[0] + self.strides[1]
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
        let wide = &mut self.wide[block * self.strides[0]..(block + 1) * self.strides[0]];
        if self.strides[1] == 0 {
            return wide;
        }
        let narrow = &self.narrow[block * self.strides[1]..(block + 1) * self.strides[1]];
        to_scratch(wide, narrow, planes, scratch);
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
        if self.strides[1] == 0 {
            return;
        }
        let wide = &mut self.wide[block * self.strides[0]..(block + 1) * self.strides[0]];
        let to = &mut self.narrow[block * self.strides[1]..(block + 1) * self.strides[1]];
        let (means, rest) = scratch.0[..planes * WIDTH].split_at(wide.len());
        wide.copy_from_slice(means);
        narrow(rest, &mut to[..rest.len()], draws);
    }
}

#[inline(always)]
fn to_scratch(wide: &[f32], narrow: &[F16], planes: usize, scratch: &mut Scratch) {
    let (means, rest) = scratch.0[..planes * WIDTH].split_at_mut(wide.len());
    means.copy_from_slice(wide);
    widen(&narrow[..rest.len()], rest);
}

const _: () = assert!(ROWS_PER_TASK == BLOCKS_PER_TASK * WIDTH, "a task is whole blocks");
