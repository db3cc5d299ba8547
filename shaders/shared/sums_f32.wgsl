// The sums of rows where a device adds f32 atomically. What an addition comes after is chance, and so
// are its last bits.

@group(0) @binding(8) var<storage, read_write> row_sums: array<atomic<f32>>;

fn clear(at: u32) {
    atomicStore(&row_sums[at], 0.0);
}

fn add(at: u32, x: f32) {
    atomicAdd(&row_sums[at], x);
}

// Makes a sum the larger of itself and x. There is no such atomic of f32: values are exchanged, and
// whoever takes out a larger one than it has put in puts that in again.
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
