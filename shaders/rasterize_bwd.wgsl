// Stage 5 in slots: pixel gradients to splat gradients, one record per entry, then one sum per row.
// rasterize_bwd_atomic.wgsl is the other way; both build on backward.wgsl.
//
// One tile per group. Four splats at a time: each invocation finds q and w of its pixel, back to front;
// then each of 64 invocations per splat sums over four pixels what the parameters need of q and w; then
// the 64 sums are added in order. So the sum over a tile has one order, whatever the device, and four
// splats share three barriers.

// One record per slot.
@group(0) @binding(8) var<storage, read_write> records: array<f32>;

// Invocations that sum for one splat, and pixels that each sums.
const SHARE: u32 = 64u;
const PIXELS: u32 = 4u;
// Half a share. So many rounds of a loop compilers unroll, and it matters: llvmpipe ends all loops of
// an invocation after 65,535 rounds together, which a tile of 3,000 splats would reach otherwise.
const ROUND: u32 = 32u;

// First q and w of each pixel and splat, then the sums of each invocation.
var<workgroup> shared_f: array<f32, 3840>;
var<workgroup> slots: array<u32, 16>;

// ROUND values in order, added to one that is given, or the largest of all.
fn reduced(given: f32, first: u32, is_maximum: bool) -> f32 {
    var total = given;
    for (var i = 0u; i < ROUND; i++) {
        let x = shared_f[first + i];
        total = select(total + x, max(total, x), is_maximum);
    }
    return total;
}

// now.a: the band.
@compute @workgroup_size(256)
fn rasterize_bwd(
    @builtin(workgroup_id) id: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let tile = group_of(id);
    if tile >= frame.image.w || tile < state.cuts[now.a] || tile >= state.cuts[now.a + 1u] {
        return;
    }
    let corner = vec2(tile % frame.image.z, tile / frame.image.z) * TILE;
    let place = pixel_of(lane);
    let pixel = corner + place;
    let at = vec2<f32>(place) + 0.5;
    let begin = tile_starts[tile];
    let length = tile_starts[tile + 1u] - begin;

    let own = upstream(pixel);
    var ours = Pixel(1.0, dot(own.rgb, frame.background.xyz));
    var stop = 0u;
    if pixel.x < frame.image.x && pixel.y < frame.image.y {
        let finished = finish[pixel.y * frame.image.x + pixel.x];
        ours.light = bitcast<f32>(finished.x);
        stop = min(finished.y, length);
    }
    // The pixels that this invocation sums over.
    let share = lane % SHARE;
    let mine = lane / SHARE;
    var their_g: array<vec3<f32>, 4>;
    var their_depth: array<f32, 4>;
    for (var k = 0u; k < PIXELS; k++) {
        let g = upstream(corner + pixel_of(share * PIXELS + k));
        their_g[k] = g.rgb;
        their_depth[k] = g.depth;
    }

    let taken = taken_by_any(lane, stop);
    let stride = fields();
    // Nobody takes these.
    for (var i = taken + lane; i < length; i += GROUP) {
        let slot = list[begin + i];
        for (var f = 0u; f < stride; f++) {
            records[slot * stride + f] = 0.0;
        }
    }

    let batches = (taken + BATCH - 1u) / BATCH;
    for (var n = 0u; n < batches; n++) {
        let first = (batches - 1u - n) * BATCH;
        let count = min(BATCH, taken - first);
        workgroupBarrier();
        if lane < count {
            let slot = list[begin + first + lane];
            slots[lane] = slot;
            load(lane, row_of_slot[slot], corner);
        }
        workgroupBarrier();
        // Groups of four splats, back to front; in each the last comes first.
        for (var top = i32(count); top > 0; top -= i32(SPLATS)) {
            for (var k = 0u; k < SPLATS; k++) {
                let i = top - 1 - i32(k);
                var found = vec2(0.0);
                if i >= 0 && first + u32(i) < stop {
                    found = differentiated(u32(i), at, own, &ours);
                }
                shared_f[k * 512u + lane] = found.x;
                shared_f[k * 512u + GROUP + lane] = found.y;
            }
            workgroupBarrier();
            // Said aloud: naga does not start a variable anew in each round of a loop.
            var sums = array<f32, 15>();
            let i = top - 1 - i32(mine);
            if i >= 0 {
                for (var k = 0u; k < PIXELS; k++) {
                    let p = share * PIXELS + k;
                    let q = shared_f[mine * 512u + p];
                    let w = shared_f[mine * 512u + GROUP + p];
                    let centre = vec2<f32>(pixel_of(p)) + 0.5;
                    add_pixel(&sums, u32(i), centre, q, w, their_g[k], their_depth[k]);
                }
            }
            workgroupBarrier();
            for (var f = 0u; f < stride; f++) {
                shared_f[f * GROUP + lane] = sums[f];
            }
            workgroupBarrier();
            // One invocation per field of each splat.
            if lane < SPLATS * stride {
                let k = lane / stride;
                let f = lane % stride;
                let which = top - 1 - i32(k);
                if which >= 0 {
                    let is_maximum = f == maximum();
                    let first = f * GROUP + k * SHARE;
                    let half = reduced(0.0, first, is_maximum);
                    records[slots[which] * stride + f] = reduced(half, first + ROUND, is_maximum);
                }
            }
            workgroupBarrier();
        }
    }
}

// --- Records to one sum per row -------------------------------------------------------------------

@group(0) @binding(9) var<storage, read> depths: array<u32>;
@group(0) @binding(10) var<storage, read> slots_of_row: array<vec2<u32>>;
@group(0) @binding(11) var<storage, read> all_records: array<f32>;
@group(0) @binding(12) var<storage, read_write> row_sums: array<f32>;

// Adds a row's records, which lie side by side, in order; now.a: the band.
@compute @workgroup_size(256)
fn gather(
    @builtin(workgroup_id) id: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let row = group_of(id) * GROUP + lane;
    if row >= frame.model.x || depths[row] == NONE {
        return;
    }
    let stride = fields();
    let slots = slots_of_row[row];
    var totals: array<f32, 15>;
    if now.a > 0u {
        for (var f = 0u; f < stride; f++) {
            totals[f] = row_sums[row * stride + f];
        }
    }
    for (var i = 0u; i < slots.y; i++) {
        let source = (slots.x + i) * stride;
        for (var f = 0u; f < stride; f++) {
            let x = all_records[source + f];
            totals[f] = select(totals[f] + x, max(totals[f], x), f == maximum());
        }
    }
    for (var f = 0u; f < stride; f++) {
        row_sums[row * stride + f] = totals[f];
    }
}
