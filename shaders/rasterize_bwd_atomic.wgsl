// Stage 5 with atomics: pixel gradients straight to the sums of rows, without records. The sums are those
// of rasterize_bwd.wgsl, in an order that is chance.
//
// What an invocation finds in its pixels, a subgroup adds up by itself, unless none of its pixels takes
// the splat. Over the subgroups, and to the rows: subgroups.wgsl.

// What the tile's invocations find of splat i at hand.
fn find(
    i: i32,
    first: u32,
    m: Member,
    quad: Quad,
    own: Upstream,
    pixels: ptr<function, Behind>,
) {
    // Said aloud: naga does not start a variable anew in each round of a loop.
    var sums = array<f32, FIELDS>();
    var is_taken = false;
    if i >= 0 {
        is_taken = differentiated(u32(i), first + u32(i), quad, own, pixels, &sums);
    }
    let stride = fields();
    if subgroupAny(is_taken) {
        for (var f = 0u; f < stride; f++) {
            if f == maximum() {
                sums[f] = subgroupMax(sums[f]);
            } else {
                sums[f] = subgroupAdd(sums[f]);
            }
        }
    }
    if m.is_first && i >= 0 {
        let to = (u32(i) * m.subgroups + m.subgroup) * stride;
        for (var f = 0u; f < stride; f++) {
            parts[to + f] = sums[f];
        }
    }
}

// now.a: the band.
@compute @workgroup_size(64)
fn rasterize_bwd_atomic(
    @builtin(workgroup_id) id: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let tile = group_of(id);
    if !is_in_band(tile) {
        return;
    }
    let quad = quad_of(tile, lane);
    let begin = tile_starts[tile];
    let own = upstream(quad);
    var pixels = behind_all(quad, own, tile_starts[tile + 1u] - begin);

    let reached = reached_by_any(lane, pixels.stop);
    let m = member(lane);
    let stride = fields();
    let most = room(m, stride);
    let batches = (reached + most - 1u) / most;
    for (var n = 0u; n < batches; n++) {
        let first = (batches - 1u - n) * most;
        let count = min(most, reached - first);
        workgroupBarrier();
        if lane < count {
            let row = row_of_slot[list[begin + first + lane]];
            rows[lane] = row;
            load(lane, row, quad.corner);
        }
        workgroupBarrier();
        // Four in a round, written out: compilers do not unroll as much as this is, and rounds are
        // counted (slots.wgsl says where).
        for (var top = i32(count); top > 0; top -= 4) {
            find(top - 1, first, m, quad, own, &pixels);
            find(top - 2, first, m, quad, own, &pixels);
            find(top - 3, first, m, quad, own, &pixels);
            find(top - 4, first, m, quad, own, &pixels);
        }
        workgroupBarrier();
        deliver(m, lane, count, stride, maximum());
    }
}

// Sets the sums of all rows to 0, before the first band; now.a: numbers per row.
@compute @workgroup_size(256)
fn clear_sums(
    @builtin(workgroup_id) id: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let row = group_of(id) * GROUP + lane;
    if row < frame.model.x {
        for (var f = 0u; f < now.a; f++) {
            clear(row * now.a + f);
        }
    }
}
