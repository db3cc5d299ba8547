//! Formats of 8 and 16 bits, sixteen numbers at a time, and the random bits for rounding to them.
//!
//! Rounding is stochastic (Gupta et al. 2015, section 3.1): a number becomes one of its two representable neighbours,
//! the nearer one more often, so that the mean is preserved. A representable number is unchanged, whatever the random
//! bits.
//!
//! The code loops over arrays of integers instead of using `pulp`, which has no vectors of 8 and 16 bits to convert
//! from; inlined into a dispatched kernel, the loops are vectorised by the compiler.

use densify_policies::rng::{PolicyRng, Purpose};

use super::simd::WIDTH;

/// 2⁻¹⁴: below it, f16 has a constant spacing of 2⁻²⁴.
const F16_NORMAL: f32 = 6.103_515_6e-5;
/// Bits of the significand that f16 lacks.
const F16_DROPPED: u32 = 13;
/// Difference between the exponent biases of f32 and f16, at the position of f16's exponent.
const F16_BIAS: u32 = 112 << 10;
/// Largest finite number of f16: 65,504.
const F16_MAX: u32 = 0x7bff;
const F16_INFINITE: u32 = 0x7c00;
const INFINITE: u32 = 0x7f80_0000;
/// Bits of the significand that [`F8`] lacks: all but one.
const F8_DROPPED: u32 = 22;
/// Difference between the upper bits of an f32 and its code in [`F8`], whose smallest number, 2⁻⁹⁶, has the code 1.
const F8_BIAS: u32 = ((127 - 96) << 1) - 1;
/// 2⁹⁶, the inverse of the smallest positive number of [`F8`].
const F8_INVERSE_LEAST: f32 = 79_228_162_514_264_337_593_543_950_336.0;
/// The code of the largest finite number of [`F8`], 1.5·2³⁰.
const F8_MAX: u32 = 0xfe;
/// The code of NaN.
const F8_NAN: u32 = 0xff;
/// |first moment| / √(second moment) is at most this: by Cauchy and Schwarz,
/// (1 − β₁)/√((1 − β₂)·(1 − β₁²/β₂)) with β₁ = 0.9, β₂ = 0.999. Where the second moment was rounded down,
/// large ratios may be clamped; gradients of pure noise give a ratio of about 0.23.
const RATIO_MAX: f32 = 7.3;
const RATIO_STEP: f32 = RATIO_MAX / 127.0;

/// Random bits for the rows of one block: a function of seed, step, row, purpose and the number of earlier draws, and
/// so independent of threads.
///
/// A hash starts the sequence of each row, and a linear congruential generator (the constants of
/// *Numerical Recipes*) continues it. Only its upper bits are used, as its lower bits are less random.
pub(super) struct Draws([u32; WIDTH]);

impl Draws {
    /// Three independent sequences for the rows from `first_row` on.
    #[inline(always)]
    pub(super) fn of_block(rng: &PolicyRng, first_row: usize) -> [Self; 3] {
        let mut starts = [[0; WIDTH]; 3];
        for lane in 0..WIDTH {
            let bits = rng.bits((first_row + lane) as u32, Purpose::Round, 0);
            for (start, bits) in starts.iter_mut().zip(bits) {
                start[lane] = bits;
            }
        }
        starts.map(Self)
    }

    /// The next random bits of each row.
    #[inline(always)]
    fn next(&mut self) -> [u32; WIDTH] {
        for state in &mut self.0 {
            *state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        }
        self.0
    }
}

/// A number format narrower than f32.
pub(super) trait Narrow: Copy + Default {
    /// Converts exactly.
    fn to_f32(self) -> f32;
    /// Rounds to one of the two neighbours of `x`, by the upper bits of `random`. Finite numbers stay finite, and
    /// non-finite numbers stay non-finite.
    fn round(x: f32, random: u32) -> Self;
    /// Rounds to the nearest number, as the middle random value does; ties go up.
    #[inline(always)]
    fn nearest(x: f32) -> Self {
        Self::round(x, 1 << 31)
    }
}

/// IEEE 754 binary16: 16 bits, 11 of them significant.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(super) struct F16(pub(super) u16);

/// A non-negative number in a byte: 7 bits of exponent and one of significand. Non-finite numbers become NaN.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(super) struct F8(pub(super) u8);

