//! Tests of the vector's functions. `tests/it/agreement.rs` compares every stage on every instruction
//! set of this machine.

use pulp::{Arch, WithSimd};

use super::super::InstructionSet;
use super::*;

/// Measures the largest relative error of a function: inputs, true function, function, smallest divisor.
struct WorstError<'a>(&'a [f32], fn(f32) -> f64, Function, f64);
#[derive(Clone, Copy)]
enum Function {
    Exp2,
    Exp,
    Log2,
    Log2OfAny,
}

impl WithSimd for WorstError<'_> {
    type Output = f64;
    #[inline(always)]
    fn with_simd<S: Simd>(self, s: S) -> f64 {
        let WorstError(inputs, truth, function, floor) = self;
        let mut worst = 0.0_f64;
        for chunk in inputs.chunks_exact(WIDTH) {
            let mut out = [0.0_f32; WIDTH];
            for at in (0..WIDTH).step_by(S::F32_LANES) {
                let x = V::load(s, &chunk[at..]);
                let y = match function {
                    Function::Exp2 => x.exp2(),
                    Function::Exp => x.exp(),
                    Function::Log2 => x.log2_of_1_to_2(),
                    Function::Log2OfAny => x.log2(),
                };
                y.store(&mut out[at..]);
            }
            for (&x, &y) in chunk.iter().zip(&out) {
                let t = truth(x);
                worst = worst.max((f64::from(y) - t).abs() / t.abs().max(floor));
            }
        }
        worst
    }
}

fn grid(from: f32, to: f32) -> Vec<f32> {
    let n = 16 * 20_000;
    (0..n).map(|i| from + (to - from) * i as f32 / (n - 1) as f32).collect()
}

#[test]
fn elementary_functions_are_accurate() {
    let arch = Arch::new();
    let exp2 = WorstError(&grid(-30.0, 0.0), |x| f64::from(x).exp2(), Function::Exp2, 0.0);
    assert!(arch.dispatch(exp2) < 2e-7);
    let exp = WorstError(&grid(-80.0, 80.0), |x| f64::from(x).exp(), Function::Exp, 0.0);
    assert!(arch.dispatch(exp) < 2e-7);
    let log2 = WorstError(&grid(1.0, 2.0), |x| f64::from(x).log2(), Function::Log2, 1.0);
    assert!(arch.dispatch(log2) < 3e-7);
    for (from, to) in [(1e-6, 1.0), (0.999, 1.001), (1e-30, 1e-29), (1.0, 1e9)] {
        let log2 = WorstError(&grid(from, to), |x| f64::from(x).log2(), Function::Log2OfAny, 1.0);
        assert!(arch.dispatch(log2) < 4e-7, "{from} to {to}");
    }
}

struct SumsOfFour;

impl WithSimd for SumsOfFour {
    type Output = ([f32; 4], usize);
    #[inline(always)]
    fn with_simd<S: Simd>(self, s: S) -> ([f32; 4], usize) {
        let lanes = |first: f32| -> V<S> {
            let lanes: [f32; WIDTH] = std::array::from_fn(|i| first + (i * i) as f32);
            V::load(s, &lanes)
        };
        (sums_of_four([lanes(1.0), lanes(20.0), lanes(300.0), lanes(4000.0)]), S::F32_LANES)
    }
}

#[test]
fn sums_of_four_are_the_sums_of_each_vector() {
    for set in InstructionSet::available() {
        let (sums, lanes) = set.arch().dispatch(SumsOfFour);
        let squares: usize = (0..lanes).map(|i| i * i).sum();
        let expected = [1, 20, 300, 4000].map(|first| (first * lanes + squares) as f32);
        assert_eq!(sums, expected, "{set}");
    }
}

/// [`Mask::bits`], [`Mask::any`] and [`Mask::keep`] of the lanes above a number.
struct Above(f32);

impl WithSimd for Above {
    type Output = (u32, bool, Vec<f32>);
    #[inline(always)]
    fn with_simd<S: Simd>(self, s: S) -> Self::Output {
        let lanes: [f32; WIDTH] = std::array::from_fn(|i| (i * 7 % WIDTH) as f32);
        let lanes = V::load(s, &lanes);
        let mask = V::splat(s, self.0).lt(lanes);
        let mut kept = [0.0; WIDTH];
        mask.keep(-lanes).store(&mut kept);
        (mask.bits(), mask.any(), kept[..S::F32_LANES].to_vec())
    }
}

#[test]
fn masks_have_a_bit_per_lane() {
    for set in InstructionSet::available() {
        for limit in [-1.0, 0.0, 5.5, 12.5, 15.0] {
            let (bits, any, kept) = set.arch().dispatch(Above(limit));
            let lanes = (0..kept.len()).map(|i| (i * 7 % WIDTH) as f32);
            let expected: Vec<f32> = lanes.map(|x| if x > limit { -x } else { 0.0 }).collect();
            assert_eq!(kept, expected, "{set}");
            for (i, x) in expected.iter().enumerate() {
                let above = if limit < 0.0 { 1 } else { u32::from(*x != 0.0) };
                assert_eq!(bits >> i & 1, above, "{set}");
            }
            assert_eq!((any, bits >> kept.len()), (bits != 0, 0), "{set}");
        }
    }
}
