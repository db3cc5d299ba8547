// Writes band 0 of colour as f32. band0_f16.wgsl replaces this file if parameters are stored in 16 bits.

alias Coefficient = f32;

fn store_band0(row: u32, x: vec3<f32>) {
    for (var k = 0u; k < 3u; k++) {
        sh0[3u * row + k] = x[k];
    }
}
