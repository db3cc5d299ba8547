//! Gradients summed between optimiser steps, for policies that step less often than every
//! iteration ([`Cadence`]). Other policies need no buffer and pay nothing.
//!
//! A step uses the sum of the gradients of all views since the previous step. SH bands 1–3 may
//! step less often than all other parameters; they then need their own step counts per row
//! (ages), because Adam's bias correction depends on the number of steps.

use std::ops::Range;

use densify_policies::policy::Cadence;
use rayon::prelude::*;

use super::ROWS_PER_TASK;
use super::blocks::{BlockTask, Blocks, RowEdit, parts, plane};
use super::simd::WIDTH;
use crate::{StateError, StepInput, Tensor};

/// The sums of the trainable rows.
#[derive(Debug)]
pub(super) struct GradientSums {
    /// The longest intervals between steps that the policy has declared.
    longest: Cadence,
    /// First parameter plane that is summed.
    first: usize,
    sums: Blocks,
    /// Number of optimiser steps of bands 1–3, per row; has no plane if it is always that of the other parameters.
    rest_ages: Blocks<u16>,
    waiting: Waiting,
}

/// The parameter groups that step now.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Stepping {
    /// All but bands 1–3.
    pub(super) main: bool,
    /// Bands 1–3.
    pub(super) rest: bool,
    /// The groups whose sums were waiting before this step.
    had_sums: Waiting,
}

/// The parameter groups whose sums wait for a step.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
struct Waiting {
    /// All but bands 1–3.
    main: bool,
    /// Bands 1–3.
    rest: bool,
}

/// The sums of one task's rows.
pub(super) struct TaskSums<'a> {
    first: usize,
    sums: BlockTask<'a, f32>,
    rest_ages: &'a mut [u16],
}

/// Names of the state arrays.
const GRADIENTS: &str = "gradients";
pub(super) const WAITING: &str = "waiting";
const REST_AGES: &str = "rest_ages";

/// The first plane to sum for a cadence; `planes` if no plane is summed.
fn first_plane(planes: usize, longest: Cadence) -> usize {
    match longest {
        Cadence { all: 2.., .. } => 0,
        Cadence { sh_rest: 2.., .. } => plane::SH_REST.min(planes),
        _ => planes,
    }
}

impl GradientSums {
    pub(super) fn new(rows: Range<usize>, planes: usize, longest: Cadence) -> Self {
        let first = first_plane(planes, longest);
        Self {
            longest,
            first,
            sums: Blocks::zeros(rows.clone(), planes - first),
            rest_ages: Blocks::zeros(rows, usize::from(longest.sh_rest > 1)),
            waiting: Waiting::default(),
        }
    }

    pub(super) fn is_needed(longest: Cadence) -> bool {
        longest.all > 1 || longest.sh_rest > 1
    }

    pub(super) fn bytes(rows: Range<usize>, planes: usize, longest: Cadence) -> u64 {
        let sums = Blocks::<f32>::bytes(rows.clone(), planes - first_plane(planes, longest));
        sums + Blocks::<u16>::bytes(rows, usize::from(longest.sh_rest > 1))
    }

    /// Returns the parameter groups that step now, and records those that wait.
    ///
    /// # Panics
    /// When the cadence was not declared: a bug in the caller that would lose gradients.
    pub(super) fn advance(&mut self, input: &StepInput<'_>) -> Stepping {
        let (step, cadence) = (input.step, input.cadence);
        assert!(cadence.is_within(self.longest), "step {step}: {cadence:?} was not declared");
        let [main, rest] = cadence.steps_at(step);
        let due = Stepping { main, rest, had_sums: self.waiting };
        self.waiting = Waiting { main: !main, rest: !rest };
        due
    }

    /// The sums, split for the optimiser's tasks.
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

    /// The names of the state arrays.
    pub(super) fn state(&self) -> &'static [&'static str] {
        if !Self::is_needed(self.longest) {
            &[]
        } else if self.rest_ages.planes == 0 {
            &[GRADIENTS, WAITING]
        } else {
            &[GRADIENTS, WAITING, REST_AGES]
        }
    }

    /// A state array: sums `[rows, summed planes]`, waiting groups `[2]`, or ages of bands 1–3
    /// `[rows]`.
    pub(super) fn tensor(&self, part: &str, rows: Range<usize>) -> Option<Tensor> {
        let planes = self.sums.planes;
        let name = format!("summed.{part}");
        let part = self.state().iter().find(|known| **known == part)?;
        Some(match *part {
            GRADIENTS => {
                let shape = [rows.len(), planes];
                Tensor::f32(name, &shape, self.sums.to_rows(rows, 0..planes))
            }
            WAITING => {
                let Waiting { main, rest } = self.waiting;
                Tensor::u8(name, &[2], vec![u8::from(main), u8::from(rest)])
            }
            _ => Tensor::u16(name, &[rows.len()], self.rest_ages.to_rows(rows, 0..1)),
        })
    }

    /// Restores an array that [`tensor`](Self::tensor) returned.
    pub(super) fn restore(
        &mut self,
        part: &str,
        rows: Range<usize>,
        tensor: Tensor,
    ) -> Result<(), StateError> {
        let planes = self.sums.planes;
        match self.state().iter().find(|known| **known == part) {
            None => return Err(tensor.error("this run has no such array")),
            Some(&GRADIENTS) => {
                let values = tensor.into_f32(&[rows.len(), planes])?;
                self.sums.set_rows(rows, 0..planes, &values);
            }
            Some(&WAITING) => {
                let waiting = tensor.into_u8(&[2])?;
                let [main, rest] = [0, 1].map(|i| waiting[i] != 0);
                self.waiting = Waiting { main, rest };
            }
            Some(_) => {
                let ages = tensor.into_u16(&[rows.len()])?;
                self.rest_ages.set_rows(rows, 0..1, &ages);
            }
        }
        Ok(())
    }

    pub(super) fn edit(&mut self, edit: RowEdit<'_>) {
        self.sums.edit(edit);
        self.rest_ages.edit(edit);
    }

    /// Resets the sum of one parameter.
    pub(super) fn reset(&mut self, row: usize, plane: usize) {
        if let Some(summed) = plane.checked_sub(self.first).filter(|&p| p < self.sums.planes) {
            self.sums.set(row, summed, 0.0);
        }
    }
}

impl Stepping {
    /// True if a step adds to the sums or takes from them, that is, unless every group steps and no sums were waiting.
    pub(super) fn uses_sums(self) -> bool {
        !self.main || !self.rest || self.had_sums != Waiting::default()
    }
}

impl TaskSums<'_> {
    /// The ages of bands 1–3 in the given lanes, if they have their own.
    pub(super) fn rest_ages(&mut self, lanes: Range<usize>) -> Option<&mut [u16]> {
        self.rest_ages.get_mut(lanes)
    }

    /// Adds the gradient of a block to the sums of the waiting groups, and the sums of the stepping groups to the
    /// gradient. Returns whether the gradient has changed.
    pub(super) fn take_gradient(
        &mut self,
        block: usize,
        gradient: &mut [f32],
        trained: usize,
        due: Stepping,
    ) -> bool {
        let sums = self.sums.block(block);
        let groups = [
            (0..trained.min(plane::SH_REST), due.main, due.had_sums.main),
            (plane::SH_REST..trained, due.rest, due.had_sums.rest),
        ];
        let mut changed = false;
        for (planes, steps, had_sums) in groups {
            if planes.start < self.first || planes.is_empty() || (steps && !had_sums) {
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