impl Narrow for F16 {
    #[inline(always)]
    fn to_f32(self) -> f32 {
        let bits = u32::from(self.0);
        let magnitude = bits & 0x7fff;
        let lifted = f32::from_bits((magnitude << F16_DROPPED) + (F16_BIAS << F16_DROPPED));
        // The significand counts steps of 2⁻²⁴: from 0 for subnormal numbers, from 2⁻¹⁴ for the smallest exponent.
        let one_up = f32::from_bits((magnitude << F16_DROPPED) + (113 << 23));
        let x = if magnitude < 0x400 { one_up - F16_NORMAL } else { lifted };
        let beyond = if magnitude >= F16_INFINITE { INFINITE } else { 0 };
        f32::from_bits(x.to_bits() | beyond | (bits & 0x8000) << 16)
    }

    #[inline(always)]
    fn round(x: f32, random: u32) -> Self {
        let bits = x.to_bits();
        let magnitude = bits & 0x7fff_ffff;
        let size = f32::from_bits(magnitude);
        // Numbers from 2⁻¹⁴ to 2⁻¹³ are spaced like subnormal ones: adding 2⁻¹⁴ gives the significand to store.
        let is_small = size < F16_NORMAL;
        let lifted = if is_small { size + F16_NORMAL } else { size };
        let drawn = lifted.to_bits() + (random >> (32 - F16_DROPPED));
        let lowered = if is_small { F16_BIAS + 0x400 } else { F16_BIAS };
        let half = (drawn >> F16_DROPPED).wrapping_sub(lowered).min(F16_MAX);
        // Infinity, or NaN, whose significand must not be 0.
        let digit = u32::from(magnitude > INFINITE);
        let half = if magnitude >= INFINITE { F16_INFINITE | digit } else { half };
        Self((half | (bits >> 16 & 0x8000)) as u16)
    }
}

impl Narrow for F8 {
    #[inline(always)]
    fn to_f32(self) -> f32 {
        let code = u32::from(self.0);
        let x = f32::from_bits((code + F8_BIAS) << F8_DROPPED);
        let x = if code == 0 { 0.0 } else { x };
        if code == F8_NAN { f32::NAN } else { x }
    }

    /// Negative numbers become 0.
    #[inline(always)]
    fn round(x: f32, random: u32) -> Self {
        let size = x.max(0.0);
        let drawn = (size.to_bits() + (random >> (32 - F8_DROPPED))) >> F8_DROPPED;
        let code = drawn.wrapping_sub(F8_BIAS).min(F8_MAX);
        let share = size * F8_INVERSE_LEAST;
        let zero_or_one = u32::from(share > unit(random, 23));
        let code = if share < 1.0 { zero_or_one } else { code };
        Self(if x.is_finite() { code } else { F8_NAN } as u8)
    }
}

/// The upper `digits` random bits as a number in [0, 1).
#[inline(always)]
fn unit(random: u32, digits: u32) -> f32 {
    // Signed, as vectors of signed integers are converted to floats by one instruction.
    (random >> (32 - digits)) as i32 as f32 * (1.0 / (1_u32 << digits) as f32)
}

/// Rounds `x`, within ±32,767, to one of its two neighbouring integers: to the farther one if `draw` is less than the
/// distance to the nearer one. The integer is in the lower 16 bits of the result; the upper bits have no meaning.
#[inline(always)]
fn round_to_integer(x: f32, draw: f32) -> i32 {
    // Adding 1.5·2²³ leaves the nearest integer in the last bits.
    const SHIFT: f32 = 12_582_912.0;
    let shifted = x + SHIFT;
    let remainder = x - (shifted - SHIFT);
    let away = if remainder > 0.0 { 1 } else { -1 };
    let away = if draw < remainder.abs() { away } else { 0 };
    shifted.to_bits() as i32 + away
}

/// Fixed point in 16 bits, for bounded numbers: its spacing is the same everywhere, while that of f16 grows to 2⁻⁷
/// at 9. `digits` is the number of fractional bits.
pub(super) mod fixed {
    /// The code of NaN.
    const NAN: i16 = i16::MIN;
    const MAX: f32 = i16::MAX as f32;

