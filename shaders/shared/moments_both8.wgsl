// Adam's moments of the rows that are not frozen, in a byte each, by pairs of a row's numbers; the formats and the
// random numbers are those of src/render/cpu/narrow/. moments_f32.wgsl replaces this file if moments are f32.

// Numbers 2j and 2j + 1 of a row in a word, each as a first moment (the multiple of the root of the second), then a
// second moment. In rows with an odd number of numbers, the last is 0.
@group(0) @binding(3) var<storage, read_write> moments: array<u32>;

const RATIO_STEP: f32 = 7.3 / 127.0;
// Second moments have one bit of significand: the bits that they lack; the difference between the upper bits of an f32
// and the code; 2^-96, the smallest number; the code of the largest number; that of NaN.
const SECOND_DROPPED: u32 = 22u;
const SECOND_BIAS: u32 = 61u;
const SECOND_LEAST: f32 = 1.2621774483536189e-29;
const SECOND_MOST: u32 = 0xfeu;
const SECOND_NAN: u32 = 0xffu;

fn second_of(code: u32) -> f32 {
    var bits = (code + SECOND_BIAS) << SECOND_DROPPED;
    bits = select(bits, 0u, code == 0u);
    return bitcast<f32>(select(bits, 0x7fc00000u, code == SECOND_NAN));
}

fn code_of_second(x: f32, random: u32) -> u32 {
    if !below(x, LARGEST) {
        return SECOND_NAN;
    }
    let size = max(x, 0.0);
    if size < SECOND_LEAST {
        return select(0u, 1u, size * (1.0 / SECOND_LEAST) > unit_of(random, 23u));
    }
    let drawn = (bitcast<u32>(size) + (random >> (32u - SECOND_DROPPED))) >> SECOND_DROPPED;
    return min(drawn - SECOND_BIAS, SECOND_MOST);
}

// The ratio of a byte in two's complement.
fn ratio_of(code: u32) -> f32 {
    return f32(bitcast<i32>(code << 24u) >> 24u);
}

// The ratio of a first moment to the root of the second as stored, in two's complement.
fn code_of_ratio(x: f32, second: f32, random: u32) -> u32 {
    let root = RATIO_STEP * sqrt(second);
    // NaN, too, becomes 0 here; it becomes NaN again when it is multiplied by its second moment, which is NaN.
    if !(root > 0.0) || !below(x, LARGEST) {
        return 0u;
    }
    let ratio = clamp(x / root, -127.0, 127.0);
    return bitcast<u32>(round_to_integer(ratio, unit_of(random, 11u) + 0.5 / 2048.0)) & 0xffu;
}

fn load_moments(own: u32, width: u32, j: u32) -> Moments {
    let word = moments[own * ((width + 1u) / 2u) + j];
    let second = vec2(second_of((word >> 8u) & 0xffu), second_of(word >> 24u));
    let ratio = vec2(ratio_of(word & 0xffu), ratio_of((word >> 16u) & 0xffu));
    return Moments(ratio * RATIO_STEP * sqrt(second), second);
}

// `row`, `plane`: the row, and the index of number 2j among the parameters of a row, for random rounding.
fn store_moments(own: u32, width: u32, j: u32, row: u32, plane: u32, found: Moments) {
    let draws = round_bits(row);
    let of_first = vec2(advanced(draws.y, plane + 1u), advanced(draws.y, plane + 2u));
    let of_second = vec2(advanced(draws.z, plane + 1u), advanced(draws.z, plane + 2u));
    var word = 0u;
    for (var p = 0u; p < 2u; p++) {
        let second = code_of_second(found.second[p], of_second[p]);
        let ratio = code_of_ratio(found.first[p], second_of(second), of_first[p]);
        word |= (ratio | second << 8u) << (16u * p);
    }
    moments[own * ((width + 1u) / 2u) + j] = word;
}
