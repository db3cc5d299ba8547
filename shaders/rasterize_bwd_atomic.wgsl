// Stage 5 with atomics: pixel gradients are added straight to each row's sums, without records. The
// sums are those of rasterize_bwd.wgsl, but their terms are added in no fixed order.

// Adds the subgroup's contribution to the gradients of loaded splat i; the first loaded splat has index n in the list.
fn add_splat(
    i: u32,
    n: u32,
    m: Member,
    quad: Quad,
    own: Upstream,
    pixels: ptr<function, BackwardPixels>,
) {
    // Initialised explicitly: naga does not reset a variable in each round of a loop.
    var sums = array<f32, FIELDS>();
    let is_blended = backpropagate(loaded_splat(i), n + i, quad, own, pixels, &sums);
    if subgroupAny(is_blended) {
        add_to_row(m, i, sums, RECORD, maximum());
    }
}

// launch.a: the band of tiles that this launch handles.
@compute @workgroup_size(64)
fn rasterize_bwd_atomic(
    @builtin(workgroup_id) id: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let tile = group_of(id);
    if !is_in_band(tile) {
        return;
    }
    let m = member(lane);
    let quad = quad_of(tile, lane);
    let begin = tile_starts[tile];
    let own = upstream(quad);
    let block = block_of(quad);
    var pixels = behind_all(quad, own, tile_starts[tile + 1u] - begin);
    let reached = largest_of_all(m, splats_needed(pixels));
    let batches = (reached + m.members - 1u) / m.members;
    var completed = true;
    var n = 0u;
    for (; n < batches; n++) {
        let first = (batches - 1u - n) * m.members;
        let count = min(m.members, reached - first);
        if m.place < count {
            load_splat(m.place, row_at(begin + first + m.place), quad.corner);
        }
        // A subgroup covers only a part of the tile, and many of the tile's splats do not reach that part.
        let seen = subgroupBallot(m.place < count && may_reach(own_splat, block));
        var word = (count + 31u) / 32u;
        for (; word > 0u; word--) {
            var left = seen[word - 1u];
            while left != 0u {
                let bit = firstLeadingBit(left);
                left ^= 1u << bit;
                add_splat(32u * (word - 1u) + bit, first, m, quad, own, &pixels);
            }
            completed &= left == 0u;
        }
        completed &= word == 0u;
    }
    expect_end(completed && n >= batches);
}

// Sets the sums of all rows to 0, before the first band; launch.a: numbers per row.
@compute @workgroup_size(256)
fn clear_sums(@builtin(global_invocation_id) id: vec3<u32>) {
    let row = index_of(id);
    if row < frame.model.x {
        for (var f = 0u; f < launch.a; f++) {
            clear(row * launch.a + f);
        }
    }
}
