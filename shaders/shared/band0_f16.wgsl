// Writes band 0 of colour as f16, rounded to nearest. band0_f32.wgsl replaces this file if parameters are f32.

alias Coefficient = u32;

fn store_band0(row: u32, x: vec3<f32>) {
    sh0[2u * row] = code_of_half(x.x, NEAREST) | code_of_half(x.y, NEAREST) << 16u;
    sh0[2u * row + 1u] = code_of_half(x.z, NEAREST);
}
