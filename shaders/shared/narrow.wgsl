// Numbers of 16 bits, and random rounding to integers, as in src/render/cpu/narrow/. Rounding with the random bits
// NEAREST gives the nearest number.

const NEAREST: u32 = 0x80000000u;

// The upper `digits` random bits as a number in [0, 1).
fn unit_of(random: u32, digits: u32) -> f32 {
    return f32(random >> (32u - digits)) * (1.0 / f32(1u << digits));
}

// Rounds x, within ±32,767, to one of its two neighbouring integers: to the farther one if `draw` is less than the
// distance to the nearer one.
fn round_to_integer(x: f32, draw: f32) -> i32 {
    let nearest = round(x);
    let beside = x - nearest;
    let away = select(-1, 1, beside > 0.0);
    return i32(nearest) + select(0, away, draw < abs(beside));
}

// Fixed point with `digits` fractional bits, in two's complement; the smallest code is NaN.
fn fixed_of(code: u32, digits: u32) -> f32 {
    let x = f32(bitcast<i32>(code << 16u) >> 16u) * (1.0 / f32(1u << digits));
    return bitcast<f32>(select(bitcast<u32>(x), 0x7fc00000u, (code & 0xffffu) == 0x8000u));
}

fn code_of_fixed(x: f32, digits: u32, random: u32) -> u32 {
    if !below(x, LARGEST) {
        return 0x8000u;
    }
    let scaled = clamp(x * f32(1u << digits), -32767.0, 32767.0);
    return bitcast<u32>(round_to_integer(scaled, unit_of(random, 23u))) & 0xffffu;
}

// IEEE 754 binary16: 2^-14, below which its spacing is constant, and the difference between the exponent biases.
const HALF_NORMAL: f32 = 6.103515625e-5;
const HALF_BIAS: u32 = 114688u;

fn half_of(code: u32) -> f32 {
    let magnitude = (code & 0x7fffu) << 13u;
    let small = bitcast<f32>(magnitude + (113u << 23u)) - HALF_NORMAL;
    var bits = magnitude + (HALF_BIAS << 13u);
    bits = select(bits, bitcast<u32>(small), magnitude < (0x400u << 13u));
    bits |= select(0u, 0x7f800000u, magnitude >= (0x7c00u << 13u));
    return bitcast<f32>(bits | (code & 0x8000u) << 16u);
}

fn code_of_half(x: f32, random: u32) -> u32 {
    let bits = bitcast<u32>(x);
    let sign = (bits >> 16u) & 0x8000u;
    let magnitude = bits & 0x7fffffffu;
    if magnitude >= 0x7f800000u {
        return sign | 0x7c00u | select(0u, 1u, magnitude > 0x7f800000u);
    }
    let size = bitcast<f32>(magnitude);
    let is_small = size < HALF_NORMAL;
    let lifted = bitcast<u32>(select(size, size + HALF_NORMAL, is_small));
    let lowered = select(HALF_BIAS, HALF_BIAS + 0x400u, is_small);
    return sign | min(((lifted + (random >> 19u)) >> 13u) - lowered, 0x7bffu);
}
