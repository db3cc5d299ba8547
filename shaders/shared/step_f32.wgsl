// Parameters after an optimiser step, as f32. step_f16.wgsl replaces this file if parameters are stored in 16 bits.

alias Coefficient = f32;

// Largest difference of a quaternion's squared length from 1 that is left as it is.
const SLACK: f32 = 0.0;

fn store_stepped_row(row: u32, x: Row) {
    store_row(row, x);
}

// Coefficients 2j and 2j + 1 of a row's band; `width`: their number.
fn load_pair(row: u32, width: u32, j: u32) -> vec2<f32> {
    let at = row * width + 2u * j;
    if 2u * j + 1u == width {
        return vec2(params[at], 0.0);
    }
    return vec2(params[at], params[at + 1u]);
}

// `plane`: the index of coefficient 2j among the parameters of a row, for random rounding.
fn store_pair(row: u32, width: u32, j: u32, plane: u32, x: vec2<f32>) {
    let at = row * width + 2u * j;
    params[at] = x.x;
    if 2u * j + 1u < width {
        params[at + 1u] = x.y;
    }
}
