// The sums of observe.wgsl, but added with atomics straight to each row's sums, as in rasterize_bwd_atomic.wgsl.

// The pixel map (see `PixelMap` in the policies), followed by the depths below which a row is in front of the surface.
@group(0) @binding(6) var<storage, read> map: array<f32>;

// Adds the subgroup's contribution to the sums of splat i of the `count` loaded ones.
fn add_splat(
    i: u32,
    count: u32,
    m: Member,
    quad: Quad,
    map_here: MapPart,
    pixels: ptr<function, ForwardPixels>,
) {
    if i >= count {
        return;
    }
    var columns = splat_sums(loaded_splat(i), quad, map_here, pixels);
    // The second column is the number of pixels.
    if subgroupAny(columns[1] > 0.0) {
        var sums = array<f32, FIELDS>();
        for (var f = 0u; f < COLUMNS; f++) {
            sums[f] = columns[f];
        }
        add_to_row(m, i, sums, COLUMNS, MAXIMUM);
    }
}

// launch.a: the band of tiles that this launch handles.
@compute @workgroup_size(64)
fn replay_atomic(
    @builtin(workgroup_id) id: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let tile = group_of(id);
    if !is_in_band(tile) {
        return;
    }
    let m = member(lane);
    let quad = quad_of(tile, lane);
    let map_here = map_at(quad);
    var pixels = ForwardPixels(vec4(1.0), quad.inside);
    let end = tile_starts[tile + 1u];
    var completed = true;
    var first = tile_starts[tile];
    for (; first < end; first += m.members) {
        if largest_of_all(m, u32(any(pixels.unfinished))) == 0u {
            break;
        }
        let count = min(m.members, end - first);
        if m.place < count {
            load_splat(m.place, row_at(first + m.place), quad.corner);
        }
        // Four splats per round, unrolled by hand as in rasterize_bwd_atomic.wgsl.
        var i = 0u;
        for (; i < count; i += 4u) {
            add_splat(i, count, m, quad, map_here, &pixels);
            add_splat(i + 1u, count, m, quad, map_here, &pixels);
            add_splat(i + 2u, count, m, quad, map_here, &pixels);
            add_splat(i + 3u, count, m, quad, map_here, &pixels);
        }
        completed &= i >= count;
    }
    expect_end(completed && (first >= end || !any(pixels.unfinished)));
}
