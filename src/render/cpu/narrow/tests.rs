//! Tests of all representable numbers, of rounding between them, and of the random draws.

#![expect(clippy::float_cmp, reason = "representable numbers are preserved to the last bit")]

use super::*;

/// All random inputs that lead to different stochastic roundings to f16.
fn draws() -> impl Iterator<Item = u32> {
    (0..1 << F16_DROPPED).map(|k| k << (32 - F16_DROPPED))
}

/// Numbers of both signs and every exponent, with arbitrary digits.
fn numbers() -> impl Iterator<Item = f32> {
    (0..=254_u32 << 3).flat_map(|k| {
        let digits = k.wrapping_mul(2_654_435_769) >> 9;
        let size = f32::from_bits((k >> 3) << 23 | digits);
        [size, -size]
    })
}

/// Checks that all codes survive a round trip, whatever the draw.
fn assert_round_trips<T, B>(of_bits: fn(B) -> T, codes: impl Iterator<Item = B>)
where
    T: Narrow + PartialEq + std::fmt::Debug,
    B: Copy + std::fmt::LowerHex,
{
    for bits in codes {
        let (stored, x) = (of_bits(bits), of_bits(bits).to_f32());
        for random in [0, 1, 1 << 31, u32::MAX] {
            let back = T::round(x, random);
            if x.is_nan() {
                assert!(back.to_f32().is_nan(), "{bits:#x}: {back:?}");
            } else {
                assert_eq!(back, stored, "{bits:#x}, {random:#x}: {x:e}");
            }
        }
        if !x.is_nan() {
            assert_eq!(T::nearest(x), stored, "{bits:#x}");
        }
    }
}

#[test]
fn all_codes_survive_a_round_trip() {
    assert_round_trips(F16, 0..=u16::MAX);
    assert_round_trips(F8, 0..=u8::MAX);
}

/// The definition of binary16, IEEE 754-2008, section 3.4.
#[test]
fn f16_numbers_are_those_of_the_standard() {
    for bits in 0..=u16::MAX {
        let [sign, exponent, digits] = [bits >> 15, bits >> 10 & 31, bits & 0x3ff].map(f64::from);
        let size = match bits >> 10 & 31 {
            0 => digits * 2_f64.powi(-24),
            31 if digits == 0.0 => f64::INFINITY,
            31 => f64::NAN,
            _ => (1.0 + digits / 1024.0) * 2_f64.powf(exponent - 15.0),
        };
        let expected = if sign == 0.0 { size } else { -size };
        let found = f64::from(F16(bits).to_f32());
        assert!(found.to_bits() == expected.to_bits() || found.is_nan() && expected.is_nan());
    }
}

/// Checks that over all draws a number in range is rounded to each of its two neighbours with the right frequency, and
/// that a number out of range becomes the nearest end.
fn assert_fair<T: Narrow>(values: &[f32]) {
    let (least, most) = (values[0], values[values.len() - 1]);
    for x in numbers() {
        if x < least || x > most {
            let end = if x < least { least } else { most };
            assert!(draws().all(|random| T::round(x, random).to_f32() == end), "{x:e}");
            continue;
        }
        let above = values.partition_point(|&y| y < x);
        let (low, high) = (values[above.saturating_sub(1)], values[above]);
        let step = f64::from(high) - f64::from(low);
        let share = if step == 0.0 { 1.0 } else { (f64::from(x) - f64::from(low)) / step };
        let mut ups = 0;
        for random in draws() {
            let y = T::round(x, random).to_f32();
            assert!(y == low || y == high, "{x:e} became {y:e}, not {low:e} or {high:e}");
            ups += u32::from(y == high);
        }
        let found = f64::from(ups) / f64::from(1_u32 << F16_DROPPED);
        // Tolerance: one of the 2¹³ distinct draws, and the rounding error of the number added to small values.
        assert!((found - share).abs() < 2.5e-4, "{x:e}: {found} instead of {share}");
    }
}

