//! Looks for rows that hold a number that is none; see [`audit`](crate::backend::audit).

use rayon::prelude::*;

use super::CpuBackend;
use super::blocks::Blocks;
use super::simd::WIDTH;
use crate::backend::{Attribute, Kept, Unsound};

impl CpuBackend {
    /// The rows that hold a number that is none, in order.
    pub(super) fn unsound(&self) -> Vec<Unsound> {
        let rows = self.rows;
        let [first, second] = &self.moments;
        let buffers =
            [(&self.params, Kept::Parameter), (first, Kept::Moment), (second, Kept::Moment)];
        let blocks = |buffer: &'_ Blocks, b: usize| {
            let stride = buffer.stride();
            b * stride..(b + 1) * stride
        };
        let find = |row: usize| {
            buffers.iter().find_map(|&(buffer, kept)| {
                let block = &buffer.of_rows(rows)[blocks(buffer, row / WIDTH)];
                let numbers = block.chunks_exact(WIDTH);
                let number = numbers.into_iter().position(|n| !n[row % WIDTH].is_finite())?;
                Some(Unsound { row: row as u32, attribute: Attribute::of(number), kept })
            })
        };
        self.pool.install(|| {
            (0..rows.div_ceil(WIDTH))
                .into_par_iter()
                .filter(|&b| {
                    let is_sound = |buffer: &Blocks| {
                        // 0 · x is 0 but for NaN and infinity; sixteen sums go side by side.
                        let mut sums = [0.0_f32; WIDTH];
                        for numbers in buffer.of_rows(rows)[blocks(buffer, b)].chunks_exact(WIDTH) {
                            sums.iter_mut().zip(numbers).for_each(|(sum, x)| *sum += 0.0 * x);
                        }
                        sums.iter().all(|&sum| sum == 0.0)
                    };
                    !buffers.iter().all(|(buffer, _)| is_sound(buffer))
                })
                .flat_map_iter(|b| (b * WIDTH..rows.min((b + 1) * WIDTH)).filter_map(find))
                .collect()
        })
    }
}
