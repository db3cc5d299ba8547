// Sums over the pixels that a row is blended into, as in observe.wgsl, straight to the sums of rows, as
// in rasterize_bwd_atomic.wgsl.

// The pixel map.
@group(0) @binding(6) var<storage, read> map: array<f32>;

// What the tile's invocations find of splat i at hand.
fn find(
    i: u32,
    count: u32,
    m: Member,
    quad: Quad,
    map_here: vec4<f32>,
    pixels: ptr<function, Open>,
) {
    var sums = vec4(0.0);
    if i < count {
        sums = blended(i, quad, map_here, pixels);
    }
    // The second counts pixels.
    if subgroupAny(sums.y > 0.0) {
        sums = subgroupAdd(sums);
    }
    if m.is_first && i < count {
        let to = (i * m.subgroups + m.subgroup) * COLUMNS;
        for (var f = 0u; f < COLUMNS; f++) {
            parts[to + f] = sums[f];
        }
    }
}

// now.a: the band.
@compute @workgroup_size(64)
fn replay_atomic(
    @builtin(workgroup_id) id: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let tile = group_of(id);
    if !is_in_band(tile) {
        return;
    }
    let quad = quad_of(tile, lane);
    let map_here = map_at(quad);
    var pixels = Open(vec4(1.0), quad.inside);
    let begin = tile_starts[tile];
    let end = tile_starts[tile + 1u];
    let m = member(lane);
    let most = room(m, COLUMNS);
    for (var first = begin; first < end; first += most) {
        let count = min(most, end - first);
        workgroupBarrier();
        if lane < count {
            let row = row_of_slot[list[first + lane]];
            rows[lane] = row;
            load(lane, row, quad.corner);
        }
        workgroupBarrier();
        // Four in a round, written out, as in rasterize_bwd_atomic.wgsl.
        for (var i = 0u; i < count; i += 4u) {
            find(i, count, m, quad, map_here, &pixels);
            find(i + 1u, count, m, quad, map_here, &pixels);
            find(i + 2u, count, m, quad, map_here, &pixels);
            find(i + 3u, count, m, quad, map_here, &pixels);
        }
        workgroupBarrier();
        deliver(m, lane, count, COLUMNS, NONE);
    }
}
