// Stage 3: from tile lists to pixels, as in src/render/cpu/rasterize.rs. quads.wgsl assigns pixels to invocations.

// Red, green, blue (background included), depth.
@group(0) @binding(6) var<storage, read_write> canvas: array<vec4<f32>>;
// Bits of the final transmittance; index in the tile's list at which the pixel stopped, or NONE.
@group(0) @binding(7) var<storage, read_write> finish: array<vec2<u32>>;

// Number of pixels that each row dominates: no other row has a larger blend weight there. Used only if
// COUNTS_DOMINANT is set.
@group(0) @binding(8) var<storage, read_write> dominant: array<atomic<u32>>;

override COUNTS_DOMINANT: bool = false;

// Number of splats loaded at a time if all invocations share them (batch.wgsl).
const BATCH: u32 = 64u;

// What has been accumulated in an invocation's pixels.
struct Accumulated {
    red: vec4<f32>,
    green: vec4<f32>,
    blue: vec4<f32>,
    depth: vec4<f32>,
    // Inverse depth from which distances are taken; 0 where none is given.
    given: vec4<f32>,
    stop: vec4<u32>,
    // The largest blend weight, and the index of its splat in the tile's list.
    most: vec4<f32>,
    most_at: vec4<u32>,
}

// Blends splat k of the `count` loaded ones, which start at index n of the list.
fn blend_splat(
    k: u32,
    count: u32,
    n: u32,
    quad: Quad,
    pixels: ptr<function, ForwardPixels>,
    accumulated: ptr<function, Accumulated>,
) {
    if k >= count {
        return;
    }
    let was_unfinished = (*pixels).unfinished;
    let splat = loaded_splat(k);
    let w = blend(falloff(splat, quad).exponent, pixels);
    (*accumulated).red += w * splat.colour.x;
    (*accumulated).green += w * splat.colour.y;
    (*accumulated).blue += w * splat.colour.z;
    if DEPTH_IN_LOSS {
        let x = select(splat.b.z, splat.b.w, (frame.draw.w & INVERSE_DEPTH) != 0u);
        let difference = x - (*accumulated).given;
        let by_distance = (frame.draw.w & DEPTH_DISTANCES) != 0u;
        (*accumulated).depth += w * select(difference, abs(difference), by_distance);
    } else {
        (*accumulated).depth += w * splat.b.z;
    }
    if COUNTS_DOMINANT {
        (*accumulated).most_at = select((*accumulated).most_at, vec4(n + k), w > (*accumulated).most);
        (*accumulated).most = max((*accumulated).most, w);
    }
    let stops = was_unfinished & !(*pixels).unfinished;
    (*accumulated).stop = select((*accumulated).stop, vec4(n + k), stops);
}

// launch.a: the band of tiles that this launch handles.
@compute @workgroup_size(64)
fn rasterize(
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
    let end = tile_starts[tile + 1u];
    var pixels = ForwardPixels(vec4(1.0), quad.inside);
    let zero = vec4(0.0);
    var accumulated = Accumulated(zero, zero, zero, zero, zero, vec4(NONE), zero, vec4(0u));
    if DEPTH_IN_LOSS && (frame.draw.w & DEPTH_DISTANCES) != 0u {
        for (var p = 0u; p < 4u; p++) {
            if quad.inside[p] {
                // Written by `place_depth` (depth_gradient.wgsl).
                accumulated.given[p] = canvas[quad.place[p]].w;
            }
        }
    }
    var completed = true;
    var first = begin;
    for (; first < end; first += m.members) {
        if largest_of_all(m, u32(any(pixels.unfinished))) == 0u {
            break;
        }
        let count = min(m.members, end - first);
        if m.place < count {
            load_splat(m.place, row_at(first + m.place), quad.corner);
        }
        wait_for_all();
        // Four splats per round, unrolled by hand: compilers do not unroll a body of this size, and the number
        // of rounds is limited (see expect_end).
        var k = 0u;
        for (; k < count && is_needed(any(pixels.unfinished)); k += 4u) {
            blend_splat(k, count, first - begin, quad, &pixels, &accumulated);
            blend_splat(k + 1u, count, first - begin, quad, &pixels, &accumulated);
            blend_splat(k + 2u, count, first - begin, quad, &pixels, &accumulated);
            blend_splat(k + 3u, count, first - begin, quad, &pixels, &accumulated);
        }
        completed &= k >= count || !any(pixels.unfinished);
    }
    expect_end(completed && (first >= end || !any(pixels.unfinished)));
    let red = accumulated.red + pixels.light * frame.background.x;
    let green = accumulated.green + pixels.light * frame.background.y;
    let blue = accumulated.blue + pixels.light * frame.background.z;
    for (var p = 0u; p < 4u; p++) {
        if quad.inside[p] {
            let to = quad.place[p];
            canvas[to] = vec4(red[p], green[p], blue[p], accumulated.depth[p]);
            finish[to] = vec2(bitcast<u32>(pixels.light[p]), accumulated.stop[p]);
            if COUNTS_DOMINANT && accumulated.most[p] > 0.0 {
                atomicAdd(&dominant[row_at(begin + accumulated.most_at[p])], 1u);
            }
        }
    }
}

@compute @workgroup_size(256)
fn clear_dominant(@builtin(global_invocation_id) id: vec3<u32>) {
    let row = index_of(id);
    if row < frame.model.x {
        atomicStore(&dominant[row], 0u);
    }
}
