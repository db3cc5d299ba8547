// The slots of each row, for the sums over its records. emit_rows.wgsl replaces this file if gradients are accumulated
// by atomics.

// First slot and number of slots of each row.
@group(0) @binding(12) var<storage, read_write> slots_of_row: array<vec2<u32>>;

fn store_slots(row: u32, first: u32, count: u32) {
    slots_of_row[row] = vec2(first, count);
}
