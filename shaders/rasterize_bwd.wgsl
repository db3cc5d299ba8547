// Stage 5 without atomics: from pixel gradients to splat gradients, one record per entry, then one sum per
// row. rasterize_bwd_atomic.wgsl does the same with atomics; both use backward.wgsl.

// One record per slot.
@group(0) @binding(8) var<storage, read_write> records: array<f32>;

// Stores an invocation's contribution to the gradients of loaded splat i, the kth splat of a round.
fn store_splat(
    k: u32,
    i: i32,
    first: u32,
    lane: u32,
    quad: Quad,
    own: Upstream,
    pixels: ptr<function, BackwardPixels>,
) {
    // Initialised explicitly: naga does not reset a variable in each round of a loop.
    var sums = array<f32, FIELDS>();
    if i >= 0 {
        _ = backpropagate(loaded_splat(u32(i)), first + u32(i), quad, own, pixels, &sums);
    }
    for (var f = 0u; f < RECORD; f++) {
        store_part(k * RECORD + f, lane, sums[f]);
    }
}

// launch.a: the band of tiles that this launch handles.
@compute @workgroup_size(64)
fn rasterize_bwd(
    @builtin(workgroup_id) id: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let tile = group_of(id);
    if !is_in_band(tile) {
        return;
    }
    let quad = quad_of(tile, lane);
    let begin = tile_starts[tile];
    let length = tile_starts[tile + 1u] - begin;
    let own = upstream(quad);
    var pixels = behind_all(quad, own, length);

    let m = member(lane);
    let reached = largest_of_all(m, splats_needed(pixels));
    // No pixel blends a splat behind the first `reached` ones.
    var i = reached + lane;
    for (; i < length; i += MEMBERS) {
        let slot = list[begin + i];
        for (var f = 0u; f < RECORD; f++) {
            records[slot * RECORD + f] = 0.0;
        }
    }
    var completed = i >= length;

    let batches = (reached + BATCH - 1u) / BATCH;
    var n = 0u;
    for (; n < batches; n++) {
        let first = (batches - 1u - n) * BATCH;
        let count = min(BATCH, reached - first);
        load_batch(begin + first, count, lane, quad.corner);
        // Four splats per round, back to front. Unrolled by hand: compilers do not unroll a body of this
        // size. Of the longest records, shared memory holds the parts of only three.
        let splats_per_round = select(SPLATS, 3u, RECORD == FIELDS);
        var top = i32(count);
        for (; top > 0; top -= i32(splats_per_round)) {
            store_splat(0u, top - 1, first, lane, quad, own, &pixels);
            store_splat(1u, top - 2, first, lane, quad, own, &pixels);
            store_splat(2u, top - 3, first, lane, quad, own, &pixels);
            if splats_per_round > 3u {
                store_splat(3u, top - 4, first, lane, quad, own, &pixels);
            }
            wait_for_all();
            // One invocation per field of each splat.
            let which = top - 1 - i32(lane / RECORD);
            if lane < splats_per_round * RECORD && which >= 0 {
                let f = lane % RECORD;
                records[slots[which] * RECORD + f] = summed(lane, f == maximum());
            }
            wait_for_all();
        }
        completed &= top <= 0;
    }
    expect_end(completed && n >= batches);
}

// --- From records to one sum per row -------------------------------------------------------------------

@group(0) @binding(10) var<storage, read> slots_of_row: array<vec2<u32>>;
@group(0) @binding(11) var<storage, read> all_records: array<f32>;
@group(0) @binding(12) var<storage, read_write> row_sums: array<f32>;

// Sums a row's records, which are contiguous, in order; launch.a: the band of tiles.
@compute @workgroup_size(256)
fn gather(@builtin(global_invocation_id) id: vec3<u32>) {
    let row = index_of(id);
    if row >= frame.model.x || !(splats[SPLAT * row + DEPTH] > 0.0) {
        return;
    }
    let slots = slots_of_row[row];
    var totals: array<f32, FIELDS>;
    if launch.a > 0u {
        for (var f = 0u; f < RECORD; f++) {
            totals[f] = row_sums[row * RECORD + f];
        }
    }
    for (var i = 0u; i < slots.y; i++) {
        let source = (slots.x + i) * RECORD;
        for (var f = 0u; f < RECORD; f++) {
            let x = all_records[source + f];
            totals[f] = select(totals[f] + x, max(totals[f], x), f == maximum());
        }
    }
    for (var f = 0u; f < RECORD; f++) {
        row_sums[row * RECORD + f] = totals[f];
    }
}
