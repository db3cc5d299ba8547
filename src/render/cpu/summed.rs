//! Gradients summed between optimiser steps, where a policy wants steps less often than every
//! iteration ([`Cadence`]). Without such a policy there is no buffer and no cost.
//!
//! A step then takes the sum of the gradients of all views since the last one. Bands 1–3 of the
//! colour can step less often than all others; they then have ages of their own, as Adam's bias
//! correction counts steps.

use std::ops::Range;

use densify_policies::policy::Cadence;
use rayon::prelude::*;

use super::ROWS_PER_TASK;
use super::blocks::{BlockTask, Blocks, parts, plane};
use super::simd::WIDTH;
use crate::{StateError, StepInput, Tensor};

/// The sums of the rows that may be trained.
#[derive(Debug)]
pub(super) struct Summed {
    longest: Cadence,
    /// First parameter plane that is summed.
    first: usize,
    sums: Blocks,
    /// Steps of bands 1–3, where they may differ from the others': one plane, or none.
    rest_ages: Blocks<u16>,
    /// Whether sums of bands 1–3, and of all others, wait for a step.
    pending: Due,
}

/// Which parameters step, or wait.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(super) struct Due {
    /// All but bands 1–3.
    pub(super) main: bool,
    /// Bands 1–3.
    pub(super) rest: bool,
    /// Whether sums waited before this step, for the main parameters and bands 1–3.
    waited: [bool; 2],
}

/// The sums of one task's rows.
pub(super) struct TaskSums<'a> {
    first: usize,
    sums: BlockTask<'a, f32>,
    rest_ages: &'a mut [u16],
}

/// Names of what is kept between steps.
const GRADIENTS: &str = "gradients";
const WAITING: &str = "waiting";
const REST_AGES: &str = "rest_ages";

/// The first plane that sums for this cadence must hold; `planes` where none must.
fn first_plane(planes: usize, longest: Cadence) -> usize {
    match longest {
        Cadence { all: 2.., .. } => 0,
        Cadence { sh_rest: 2.., .. } => plane::SH_REST.min(planes),
        _ => planes,
    }
}

impl Summed {
    pub(super) fn new(rows: Range<usize>, planes: usize, longest: Cadence) -> Self {
        let first = first_plane(planes, longest);
        Self {
            longest,
            first,
            sums: Blocks::zeros(rows.clone(), planes - first),
            rest_ages: Blocks::zeros(rows, usize::from(longest.sh_rest > 1)),
            pending: Due::default(),
        }
    }

    pub(super) fn is_wanted(longest: Cadence) -> bool {
        longest.all > 1 || longest.sh_rest > 1
    }

    pub(super) fn bytes(rows: Range<usize>, planes: usize, longest: Cadence) -> u64 {
        let sums = Blocks::<f32>::bytes(rows.clone(), planes - first_plane(planes, longest));
        sums + Blocks::<u16>::bytes(rows, usize::from(longest.sh_rest > 1))
    }

    /// The parameter groups that step now; records those that wait.
    ///
    /// # Panics
    /// When the cadence needs sums that were not declared: a bug in the caller, and going on would
    /// lose gradients.
    pub(super) fn advance(&mut self, input: &StepInput<'_>) -> Due {
        let (step, cadence) = (input.step, input.cadence);
        assert!(cadence.is_within(self.longest), "step {step}: {cadence:?} was not declared");
        let [main, rest] = cadence.steps_at(step);
        let due = Due { main, rest, waited: [self.pending.main, self.pending.rest] };
        self.pending = Due { main: !main, rest: !rest, waited: [false; 2] };
        due
    }