#[test]
fn f16_rounding_is_fair_and_stays_between_the_neighbours() {
    let halves = (0..=F16_MAX as u16).map(|bits| F16(bits).to_f32());
    let mut values: Vec<f32> = halves.flat_map(|x| [x, -x]).collect();
    values.sort_by(f32::total_cmp);
    assert_fair::<F16>(&values);
    for x in numbers().filter(|x| x.abs() <= 65_504.0) {
        let above = values.partition_point(|&y| y < x);
        let step = f64::from(values[above]) - f64::from(values[above.saturating_sub(1)]);
        let off = f64::from(F16::nearest(x).to_f32()) - f64::from(x);
        assert!(off.abs() <= 0.5001 * step, "{x:e}: the nearest is off by {off:e} of {step:e}");
    }
}

/// Bytes: 7 bits of exponent and one of significand, without a sign.
#[test]
fn f8_rounding_is_fair_and_covers_the_range_that_adam_needs() {
    let values: Vec<f32> = (0..=F8_MAX as u8).map(|bits| F8(bits).to_f32()).collect();
    assert!(values.is_sorted() && values[0] == 0.0, "{values:?}");
    assert!(F8(F8_NAN as u8).to_f32().is_nan());
    let (least, most) = (values[1], values[values.len() - 1]);
    assert_eq!((least, most), (2_f32.powi(-96), 1.5 * 2_f32.powi(30)));
    // The square root of the smallest positive number is within a few times Adam's epsilon, 1e-15.
    assert!(least.sqrt() < 4e-15);
    assert!(values[1..].windows(2).all(|pair| pair[1] <= 1.5 * pair[0]), "{values:?}");
    assert_fair::<F8>(&values);
}

/// Fixed point: representable numbers are preserved, and rounding is fair.
#[test]
fn fixed_point_round_trips_and_rounds_fairly() {
    for (digits, most) in [(11, 16.0_f32), (14, 2.0)] {
        let step = most / 32768.0;
        for stored in -i16::MAX..=i16::MAX {
            let x = fixed::to_f32(stored, digits);
            assert_eq!(f64::from(x), f64::from(stored) * f64::from(step));
            for random in [0, 1, 1 << 31, u32::MAX] {
                assert_eq!(fixed::round(x, digits, random), stored, "{x}");
            }
        }
        for x in [0.1_f32, -0.1, 1e-6, -3e-5, 0.7311, -1.9, 0.99 * most] {
            let low = (x / step).floor();
            let mut ups = 0;
            for random in (0..1 << 14).map(|k| k << 18) {
                let stored = f32::from(fixed::round(x, digits, random));
                assert!(stored == low || stored == low + 1.0, "{x}: {stored}");
                ups += u32::from(stored > low);
            }
            let (found, share) = (f64::from(ups) / 16384.0, f64::from(x / step - low));
            assert!((found - share).abs() < 2e-4, "{x}: {found} instead of {share}");
            let off = fixed::to_f32(fixed::nearest(x, digits), digits) - x;
            assert!(off.abs() <= 0.5 * step, "{x}: the nearest is off by {off}");
        }
        for random in [0, u32::MAX] {
            for x in [most, 9e9, f32::MAX] {
                assert_eq!(fixed::round(x, digits, random), i16::MAX);
                assert_eq!(fixed::round(-x, digits, random), -i16::MAX);
            }
            for x in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
                assert!(fixed::to_f32(fixed::round(x, digits, random), digits).is_nan());
            }
        }
    }
}

#[test]
fn nan_and_infinity_are_never_stored_as_finite() {
    for random in [0, 1 << 31, u32::MAX] {
        for x in [f32::INFINITY, f32::NEG_INFINITY] {
            assert_eq!(F16::round(x, random).to_f32(), x);
            assert!(F8::round(x, random).to_f32().is_nan());
        }
        for bits in [0x7f80_0001, 0x7fff_ffff, 0xff80_0001, 0xffff_ffff, 0x7fc0_0000] {
            let x = f32::from_bits(bits);
            assert!(F16::round(x, random).to_f32().is_nan(), "{bits:#x}");
            assert!(F8::round(x, random).to_f32().is_nan(), "{bits:#x}");
        }
    }
}

