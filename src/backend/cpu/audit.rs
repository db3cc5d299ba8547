//! Finds rows with a number that is not finite; see [`audit`](crate::backend::audit).

use rayon::prelude::*;

use super::CpuBackend;
use super::blocks::{Scratch, planes};
use super::simd::WIDTH;
use crate::backend::{Attribute, Kept, Unsound};

impl CpuBackend {
    /// The rows with a number that is not finite, in order.
    pub(super) fn unsound(&self) -> Vec<Unsound> {
        let rows = self.rows;
        let (params, moments) = (self.params.view(rows), self.moments.view(rows));
        let planes = planes(self.sh_degree);
        let find = |row: usize| {
            let first = |get: &dyn Fn(usize) -> f32, kept| {
                let number = (0..planes).position(|plane| !get(plane).is_finite())?;
                Some(Unsound { row: row as u32, attribute: Attribute::of(number), kept })
            };
            first(&|plane| self.params.get(row, plane), Kept::Parameter)
                .or_else(|| first(&|plane| self.moments.get(row, plane)[0], Kept::Moment))
                .or_else(|| first(&|plane| self.moments.get(row, plane)[1], Kept::Moment))
        };
        self.pool.install(|| {
            (0..rows.div_ceil(WIDTH))
                .into_par_iter()
                .filter(|&b| {
                    let mut scratch = [Scratch::ZERO; 2];
                    if !is_sound(params.open(b, planes, &mut scratch[0])) {
                        return true;
                    }
                    let both = moments.open(b, planes, &mut scratch);
                    !both.into_iter().all(is_sound)
                })
                .flat_map_iter(|b| (b * WIDTH..rows.min((b + 1) * WIDTH)).filter_map(find))
                .collect()
        })
    }
}

/// Whether all numbers of some planes are finite.
fn is_sound(numbers: &[f32]) -> bool {
    // 0 · x is 0 but for NaN and infinity; sixteen sums go side by side.
    let mut sums = [0.0_f32; WIDTH];
    for numbers in numbers.chunks_exact(WIDTH) {
        sums.iter_mut().zip(numbers).for_each(|(sum, x)| *sum += 0.0 * x);
    }
    sums.iter().all(|&sum| sum == 0.0)
}
