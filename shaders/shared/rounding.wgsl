// Random rounding of numbers that are stored in fewer bits, as in src/render/cpu/narrow/.

const PURPOSE_ROUND: u32 = 5u;

// The starts of a row's random sequences in this step: for parameters, first moments and second moments.
fn round_bits(row: u32) -> vec4<u32> {
    return draw_bits(row, frame.draw.y, frame.draw.x, PURPOSE_ROUND, 0u);
}

// The element of a random sequence `steps` < 64 after `start`: a linear congruential generator.
fn advanced(start: u32, steps: u32) -> u32 {
    var state = start;
    var factor = 1664525u;
    var added = 1013904223u;
    // Bit by bit of `steps`: the generator's step, then two of these, then four…
    for (var bit = 0u; bit < 6u; bit++) {
        state = select(state, state * factor + added, ((steps >> bit) & 1u) != 0u);
        added *= factor + 1u;
        factor *= factor;
    }
    return state;
}

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