/// Representable ratios are preserved for any second moment; others are rounded fairly.
#[test]
fn ratios_round_trip_and_are_rounded_fairly() {
    let rng = PolicyRng::new(3, 1);
    for second in [2e-29_f32, 3e-20, 1.7e-9, 0.4, 1e9] {
        let second = F8::nearest(second);
        for ratio in -127_i8..=127 {
            let x = first_moment(ratio, second.to_f32());
            let mut stored = [0; WIDTH];
            for first_row in 0..40 {
                let [mut draws, ..] = Draws::of_block(&rng, first_row * WIDTH);
                ratios(&[x; WIDTH], &[second; WIDTH], &mut stored, &mut draws);
                assert_eq!(stored, [ratio; WIDTH], "{x:e} of {second:?}");
            }
        }
        for share in [0.1_f32, 0.37, 0.5, 0.99] {
            let root = second.to_f32().sqrt() * RATIO_STEP;
            let mut stored = [0; WIDTH];
            let mut sum = 0;
            for first_row in 0..4096 {
                let [mut draws, ..] = Draws::of_block(&rng, first_row * WIDTH);
                ratios(&[(share - 4.0) * root; WIDTH], &[second; WIDTH], &mut stored, &mut draws);
                assert!(stored.iter().all(|&ratio| ratio == -4 || ratio == -3), "{stored:?}");
                sum += stored.iter().map(|&ratio| u32::from(ratio == -3)).sum::<u32>();
            }
            let n = 4096.0 * WIDTH as f32;
            let deviation = (sum as f32 - n * share) / (n * share * (1.0 - share)).sqrt();
            assert!(deviation.abs() < 5.0, "{share}: off by {deviation} standard errors");
        }
    }
}

/// A second moment of 0 makes the first 0, and one of NaN makes it NaN, so that an audit finds it.
#[test]
fn a_zero_or_nonfinite_second_moment_makes_the_first_zero_or_nan() {
    let [mut draws, ..] = Draws::of_block(&PolicyRng::new(0, 0), 0);
    for (first, second) in [(1e-30, 0.0), (0.0, 0.0), (f32::NAN, f32::NAN), (3.0, f32::INFINITY)] {
        let mut stored = [1; WIDTH];
        ratios(&[first; WIDTH], &[F8::nearest(second); WIDTH], &mut stored, &mut draws);
        assert_eq!(stored, [0; WIDTH], "{first} of {second}");
        assert_eq!(first_moment(0, second).is_nan(), !second.is_finite(), "{first} of {second}");
    }
}

/// Draws of different rows, planes, steps, seeds and arrays are independent.
#[test]
fn draws_are_independent() {
    const BLOCKS: usize = 256;
    const PLANES: usize = 56;
    let table = |seed, step, array: usize| -> Vec<f64> {
        let rng = PolicyRng::new(seed, step);
        let mut values = Vec::new();
        for block in 0..BLOCKS {
            let mut draws = Draws::of_block(&rng, block * WIDTH);
            for _ in 0..PLANES {
                values.extend(
                    draws[array].next().map(|x| f64::from(x >> 8) / f64::from(1 << 24) - 0.5),
                );
            }
        }
        values
    };
    let first = table(1, 500, 0);
    let n = first.len() as f64;
    let mean = first.iter().sum::<f64>() / n;
    let variance = first.iter().map(|x| x * x).sum::<f64>() / n;
    assert!(mean.abs() < 5.0 * (1.0 / 12.0 / n).sqrt(), "{mean}");
    assert!((variance - 1.0 / 12.0).abs() < 5.0 * (1.0 / 180.0 / n).sqrt(), "{variance}");
    let correlation = |a: &[f64], b: &[f64]| {
        let n = a.len().min(b.len()) as f64;
        12.0 * a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>() / n * n.sqrt()
    };
    let found = [
        ("rows", correlation(&first, &first[1..])),
        ("planes", correlation(&first, &first[WIDTH..])),
        ("planes two apart", correlation(&first, &first[2 * WIDTH..])),
        ("blocks", correlation(&first, &first[WIDTH * PLANES..])),
        ("steps", correlation(&first, &table(1, 501, 0))),
        ("seeds", correlation(&first, &table(2, 500, 0))),
        ("arrays", correlation(&first, &table(1, 500, 1))),
        ("arrays", correlation(&table(1, 500, 1), &table(1, 500, 2))),
    ];
    let bad: Vec<_> = found.iter().filter(|(_, deviation)| deviation.abs() > 5.0).collect();
    assert!(bad.is_empty(), "{bad:?}");
}
