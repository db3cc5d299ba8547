//! Brings rows that are near each other in the scene near each other in memory: in the order of the
//! Z-curve through their means (Morton 1966), after edits.
//!
//! The rows of a block are then mostly seen together or not at all, and blocks that no view sees cost
//! the stages next to nothing; rows of a tile share cache lines.

use bytemuck::cast_slice_mut;
use rayon::prelude::*;

use super::apply::Model;
use super::blocks::plane;

/// Bits per axis of a place on the curve.
const BITS: u32 = 10;

/// Sorts the rows of a model. `memory` has room for two numbers per row.
pub(super) fn sort(model: &mut Model<'_>, rows: usize, memory: &mut [f32]) {
    // Place on the curve and row; the rows are all different, so there is one order only.
    let keys: &mut [[u32; 2]] = cast_slice_mut(&mut memory[..2 * rows]);
    let params = &*model.params;
    model.threads.each("order", keys.par_iter_mut().enumerate(), |(row, key)| {
        *key = [place(params.get_n(row, plane::MEAN)), row as u32];
    });
    keys.par_sort_unstable();
    // Cycle by cycle; a row that has its place stands there under its own number.
    for first in 0..rows {
        let mut to = first;
        loop {
            let from = std::mem::replace(&mut keys[to][1], to as u32) as usize;
            if from == first {
                break;
            }
            model.swap(from, to);
            to = from;
        }
    }
}

/// Where on the curve a point lies. Coordinates are squeezed into (−1, 1), so that no bounds are needed
/// and outliers spoil nothing; the scene's extent is about 1.
fn place(mean: [f32; 3]) -> u32 {
    let [x, y, z] = mean.map(|x| {
        let squeezed = x / (1.0 + x.abs());
        // What is not finite is 0.
        spread((squeezed.mul_add(0.5, 0.5) * (1 << BITS) as f32) as u32)
    });
    x | y << 1 | z << 2
}

/// Two zeros between the bits of a number below 2^[`BITS`].
fn spread(x: u32) -> u32 {
    let x = x.min((1 << BITS) - 1);
    let x = (x | x << 16) & 0x0300_00ff;
    let x = (x | x << 8) & 0x0300_f00f;
    let x = (x | x << 4) & 0x030c_30c3;
    (x | x << 2) & 0x0924_9249
}

#[cfg(test)]
#[expect(clippy::float_cmp, reason = "what is moved is moved to the bit")]
mod tests {
    use rand::seq::SliceRandom;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::super::{CpuBackend, CpuOptions};
    use super::*;
    use crate::backend::Backend;
    use crate::gaussians::Gaussians;

    #[test]
    fn bits_of_three_numbers_alternate() {
        for x in [0, 1, 2, 5, 0b10_1101_0011, (1 << BITS) - 1] {
            let bits: u32 = (0..BITS).map(|i| (x >> i & 1) << (3 * i)).sum();
            assert_eq!(spread(x), bits, "{x:#b}");
        }
        assert_eq!(spread(1 << BITS), spread((1 << BITS) - 1));
        let near = place([0.1, 0.2, 0.3]);
        assert_eq!(near, place([0.1001, 0.2001, 0.3001]));
        assert!(place([-2.0; 3]) < place([-1.0; 3]) && place([1.0; 3]) < place([f32::MAX; 3]));
        assert_eq!(place([f32::NAN; 3]), 0);
    }

    /// Whatever order rows begin in, they end in the same, each with all that is its own.
    #[test]
    fn rows_are_sorted_and_stay_whole() {
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        let rows = 1000;
        let mut order: Vec<usize> = (0..rows).collect();
        let means: Vec<[f32; 3]> =
            (0..rows).map(|_| [0; 3].map(|_| rng.random_range(-3.0..3.0))).collect();
        let mut sorted = Vec::new();
        for _ in 0..2 {
            order.shuffle(&mut rng);
            // Every number of a row says which row it is.
            let name = |i: usize| i as f32 / 1000.0;
            let model = Gaussians {
                sh_degree: 1,
                means: order.iter().map(|&i| means[i]).collect(),
                log_scales: order.iter().map(|&i| [name(i); 3]).collect(),
                quats: order.iter().map(|&i| [name(i); 4]).collect(),
                opacity_logits: order.iter().map(|&i| name(i)).collect(),
                sh: order.iter().flat_map(|&i| [name(i); 12]).collect(),
            };
            let mut backend = CpuBackend::new(&model, &CpuOptions::new(rows)).unwrap();
            for (row, &i) in order.iter().enumerate() {
                backend.ages[row] = i as u16;
            }
            backend.sort_rows();
            let result = backend.download().unwrap();
            let places: Vec<u32> = result.means.iter().map(|&mean| place(mean)).collect();
            assert!(places.is_sorted());
            for (row, &mean) in result.means.iter().enumerate() {
                let i = usize::from(backend.ages[row]);
                assert_eq!(mean, means[i]);
                assert_eq!(result.opacity_logits[row], name(i));
                assert_eq!(result.sh_of(row), [name(i); 12]);
                assert_eq!(result.quats[row], [name(i); 4]);
                assert_eq!(result.log_scales[row], [name(i); 3]);
            }
            sorted.push(places);
        }
        assert_eq!(sorted[0], sorted[1]);
    }
}
