//! Rows whose parameters or gradients are no finite numbers. They are found before the optimiser steps,
//! stay as they are from then on, and are removed at the policy's next event: one such value, once in
//! the moments, never leaves them.
//!
//! A sum of 0·x over all values of a row is 0 unless one of them is NaN or infinite. That is one
//! multiply-add for a value that is in the cache anyway, against some fifteen operations of Adam.

use pulp::Simd;

use super::blocks::plane;
use super::simd::{V, WIDTH};
use crate::backend::{Quarantined, RowValue};

/// Which rows are quarantined, and for which of their values.
#[derive(Debug)]
pub(super) struct Quarantine {
    /// 0 for a sound row, else 1 + plane, and [`GRADIENT`] where it is the gradient's. Shape:
    /// `[budget]`, in whole blocks.
    marks: Vec<u8>,
    /// Rows with a mark.
    count: usize,
}

/// The mark of a gradient.
const GRADIENT: u8 = 0x80;
const _: () = assert!(plane::MOST < GRADIENT as usize, "marks hold a plane");

/// Lanes of a block with a value that is not finite: of any parameter, or of the gradient of the
/// first `trained` ones.
#[inline(always)]
pub(super) fn poisoned<S: Simd>(s: S, params: &[f32], gradient: &[f32], trained: usize) -> u16 {
    let zero = V::zero(s);
    let mut bits = 0;
    for at in (0..WIDTH).step_by(S::F32_LANES) {
        // Four sums, so that one need not wait for the other.
        let mut sums = [zero; 4];
        for (values, planes) in [(params, params.len() / WIDTH), (gradient, trained)] {
            for p in 0..planes {
                let sum = &mut sums[p % 4];
                *sum = V::load(s, &values[p * WIDTH + at..]).mul_add(zero, *sum);
            }
        }
        let [a, b, c, d] = sums;
        bits |= ((a + b) + (c + d)).le(zero).bits() << at;
    }
    !(bits as u16)
}

/// Marks the lanes in `poisoned` that have no mark yet; returns how many.
#[cold]
pub(super) fn mark(marks: &mut [u8], poisoned: u16, params: &[f32], gradient: &[f32]) -> usize {
    let mut marked = 0;
    for (lane, mark) in marks.iter_mut().enumerate() {
        if poisoned >> lane & 1 == 0 || *mark != 0 {
            continue;
        }
        let first = |values: &[f32]| {
            values.chunks_exact(WIDTH).position(|plane| !plane[lane].is_finite())
        };
        let of_gradient = || first(gradient).map_or(0, |plane| GRADIENT | (plane as u8 + 1));
        *mark = first(params).map_or_else(of_gradient, |plane| plane as u8 + 1);
        marked += 1;
    }
    marked
}

/// What the frozen lanes of a block were before a step.
pub(super) struct Frozen<const N: usize> {
    lanes: u16,
    values: [Vec<f32>; N],
}

impl<const N: usize> Frozen<N> {
    #[cold]
    pub(super) fn new(lanes: u16, buffers: [&[f32]; N]) -> Self {
        Self { lanes, values: buffers.map(<[f32]>::to_vec) }
    }

    /// Undoes what a step has done to them.
    #[cold]
    pub(super) fn put_back(&self, buffers: [&mut [f32]; N]) {
        for (values, buffer) in self.values.iter().zip(buffers) {
            for (at, value) in values.iter().enumerate() {
                if self.lanes >> (at % WIDTH) & 1 == 1 {
                    buffer[at] = *value;
                }
            }
        }
    }
}

impl Quarantine {
    pub(super) fn new(budget: usize) -> Self {
        Self { marks: vec![0; budget.next_multiple_of(WIDTH)], count: 0 }
    }

    pub(super) fn bytes(budget: usize) -> u64 {
        budget.next_multiple_of(WIDTH) as u64
    }

    pub(super) fn count(&self) -> usize {
        self.count
    }

    pub(super) fn add(&mut self, marked: usize) {
        self.count += marked;
    }

    /// The marks of whole blocks.
    pub(super) fn marks_mut(&mut self, lanes: usize) -> &mut [u8] {
        &mut self.marks[..lanes]
    }

    pub(super) fn marks(&self, rows: usize) -> &[u8] {
        &self.marks[..rows]
    }

    /// Takes marks back.
    pub(super) fn set(&mut self, marks: &[u8]) {
        self.marks.fill(0);
        self.marks[..marks.len()].copy_from_slice(marks);
        self.count = marks.iter().filter(|&&mark| mark != 0).count();
    }

    pub(super) fn clear_row(&mut self, row: usize) {
        self.marks[row] = 0;
    }

    pub(super) fn copy_row(&mut self, from: usize, to: usize) {
        self.marks[to] = self.marks[from];
    }

    /// After an edit: slots from `rows` on are nobody's.
    pub(super) fn recount(&mut self, rows: usize) {
        if self.count > 0 {
            self.marks[rows..].fill(0);
            self.count = self.marks.iter().filter(|&&mark| mark != 0).count();
        }
    }

    /// The rows that are quarantined, in order.
    pub(super) fn list(&self) -> Vec<Quarantined> {
        if self.count == 0 {
            return Vec::new();
        }
        let marked = self.marks.iter().enumerate().filter(|(_, mark)| **mark != 0);
        marked
            .map(|(row, &mark)| {
                let plane = usize::from(mark & !GRADIENT).saturating_sub(1);
                Quarantined { row: row as u32, value: value(plane), gradient: mark & GRADIENT != 0 }
            })
            .collect()
    }
}

fn value(p: usize) -> RowValue {
    match p {
        0..plane::LOG_SCALE => RowValue::Mean,
        plane::LOG_SCALE..plane::QUAT => RowValue::LogScale,
        plane::QUAT..plane::OPACITY => RowValue::Quat,
        plane::OPACITY => RowValue::Opacity,
        _ => RowValue::Sh,
    }
}
