// Auxiliary views: sums over the pixels into which each row is blended, front to back, as in
// src/render/cpu/observe.rs. One record per entry, as in rasterize_bwd.wgsl.

// The pixel map (see `PixelMap` in the policies), followed by the depths below which a row is in front of the surface.
@group(0) @binding(6) var<storage, read> map: array<f32>;
// One record per slot: the values of `splat_sums`.
@group(0) @binding(7) var<storage, read_write> records: array<f32>;

// Stores an invocation's contribution to the sums of loaded splat i, the kth splat of a round.
fn store_splat(
    k: u32,
    i: u32,
    count: u32,
    lane: u32,
    quad: Quad,
    map_here: MapPart,
    pixels: ptr<function, ForwardPixels>,
) {
    var sums = array<f32, COLUMNS>();
    if i < count {
        sums = splat_sums(loaded_splat(i), quad, map_here, pixels);
    }
    for (var f = 0u; f < COLUMNS; f++) {
        store_part(k * COLUMNS + f, lane, sums[f]);
    }
}

// launch.a: the band of tiles that this launch handles.
@compute @workgroup_size(64)
fn replay(
    @builtin(workgroup_id) id: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let tile = group_of(id);
    if !is_in_band(tile) {
        return;
    }
    let quad = quad_of(tile, lane);
    let map_here = map_at(quad);
    var pixels = ForwardPixels(vec4(1.0), quad.inside);
    let begin = tile_starts[tile];
    let end = tile_starts[tile + 1u];
    var completed = true;
    var first = begin;
    for (; first < end; first += BATCH) {
        let count = min(BATCH, end - first);
        load_batch(first, count, lane, quad.corner);
        // Unrolled by hand: compilers do not unroll a body of this size.
        var base = 0u;
        for (; base < count; base += SPLATS) {
            store_splat(0u, base, count, lane, quad, map_here, &pixels);
            store_splat(1u, base + 1u, count, lane, quad, map_here, &pixels);
            store_splat(2u, base + 2u, count, lane, quad, map_here, &pixels);
            store_splat(3u, base + 3u, count, lane, quad, map_here, &pixels);
            wait_for_all();
            // One invocation per column of each splat.
            let which = base + lane / COLUMNS;
            if lane < SPLATS * COLUMNS && which < count {
                records[slots[which] * COLUMNS + lane % COLUMNS] =
                    summed(lane, lane % COLUMNS == MAXIMUM);
            }
            wait_for_all();
        }
        completed &= base >= count;
    }
    expect_end(completed && first >= end);
}

@group(0) @binding(9) var<storage, read> slots_of_row: array<vec2<u32>>;
@group(0) @binding(10) var<storage, read> all_records: array<f32>;
@group(0) @binding(11) var<storage, read_write> row_sums: array<f32>;

// Sums a row's records in order; launch.a: the band of tiles.
@compute @workgroup_size(256)
fn gather_columns(@builtin(global_invocation_id) id: vec3<u32>) {
    let row = index_of(id);
    if row >= frame.model.x {
        return;
    }
    var totals = array<f32, COLUMNS>();
    if launch.a > 0u {
        for (var f = 0u; f < COLUMNS; f++) {
            totals[f] = row_sums[row * COLUMNS + f];
        }
    }
    if splats[SPLAT * row + DEPTH] > 0.0 {
        let slots = slots_of_row[row];
        for (var i = 0u; i < slots.y; i++) {
            for (var f = 0u; f < COLUMNS; f++) {
                let x = all_records[(slots.x + i) * COLUMNS + f];
                totals[f] = select(totals[f] + x, max(totals[f], x), f == MAXIMUM);
            }
        }
    }
    for (var f = 0u; f < COLUMNS; f++) {
        row_sums[row * COLUMNS + f] = totals[f];
    }
}