    /// The sums, cut for the optimiser's tasks.
    pub(super) fn tasks(
        &mut self,
        rows: usize,
        tasks: usize,
    ) -> impl IndexedParallelIterator<Item = TaskSums<'_>> {
        let Self { first, sums, rest_ages, .. } = self;
        let first = *first;
        let ages = parts(rest_ages.of_rows_mut(rows), ROWS_PER_TASK, tasks);
        sums.tasks(rows).zip(ages).map(move |(sums, rest_ages)| TaskSums { first, sums, rest_ages })
    }

    /// What is kept between steps, by name.
    pub(super) fn state(&self) -> &'static [&'static str] {
        match (Self::is_wanted(self.longest), self.rest_ages.planes() == 0) {
            (false, _) => &[],
            (true, true) => &[GRADIENTS, WAITING],
            (true, false) => &[GRADIENTS, WAITING, REST_AGES],
        }
    }

    /// Whether an array of the state is by rows.
    pub(super) fn is_by_rows(part: &str) -> bool {
        part != WAITING
    }

    /// An array of the state: sums `[rows, summed planes]`, who waits `[2]`, ages of bands 1–3
    /// `[rows]`.
    pub(super) fn tensor(&self, part: &str, rows: Range<usize>) -> Option<Tensor> {
        let planes = self.planes();
        let name = format!("summed.{part}");
        let part = self.state().iter().find(|known| **known == part)?;
        Some(match *part {
            GRADIENTS => {
                let shape = [rows.len(), planes];
                Tensor::f32(name, &shape, self.sums.to_rows(rows, 0..planes))
            }
            WAITING => {
                let Due { main, rest, .. } = self.pending;
                Tensor::u8(name, &[2], vec![u8::from(main), u8::from(rest)])
            }
            _ => Tensor::u16(name, &[rows.len()], self.rest_ages.to_rows(rows, 0..1)),
        })
    }

    /// Takes back what [`tensor`](Self::tensor) returned.
    pub(super) fn restore(
        &mut self,
        part: &str,
        rows: Range<usize>,
        tensor: Tensor,
    ) -> Result<(), StateError> {
        let planes = self.planes();
        match self.state().iter().find(|known| **known == part) {
            None => return Err(tensor.error("this run keeps nothing of that name")),
            Some(&GRADIENTS) => {
                let values = tensor.into_f32(&[rows.len(), planes])?;
                self.sums.set_rows(rows, 0..planes, &values);
            }
            Some(&WAITING) => {
                let waiting = tensor.into_u8(&[2])?;
                let [main, rest] = [0, 1].map(|i| waiting[i] != 0);
                self.pending = Due { main, rest, waited: [false; 2] };
            }
            Some(_) => {
                let ages = tensor.into_u16(&[rows.len()])?;
                self.rest_ages.set_rows(rows, 0..1, &ages);
            }
        }
        Ok(())
    }

    /// Planes that are summed.
    fn planes(&self) -> usize {
        self.sums.planes()
    }

    pub(super) fn clear_row(&mut self, row: usize) {
        self.sums.clear_row(row);
        self.rest_ages.clear_row(row);
    }

    pub(super) fn copy_row(&mut self, from: usize, to: usize) {
        self.sums.copy_row(from, to);
        self.rest_ages.copy_row(from, to);
    }

    pub(super) fn reorder(&mut self, order: &[u32]) {
        self.sums.reorder(order);
        self.rest_ages.reorder(order);
    }

    /// As the moments of a parameter are forgotten.
    pub(super) fn forget(&mut self, row: usize, plane: usize) {
        if let Some(summed) = plane.checked_sub(self.first).filter(|&p| p < self.planes()) {
            self.sums.set(row, summed, 0.0);
        }
    }
}

impl Due {
    /// Whether gradients go into the sums, or come out of them.
    pub(super) fn sums_matter(self) -> bool {
        !self.main || !self.rest || self.waited != [false; 2]
    }
}

impl TaskSums<'_> {
    /// Ages of bands 1–3 in these lanes, if they have their own.
    pub(super) fn rest_ages(&mut self, lanes: Range<usize>) -> Option<&mut [u16]> {
        self.rest_ages.get_mut(lanes)
    }

    /// Adds the gradient of a block to the sums of those who wait, and the sums of those who step to
    /// the gradient. Whether the gradient has changed.
    pub(super) fn exchange(
        &mut self,
        block: usize,
        gradient: &mut [f32],
        trained: usize,
        due: Due,
    ) -> bool {
        let sums = self.sums.block(block);
        let classes = [
            (0..trained.min(plane::SH_REST), due.main, due.waited[0]),
            (plane::SH_REST..trained, due.rest, due.waited[1]),
        ];
        let mut changed = false;
        for (planes, steps, waited) in classes {
            if planes.start < self.first || planes.is_empty() || (steps && !waited) {
                continue;
            }
            let values = &mut gradient[planes.start * WIDTH..planes.end * WIDTH];
            let offset = (planes.start - self.first) * WIDTH;
            let sums = &mut sums[offset..offset + values.len()];
            for (g, sum) in values.iter_mut().zip(sums) {
                if steps {
                    *g += std::mem::take(sum);
                } else {
                    *sum += *g;
                }
            }
            changed |= steps;
        }
        changed
    }
}
