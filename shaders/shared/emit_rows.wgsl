// Entries without slots; emit_slots.wgsl replaces this file if gradients are accumulated in slots.

fn store_slots(row: u32, first: u32, count: u32) {
}
