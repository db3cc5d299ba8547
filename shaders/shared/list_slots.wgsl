// The entries of the tile lists, sorted by tile, then front to back: each is a slot. list_rows.wgsl replaces this
// file if gradients are accumulated by atomics, which need no slots.

@group(0) @binding(2) var<storage, read> list: array<u32>;
@group(0) @binding(3) var<storage, read> row_of_slot: array<u32>;

// The row of entry i.
fn row_at(i: u32) -> u32 {
    return row_of_slot[list[i]];
}
