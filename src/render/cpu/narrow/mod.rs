//! Numbers in fewer bits than f32, sixteen at a time, and the random bits that round them.
//!
//! A number between two that can be stored becomes one of them, the nearer more often, so that its
//! mean is what it was (stochastic rounding; Gupta et al. 2015, section 3.1). One that can be stored stays as it is, whatever the draw.
//!
//! Loops over arrays of integers and not `pulp`, which has no vectors of 8 and 16 bits to convert
//! from: inlined into a dispatched kernel, the compiler makes vectors of them.

use densify_policies::rng::{PolicyRng, Purpose};

use super::simd::WIDTH;

/// 2⁻¹⁴: below it, numbers of f16 lie 2⁻²⁴ apart, whatever their size.
const F16_NORMAL: f32 = 6.103_515_6e-5;
/// Bits of the significand that f16 lacks.
const F16_DROPPED: u32 = 13;
/// What the exponent of f32 is too large by in f16, at the place of the exponent.
const F16_BIAS: u32 = 112 << 10;
/// Largest finite number of f16: 65,504.
const F16_MAX: u32 = 0x7bff;
const F16_INFINITE: u32 = 0x7c00;
const INFINITE: u32 = 0x7f80_0000;
/// Bits that [`F8`] lacks: all digits but one.
const F8_DROPPED: u32 = 22;
/// What the upper bits of f32 are too large by in [`F8`]: its least number, 2⁻⁹⁶, has the code 1.
const F8_BIAS: u32 = ((127 - 96) << 1) - 1;
/// 2⁹⁶: below its inverse there is nothing but 0.
const F8_INVERSE_LEAST: f32 = 79_228_162_514_264_337_593_543_950_336.0;
/// Code of the largest finite number of [`F8`], 1.5·2³⁰.
const F8_MAX: u32 = 0xfe;
/// Whatever is no finite number.
const F8_NONE: u32 = 0xff;
/// |first moment| / √(second moment) is at most this: by Cauchy and Schwarz,
/// (1 − β₁)/√((1 − β₂)·(1 − β₁²/β₂)) with β₁ = 0.9, β₂ = 0.999. Where the second is rounded down,
/// large ratios may be cut; noise gives 0.23.
const RATIO_MAX: f32 = 7.3;
const RATIO_STEP: f32 = RATIO_MAX / 127.0;

/// Random bits for the rows of one block: a function of (seed, step, row, purpose, how many were
/// drawn before), and so of nothing that depends on threads.
///
/// A hash begins the sequence of each row; a linear congruential generator (the constants of
/// *Numerical Recipes*) goes on from there. Its upper bits are good, and only those are used.
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

    /// The next number of each row.
    #[inline(always)]
    fn next(&mut self) -> [u32; WIDTH] {
        for state in &mut self.0 {
            *state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        }
        self.0
    }
}

/// A format of sixteen numbers side by side.
pub(super) trait Narrow: Copy + Default {
    /// Exact.
    fn to_f32(self) -> f32;
    /// One of the two neighbours of `x`, by the upper bits of `random`. A finite number stays finite;
    /// one that is not finite does not become so.
    fn between(x: f32, random: u32) -> Self;
    /// The nearest, as the draw in the middle gives it; of two, the larger.
    #[inline(always)]
    fn nearest(x: f32) -> Self {
        Self::between(x, 1 << 31)
    }
}

/// A number of 16 bits with 11 significant ones (IEEE 754 binary16).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(super) struct F16(pub(super) u16);

/// A number that is not negative, in a byte: 7 bits of exponent and one digit. What is not finite is NaN.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(super) struct F8(pub(super) u8);

impl Narrow for F16 {
    #[inline(always)]
    fn to_f32(self) -> f32 {
        let bits = u32::from(self.0);
        let magnitude = bits & 0x7fff;
        let lifted = f32::from_bits((magnitude << F16_DROPPED) + (F16_BIAS << F16_DROPPED));
        // Without exponent, the digits count 2⁻²⁴ from 0; with the least one, from 2⁻¹⁴.
        let one_up = f32::from_bits((magnitude << F16_DROPPED) + (113 << 23));
        let x = if magnitude < 0x400 { one_up - F16_NORMAL } else { lifted };
        let beyond = if magnitude >= F16_INFINITE { INFINITE } else { 0 };
        f32::from_bits(x.to_bits() | beyond | (bits & 0x8000) << 16)
    }

    #[inline(always)]
    fn between(x: f32, random: u32) -> Self {
        let bits = x.to_bits();
        let magnitude = bits & 0x7fff_ffff;
        let size = f32::from_bits(magnitude);
        // From 2⁻¹⁴ to 2⁻¹³ numbers lie as far apart as below; there the digits are the same.
        let is_small = size < F16_NORMAL;
        let lifted = if is_small { size + F16_NORMAL } else { size };
        let drawn = lifted.to_bits() + (random >> (32 - F16_DROPPED));
        let lowered = if is_small { F16_BIAS + 0x400 } else { F16_BIAS };
        let half = (drawn >> F16_DROPPED).wrapping_sub(lowered).min(F16_MAX);
        // Infinite, or NaN, which keeps a digit.
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
        if code == F8_NONE { f32::NAN } else { x }
    }

    /// Of a negative number, 0.
    #[inline(always)]
    fn between(x: f32, random: u32) -> Self {
        let size = x.max(0.0);
        let drawn = (size.to_bits() + (random >> (32 - F8_DROPPED))) >> F8_DROPPED;
        let code = drawn.wrapping_sub(F8_BIAS).min(F8_MAX);
        let share = size * F8_INVERSE_LEAST;
        let least = u32::from(share > unit(random, 23));
        let code = if share < 1.0 { least } else { code };
        Self(if x.is_finite() { code } else { F8_NONE } as u8)
    }
}