    /// Converts exactly.
    #[inline(always)]
    pub(in super::super) fn to_f32(stored: i16, digits: u32) -> f32 {
        let x = f32::from(stored) * (1.0 / (1_u32 << digits) as f32);
        if stored == NAN { f32::NAN } else { x }
    }

    /// Rounds to one of the two neighbours of `x`, or to the nearer end of the range; non-finite numbers become NaN.
    #[inline(always)]
    pub(in super::super) fn round(x: f32, digits: u32, random: u32) -> i16 {
        let scaled = (x * (1_u32 << digits) as f32).clamp(-MAX, MAX);
        let whole = super::round_to_integer(scaled, super::unit(random, 23)) as i16;
        if x.is_finite() { whole } else { NAN }
    }

    /// Rounds to the nearest number; ties go to even.
    pub(in super::super) fn nearest(x: f32, digits: u32) -> i16 {
        round(x, digits, 1 << 31)
    }
}

/// Converts a plane from fixed point.
#[inline(always)]
pub(super) fn widen_fixed(from: &[i16; WIDTH], to: &mut [f32; WIDTH], digits: u32) {
    for lane in 0..WIDTH {
        to[lane] = fixed::to_f32(from[lane], digits);
    }
}

/// Stores a plane in fixed point with stochastic rounding.
#[inline(always)]
pub(super) fn narrow_fixed(
    from: &[f32; WIDTH],
    to: &mut [i16; WIDTH],
    digits: u32,
    draws: &mut Draws,
) {
    let random = draws.next();
    for lane in 0..WIDTH {
        to[lane] = fixed::round(from[lane], digits, random[lane]);
    }
}

/// Converts whole planes to f32.
#[inline(always)]
pub(super) fn widen<T: Narrow>(from: &[T], to: &mut [f32]) {
    let (from, to) = (from.as_chunks::<WIDTH>().0, to.as_chunks_mut::<WIDTH>().0);
    for (from, to) in from.iter().zip(to) {
        for lane in 0..WIDTH {
            to[lane] = from[lane].to_f32();
        }
    }
}

/// Stores whole planes with stochastic rounding.
#[inline(always)]
pub(super) fn narrow<T: Narrow>(from: &[f32], to: &mut [T], draws: &mut Draws) {
    let (from, to) = (from.as_chunks::<WIDTH>().0, to.as_chunks_mut::<WIDTH>().0);
    for (from, to) in from.iter().zip(to) {
        let random = draws.next();
        for lane in 0..WIDTH {
            to[lane] = T::round(from[lane], random[lane]);
        }
    }
}

/// The first moment, from its stored ratio and the second moment.
#[inline(always)]
pub(super) fn first_moment(ratio: i8, second: f32) -> f32 {
    f32::from(ratio) * RATIO_STEP * second.sqrt()
}

/// The first moments of whole planes.
#[inline(always)]
pub(super) fn first_moments(ratios: &[i8], seconds: &[f32], to: &mut [f32]) {
    for ((to, &ratio), &second) in to.iter_mut().zip(ratios).zip(seconds) {
        *to = first_moment(ratio, second);
    }
}

/// Stores first moments as multiples of the roots of the second moments *as stored*, with stochastic rounding.
///
/// Draws are the midpoints of 2,048 intervals, and so never as small as the rounding error of the division: a ratio
/// that is already representable is unchanged.
#[inline(always)]
pub(super) fn ratios(first: &[f32], second: &[F8], to: &mut [i8], draws: &mut Draws) {
    let (first, second) = (first.as_chunks::<WIDTH>().0, second.as_chunks::<WIDTH>().0);
    let to = to.as_chunks_mut::<WIDTH>().0;
    for ((first, second), to) in first.iter().zip(second).zip(to) {
        let random = draws.next();
        for lane in 0..WIDTH {
            let root = RATIO_STEP * second[lane].to_f32().sqrt();
            let draw = unit(random[lane], 11) + 0.5 / 2048.0;
            // The ratio is 0 if the second moment is 0, even if only because the square underflowed in f32. NaN becomes
            // 0 here, and becomes NaN again when it is multiplied by the second moment, which is NaN.
            let ratio = if root > 0.0 { first[lane] / root } else { 0.0 };
            to[lane] = round_to_integer(ratio.clamp(-127.0, 127.0), draw) as i8;
        }
    }
}

#[cfg(test)]
mod tests;
