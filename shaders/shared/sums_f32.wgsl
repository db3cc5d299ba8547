// The sums of each row, on devices with atomic addition of f32. The order of additions varies, and with it
// the last bits of a sum.

@group(0) @binding(8) var<storage, read_write> row_sums: array<atomic<f32>>;

fn clear(at: u32) {
    atomicStore(&row_sums[at], 0.0);
}

fn add(at: u32, x: f32) {
    atomicAdd(&row_sums[at], x);
}

// Replaces a value by the larger of itself and x. WGSL has no atomic maximum of f32: values are exchanged,
// and an invocation that receives a larger value than it stored puts that value back.
fn raise(at: u32, x: f32) {
    var mine = x;
    loop {
        if !(mine > atomicLoad(&row_sums[at])) {
            break;
        }
        let there = atomicExchange(&row_sums[at], mine);
        if !(there > mine) {
            break;
        }
        mine = there;
    }
}
