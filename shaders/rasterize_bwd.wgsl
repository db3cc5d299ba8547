// Stage 5: pixel gradients to splat gradients, one record per entry; src/backend/cpu/rasterize_bwd.rs
// tells why the sums are what they are.
//
// One tile per group. Four splats at a time: each invocation finds q = α·dL/dα and w = α·T of its
// pixel, back to front; then each of 64 invocations per splat sums over four pixels what the
// parameters need of q and w; then the 64 sums are added in order. So the sum over a tile has one
// order, whatever the device, and four splats share three barriers.

@group(0) @binding(1) var<storage, read> state: State;
@group(0) @binding(2) var<storage, read> list: array<u32>;
@group(0) @binding(3) var<storage, read> row_of_slot: array<u32>;
@group(0) @binding(4) var<storage, read> tile_starts: array<u32>;
@group(0) @binding(5) var<storage, read> splats: array<vec4<f32>>;
@group(0) @binding(6) var<storage, read> finish: array<vec2<u32>>;
// dL/dpixel, plane after plane: red, green, blue, and alpha and depth where MORE is set.
@group(0) @binding(7) var<storage, read> gradient: array<f32>;
// One record per slot.
@group(0) @binding(8) var<storage, read_write> records: array<f32>;

// Fields of a record: 0: what training needs, 1: and the largest blend weight, 2: every field.
override DETAIL: u32 = 0u;
// Whether alpha and depth have gradients.
override MORE: bool = false;

// Splats at a time, and loaded at a time.
const SPLATS: u32 = 4u;
const BATCH: u32 = 16u;
// Invocations that sum for one splat, and pixels that each sums.
const SHARE: u32 = 64u;
const PIXELS: u32 = 4u;
// Half a share. So many rounds of a loop compilers unroll, and it matters: llvmpipe ends all loops of
// an invocation after 65,535 rounds together, which a tile of 3,000 splats would reach otherwise.
const ROUND: u32 = 32u;
// Fields of the longest record.
const FIELDS: u32 = 15u;

// First q and w of each pixel and splat, then the sums of each invocation.
var<workgroup> shared_f: array<f32, 3840>;
var<workgroup> batch: array<vec4<f32>, 48>;
var<workgroup> slots: array<u32, 16>;
var<workgroup> last_stop: atomic<u32>;
var<workgroup> list_end: u32;

struct Upstream {
    rgb: vec3<f32>,
    alpha: f32,
    depth: f32,
}

fn upstream(pixel: vec2<u32>) -> Upstream {
    var g = Upstream(vec3(0.0), 0.0, 0.0);
    if pixel.x < frame.image.x && pixel.y < frame.image.y {
        let size = frame.image.x * frame.image.y;
        let at = pixel.y * frame.image.x + pixel.x;
        g.rgb = vec3(gradient[at], gradient[size + at], gradient[2u * size + at]);
        if MORE {
            g.alpha = gradient[3u * size + at];
            g.depth = gradient[4u * size + at];
        }
    }
    return g;
}

// ROUND values in order, added to one that is given, or the largest of all.
fn reduced(given: f32, first: u32, is_maximum: bool) -> f32 {
    var total = given;
    for (var i = 0u; i < ROUND; i++) {
        let x = shared_f[first + i];
        total = select(total + x, max(total, x), is_maximum);
    }
    return total;
}

