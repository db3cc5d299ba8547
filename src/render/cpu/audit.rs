//! Finds rows with non-finite numbers; see [`audit`](crate::audit).

use super::blocks::{Scratch, planes};
use super::simd::WIDTH;
use super::{BLOCKS_PER_TASK, CpuBackend};
use crate::{NonFinite, NumberKind};
use densify_core::gaussians::ModelArray;

impl CpuBackend {
    /// The rows with a non-finite number, in order.
    pub(super) fn find_non_finite(&self) -> Vec<NonFinite> {
        let rows = self.rows;
        let first_block = self.moments.first() / WIDTH;
        let (params, moments) = (self.params.view(rows), self.moments.view(rows));
        let planes = planes(self.sh_degree);
        let find = |row: usize| {
            let first = |get: &dyn Fn(usize) -> f32, kind| {
                let plane = (0..planes).position(|plane| !get(plane).is_finite())?;
                let array = ModelArray::of_parameter(plane);
                Some(NonFinite { row: row as u32, array, kind })
            };
            let moment = |order: usize| {
                let of_row = |plane| self.moments.get(row, plane)[order];
                (row >= self.moments.first()).then(|| first(&of_row, NumberKind::Moment))?
            };
            first(&|plane| self.params.get(row, plane), NumberKind::Parameter)
                .or_else(|| moment(0))
                .or_else(|| moment(1))
        };
        let blocks = rows.div_ceil(WIDTH);
        let is_suspect = |block: usize| {
            let mut scratch = [Scratch::ZERO; 2];
            let moments_are_unsound = |block: usize, scratch| {
                !moments.open(block, planes, scratch).into_iter().all(is_sound)
            };
            !is_sound(params.open(block, planes, &mut scratch[0]))
                || block
                    .checked_sub(first_block)
                    .is_some_and(|at| moments_are_unsound(at, &mut scratch))
        };
        let of_task = |task: usize| -> Vec<NonFinite> {
            let blocks = task * BLOCKS_PER_TASK..blocks.min((task + 1) * BLOCKS_PER_TASK);
            let suspects = blocks.filter(|&block| is_suspect(block));
            suspects.flat_map(|b| b * WIDTH..rows.min((b + 1) * WIDTH)).filter_map(find).collect()
        };
        let tasks = 0..blocks.div_ceil(BLOCKS_PER_TASK);
        let by_task = self.threads.install(|| self.threads.collect("audit", tasks, of_task));
        by_task.into_iter().flatten().collect()
    }
}

/// Returns whether all numbers are finite.
fn is_sound(numbers: &[f32]) -> bool {
    // 0 · x is 0 unless x is NaN or infinite; sixteen sums run side by side.
    let mut sums = [0.0_f32; WIDTH];
    for numbers in numbers.chunks_exact(WIDTH) {
        sums.iter_mut().zip(numbers).for_each(|(sum, x)| *sum += 0.0 * x);
    }
    sums.iter().all(|&sum| sum == 0.0)
}
