// Stage 3: tile lists to pixels; src/render/cpu/rasterize.rs. quads.wgsl assigns pixels to invocations.

// Red, green, blue (background included), depth.
@group(0) @binding(6) var<storage, read_write> canvas: array<vec4<f32>>;
// Bits of the final transmittance; index in the tile's list at which the pixel stopped, or NONE.
@group(0) @binding(7) var<storage, read_write> finish: array<vec2<u32>>;

// Number of pixels that each row dominates: no other row has a larger blend weight there. Unused if
// they are not counted.
@group(0) @binding(8) var<storage, read_write> dominant: array<atomic<u32>>;

override COUNTS_DOMINANT: bool = false;

// Splats loaded at a time, where all invocations share them (batch.wgsl).
const BATCH: u32 = 64u;

// The state of an invocation's pixels.
struct Shown {
    red: vec4<f32>,
    green: vec4<f32>,
    blue: vec4<f32>,
    depth: vec4<f32>,
    stop: vec4<u32>,
    // The largest weight, and the index of its splat in the list.
    most: vec4<f32>,
    most_at: vec4<u32>,
}

// Blends splat k of the `count` loaded ones, which start at index n of the list.
fn draw(
    k: u32,
    count: u32,
    n: u32,
    quad: Quad,
    pixels: ptr<function, Open>,
    shown: ptr<function, Shown>,
) {
    if k >= count {
        return;
    }
    let went_on = (*pixels).goes_on;
    let splat = loaded_splat(k);
    let w = blend(falloff(splat, quad).exponent, pixels);
    (*shown).red += w * splat.colour.x;
    (*shown).green += w * splat.colour.y;
    (*shown).blue += w * splat.colour.z;
    (*shown).depth += w * splat.b.z;
    if COUNTS_DOMINANT {
        (*shown).most_at = select((*shown).most_at, vec4(n + k), w > (*shown).most);
        (*shown).most = max((*shown).most, w);
    }
    let stops = went_on & !(*pixels).goes_on;
    (*shown).stop = select((*shown).stop, vec4(n + k), stops);
}

// now.a: the band.
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
    var pixels = Open(vec4(1.0), quad.inside);
    let dark = vec4(0.0);
    var shown = Shown(dark, dark, dark, dark, vec4(NONE), dark, vec4(0u));
    var has_ended = true;
    var first = begin;
    for (; first < end; first += m.members) {
        if largest_of_all(m, u32(any(pixels.goes_on))) == 0u {
            break;
        }
        let count = min(m.members, end - first);
        if m.place < count {
            load_splat(m.place, row_of_slot[list[first + m.place]], quad.corner);
        }
        wait_for_all();
        // Four per round, unrolled by hand: compilers do not unroll a body of this size, and the number
        // of rounds is limited (see expect_end).
        var k = 0u;
        for (; k < count && is_needed(any(pixels.goes_on)); k += 4u) {
            draw(k, count, first - begin, quad, &pixels, &shown);
            draw(k + 1u, count, first - begin, quad, &pixels, &shown);
            draw(k + 2u, count, first - begin, quad, &pixels, &shown);
            draw(k + 3u, count, first - begin, quad, &pixels, &shown);
        }
        has_ended &= k >= count || !any(pixels.goes_on);
    }
    expect_end(has_ended && (first >= end || !any(pixels.goes_on)));
    let red = shown.red + pixels.light * frame.background.x;
    let green = shown.green + pixels.light * frame.background.y;
    let blue = shown.blue + pixels.light * frame.background.z;
    for (var p = 0u; p < 4u; p++) {
        if quad.inside[p] {
            let to = quad.place[p];
            canvas[to] = vec4(red[p], green[p], blue[p], shown.depth[p]);
            finish[to] = vec2(bitcast<u32>(pixels.light[p]), shown.stop[p]);
            if COUNTS_DOMINANT && shown.most[p] > 0.0 {
                atomicAdd(&dominant[row_of_slot[list[begin + shown.most_at[p]]]], 1u);
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