fn fields() -> u32 {
    return select(select(9u, 10u, DETAIL == 1u), FIELDS, DETAIL == 2u);
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

    // The pixel of this invocation, as it is behind the splat at hand.
    var light = 1.0;
    var stop = 0u;
    if pixel.x < frame.image.x && pixel.y < frame.image.y {
        let finished = finish[pixel.y * frame.image.x + pixel.x];
        light = bitcast<f32>(finished.x);
        stop = min(finished.y, length);
    }
    let own = upstream(pixel);
    var behind = dot(own.rgb, frame.background.xyz);
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

    if lane == 0u {
        atomicStore(&last_stop, 0u);
    }
    workgroupBarrier();
    atomicMax(&last_stop, stop);
    workgroupBarrier();
    if lane == 0u {
        list_end = atomicLoad(&last_stop);
    }
    let taken = workgroupUniformLoad(&list_end);
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
            let row = row_of_slot[slot];
            let a = splats[3u * row];
            slots[lane] = slot;
            batch[3u * lane] = vec4(a.xy - vec2<f32>(corner), a.zw);
            batch[3u * lane + 1u] = splats[3u * row + 1u];
            batch[3u * lane + 2u] = splats[3u * row + 2u];
        }
        workgroupBarrier();
        // Groups of four splats, back to front; in each the last comes first.
        for (var top = i32(count); top > 0; top -= i32(SPLATS)) {
            for (var k = 0u; k < SPLATS; k++) {
                let i = top - 1 - i32(k);
                var q = 0.0;
                var w = 0.0;
                if i >= 0 && first + u32(i) < stop {
                    let a = batch[3 * i];
                    let b = batch[3 * i + 1];
                    let d = at - a.xy;
                    let u = a.z * (d.x - a.w * d.y);
                    let z = b.x * d.y;
                    let e = b.y - u * u - z * z;
                    if e >= -LOG2_REACH {
                        let unclamped = exp2(e);
                        let alpha = min(unclamped, ALPHA_MAX);
                        light = light / (1.0 - alpha);
                        w = alpha * light;
                        var here = dot(batch[3 * i + 2].xyz, own.rgb);
                        if MORE {
                            here += own.alpha + b.z * own.depth;
                        }
                        let ahead = here - behind;
                        behind = behind + alpha * ahead;
                        // No gradient where alpha is at its clamp.
                        q = select(0.0, w * ahead, unclamped <= ALPHA_MAX);
                    }
                }
                shared_f[k * 512u + lane] = q;
                shared_f[k * 512u + GROUP + lane] = w;
            }
            workgroupBarrier();
            // Said aloud: naga does not start a variable anew in each round of a loop.
            var sums = array<f32, 15>();
            let i = top - 1 - i32(mine);
            if i >= 0 {
                let a = batch[3 * i];
                let l3 = batch[3 * i + 1].x;
                for (var k = 0u; k < PIXELS; k++) {
                    let p = share * PIXELS + k;
                    let q = shared_f[mine * 512u + p];
                    let w = shared_f[mine * 512u + GROUP + p];
                    let d = vec2<f32>(pixel_of(p)) + 0.5 - a.xy;
                    let u = a.z * (d.x - a.w * d.y);
                    let z = l3 * d.y;
                    let qu = q * u;
                    let qz = q * z;
                    sums[0] += q;
                    sums[1] += qu;
                    sums[2] += qz;
                    sums[3] += qu * u;
                    sums[4] += qu * z;
                    sums[5] += qz * z;
                    sums[6] += w * their_g[k].x;
                    sums[7] += w * their_g[k].y;
                    sums[8] += w * their_g[k].z;
                    if DETAIL == 1u {
                        sums[9] = max(sums[9], w);
                    }
                    if DETAIL == 2u {
                        sums[9] += abs(qu);
                        sums[10] += abs(l3 * qz - a.z * a.w * qu);
                        sums[11] += w;
                        sums[12] += select(0.0, 1.0, w > 0.0);
                        sums[13] += w * their_depth[k];
                        sums[14] = max(sums[14], w);
                    }
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
                    let is_maximum = (DETAIL == 1u && f == 9u) || (DETAIL == 2u && f == 14u);
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
            let is_maximum = (DETAIL == 1u && f == 9u) || (DETAIL == 2u && f == 14u);
            totals[f] = select(totals[f] + x, max(totals[f], x), is_maximum);
        }
    }
    for (var f = 0u; f < stride; f++) {
        row_sums[row * stride + f] = totals[f];
    }
}
