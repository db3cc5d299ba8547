// The random numbers of a step's rounding, as in src/render/cpu/narrow/.

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
