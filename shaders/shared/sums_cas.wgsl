// The sums of each row, on devices with atomics for integers only: additions compare and exchange the bits
// of f32. The order of additions varies, and with it the last bits of a sum.

@group(0) @binding(8) var<storage, read_write> row_sums: array<atomic<u32>>;

fn clear(at: u32) {
    atomicStore(&row_sums[at], 0u);
}

fn add(at: u32, x: f32) {
    var known = atomicLoad(&row_sums[at]);
    loop {
        let sum = bitcast<u32>(bitcast<f32>(known) + x);
        let tried = atomicCompareExchangeWeak(&row_sums[at], known, sum);
        if tried.exchanged {
            break;
        }
        known = tried.old_value;
    }
}

// Replaces a value by the larger of itself and x, both >= 0; the bits of such numbers sort like the numbers.
fn raise(at: u32, x: f32) {
    atomicMax(&row_sums[at], bitcast<u32>(x));
}
