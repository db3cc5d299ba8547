// Coefficients of colour as f32. colours_f16.wgsl replaces this file if parameters are stored in 16 bits.

alias Coefficient = f32;

// Coefficient k of all three channels.
fn coefficient(row: u32, k: u32) -> vec3<f32> {
    if k == 0u {
        let at = 3u * row;
        return vec3(sh0[at], sh0[at + 1u], sh0[at + 2u]);
    }
    if k < 4u {
        let at = 9u * row + 3u * (k - 1u);
        return vec3(sh1[at], sh1[at + 1u], sh1[at + 2u]);
    }
    if k < 9u {
        let at = 15u * row + 3u * (k - 4u);
        return vec3(sh2[at], sh2[at + 1u], sh2[at + 2u]);
    }
    let at = 21u * row + 3u * (k - 9u);
    return vec3(sh3[at], sh3[at + 1u], sh3[at + 2u]);
}
