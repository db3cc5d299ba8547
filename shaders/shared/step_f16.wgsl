// Parameters after an optimiser step, in 16 bits and rounded at random. step_f32.wgsl replaces this file if parameters
// are f32.

alias Coefficient = u32;

// If quaternions were normalised and rounded at each step, even a row without a gradient would rotate randomly.
const SLACK: f32 = 0.0625;

fn store_stepped_row(row: u32, x: Row) {
    var random = round_bits(row).x;
    var of_number: array<u32, 8>;
    for (var k = 0u; k < 8u; k++) {
        random = advanced(random, 1u);
        of_number[k] = random;
    }
    store_rounded(row, x, of_number);
}

fn load_pair(row: u32, width: u32, j: u32) -> vec2<f32> {
    let word = params[row * ((width + 1u) / 2u) + j];
    return vec2(half_of(word), half_of(word >> 16u));
}

// Means, which are never rounded, take no random numbers.
fn store_pair(row: u32, width: u32, j: u32, plane: u32, x: vec2<f32>) {
    let random = advanced(round_bits(row).x, plane - 2u);
    let low = code_of_half(x.x, random);
    let high = code_of_half(x.y, advanced(random, 1u));
    params[row * ((width + 1u) / 2u) + j] = low | high << 16u;
}
