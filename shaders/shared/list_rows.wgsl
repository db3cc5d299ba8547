// The entries of the tile lists, sorted by tile, then front to back: each is a row. list_slots.wgsl replaces this
// file if gradients are accumulated in slots.

@group(0) @binding(2) var<storage, read> list: array<u32>;

// The row of entry i.
fn row_at(i: u32) -> u32 {
    return list[i];
}
