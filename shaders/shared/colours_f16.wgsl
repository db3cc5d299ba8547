// Coefficients of colour as f16, two in a word; each row begins with a new word. colours_f32.wgsl replaces this file if
// parameters are f32.

alias Coefficient = u32;

// Three coefficients from the two words that contain them.
fn three_of(a: u32, b: u32, is_second: bool) -> vec3<f32> {
    let first = vec3(half_of(a), half_of(a >> 16u), half_of(b));
    let second = vec3(half_of(a >> 16u), half_of(b), half_of(b >> 16u));
    return select(first, second, is_second);
}

// Coefficient k of all three channels.
fn coefficient(row: u32, k: u32) -> vec3<f32> {
    if k == 0u {
        return three_of(sh0[2u * row], sh0[2u * row + 1u], false);
    }
    if k < 4u {
        let number = 3u * (k - 1u);
        let at = 5u * row + number / 2u;
        return three_of(sh1[at], sh1[at + 1u], number % 2u == 1u);
    }
    if k < 9u {
        let number = 3u * (k - 4u);
        let at = 8u * row + number / 2u;
        return three_of(sh2[at], sh2[at + 1u], number % 2u == 1u);
    }
    let number = 3u * (k - 9u);
    let at = 11u * row + number / 2u;
    return three_of(sh3[at], sh3[at + 1u], number % 2u == 1u);
}