/// The upper `digits` of some random bits as a number in [0, 1).
#[inline(always)]
fn unit(random: u32, digits: u32) -> f32 {
    // A signed number, as vectors of those become floats in one instruction.
    (random >> (32 - digits)) as i32 as f32 * (1.0 / (1_u32 << digits) as f32)
}

/// One of the two whole numbers next to `x`, which is within ±32,767, in the lower bits: the one that
/// is farther where `draw` is below the distance to the nearer.
#[inline(always)]
fn whole(x: f32, draw: f32) -> i32 {
    // 1.5·2²³, whose last digits then are the nearest whole number.
    const SHIFT: f32 = 12_582_912.0;
    let shifted = x + SHIFT;
    let beside = x - (shifted - SHIFT);
    let away = if beside > 0.0 { 1 } else { -1 };
    let away = if draw < beside.abs() { away } else { 0 };
    shifted.to_bits() as i32 + away
}

/// A number that is no more than a few, in 16 bits with so many after the point: distances are the
/// same at 9 as at 0, where those of f16 grow to 2⁻⁷.
pub(super) mod fixed {
    /// What is not finite.
    const NONE: i16 = i16::MIN;
    const MOST: f32 = i16::MAX as f32;

    /// Exact.
    #[inline(always)]
    pub(in super::super) fn to_f32(stored: i16, digits: u32) -> f32 {
        let x = f32::from(stored) * (1.0 / (1_u32 << digits) as f32);
        if stored == NONE { f32::NAN } else { x }
    }

    /// One of the two neighbours of `x`, or the end of the range that is nearer; NaN for what is not
    /// finite.
    #[inline(always)]
    pub(in super::super) fn between(x: f32, digits: u32, random: u32) -> i16 {
        let scaled = (x * (1_u32 << digits) as f32).clamp(-MOST, MOST);
        let whole = super::whole(scaled, super::unit(random, 23)) as i16;
        if x.is_finite() { whole } else { NONE }
    }

    /// The nearest; of two, the even one.
    pub(in super::super) fn nearest(x: f32, digits: u32) -> i16 {
        between(x, digits, 1 << 31)
    }
}

/// The numbers of a plane from fixed point.
#[inline(always)]
pub(super) fn widen_fixed(from: &[i16; WIDTH], to: &mut [f32; WIDTH], digits: u32) {
    for lane in 0..WIDTH {
        to[lane] = fixed::to_f32(from[lane], digits);
    }
}

/// Stores the numbers of a plane in fixed point, rounded at random.
#[inline(always)]
pub(super) fn narrow_fixed(
    from: &[f32; WIDTH],
    to: &mut [i16; WIDTH],
    digits: u32,
    draws: &mut Draws,
) {
    let random = draws.next();
    for lane in 0..WIDTH {
        to[lane] = fixed::between(from[lane], digits, random[lane]);
    }
}

/// The numbers of whole planes from what is stored.
#[inline(always)]
pub(super) fn widen<T: Narrow>(from: &[T], to: &mut [f32]) {
    let (from, to) = (from.as_chunks::<WIDTH>().0, to.as_chunks_mut::<WIDTH>().0);
    for (from, to) in from.iter().zip(to) {
        for lane in 0..WIDTH {
            to[lane] = from[lane].to_f32();
        }
    }
}

/// Stores the numbers of whole planes, rounded at random.
#[inline(always)]
pub(super) fn narrow<T: Narrow>(from: &[f32], to: &mut [T], draws: &mut Draws) {
    let (from, to) = (from.as_chunks::<WIDTH>().0, to.as_chunks_mut::<WIDTH>().0);
    for (from, to) in from.iter().zip(to) {
        let random = draws.next();
        for lane in 0..WIDTH {
            to[lane] = T::between(from[lane], random[lane]);
        }
    }
}

/// The first moment of a ratio and the second moment.
#[inline(always)]
pub(super) fn first_moment(ratio: i8, second: f32) -> f32 {
    f32::from(ratio) * RATIO_STEP * second.sqrt()
}

/// The same for whole planes.
#[inline(always)]
pub(super) fn first_moments(ratios: &[i8], seconds: &[f32], to: &mut [f32]) {
    for ((to, &ratio), &second) in to.iter_mut().zip(ratios).zip(seconds) {
        *to = first_moment(ratio, second);
    }
}

/// First moments as multiples of the roots of the second ones *as stored*, rounded at random.
///
/// Draws are the middles of 2,048 steps, and so never as small as the rounding of the division: a ratio
/// that is one already stays.
#[inline(always)]
pub(super) fn ratios(first: &[f32], second: &[F8], to: &mut [i8], draws: &mut Draws) {
    let (first, second) = (first.as_chunks::<WIDTH>().0, second.as_chunks::<WIDTH>().0);
    let to = to.as_chunks_mut::<WIDTH>().0;
    for ((first, second), to) in first.iter().zip(second).zip(to) {
        let random = draws.next();
        for lane in 0..WIDTH {
            let root = RATIO_STEP * second[lane].to_f32().sqrt();
            let draw = unit(random[lane], 11) + 0.5 / 2048.0;
            // Of nothing, nothing: also where the square has vanished in f32. NaN becomes 0, and
            // NaN again with its second moment.
            let ratio = if root > 0.0 { first[lane] / root } else { 0.0 };
            to[lane] = whole(ratio.clamp(-127.0, 127.0), draw) as i8;
        }
    }
}

#[cfg(test)]
mod tests;
