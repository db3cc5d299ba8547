// Sums over the pixels that a row is blended into, front to back, for auxiliary views;
// src/backend/cpu/observe.rs. One tile per group, four splats at a time, as in rasterize_bwd.wgsl.

@group(0) @binding(1) var<storage, read> state: State;
@group(0) @binding(2) var<storage, read> list: array<u32>;
@group(0) @binding(3) var<storage, read> row_of_slot: array<u32>;
@group(0) @binding(4) var<storage, read> tile_starts: array<u32>;
@group(0) @binding(5) var<storage, read> splats: array<vec4<f32>>;
// The pixel map.
@group(0) @binding(6) var<storage, read> map: array<f32>;
// Per slot: sums of the map, of pixels, of weights, of distances.
@group(0) @binding(7) var<storage, read_write> records: array<vec4<f32>>;

const SPLATS: u32 = 4u;
const BATCH: u32 = 16u;
const SHARE: u32 = 64u;
const ROUND: u32 = 32u;

var<workgroup> parts: array<vec4<f32>, 256>;
var<workgroup> weights: array<f32, 1024>;
var<workgroup> map_of: array<f32, 256>;
var<workgroup> batch: array<vec4<f32>, 32>;
var<workgroup> slots: array<u32, 16>;

// ROUND parts in order, added to what is given.
fn added(given: vec4<f32>, first: u32) -> vec4<f32> {
    var total = given;
    for (var i = 0u; i < ROUND; i++) {
        total += parts[first + i];
    }
    return total;
}

// now.a: the band.
@compute @workgroup_size(256)
fn replay(
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
    let inside = pixel.x < frame.image.x && pixel.y < frame.image.y;
    // 0 once the pixel has stopped, and outside the image.
    var light = select(0.0, 1.0, inside);
    map_of[lane] = 0.0;
    if inside {
        map_of[lane] = map[pixel.y * frame.image.x + pixel.x];
    }
    let share = lane % SHARE;
    let mine = lane / SHARE;
    let begin = tile_starts[tile];
    let end = tile_starts[tile + 1u];
    for (var first = begin; first < end; first += BATCH) {
        let count = min(BATCH, end - first);
        workgroupBarrier();
        if lane < count {
            let slot = list[first + lane];
            let row = row_of_slot[slot];
            let a = splats[3u * row];
            slots[lane] = slot;
            batch[2u * lane] = vec4(a.xy - vec2<f32>(corner), a.zw);
            batch[2u * lane + 1u] = splats[3u * row + 1u];
        }
        workgroupBarrier();
        for (var base = 0u; base < count; base += SPLATS) {
            for (var k = 0u; k < SPLATS; k++) {
                var w = 0.0;
                if base + k < count && light > 0.0 {
                    let a = batch[2u * (base + k)];
                    let b = batch[2u * (base + k) + 1u];
                    let d = at - a.xy;
                    let u = a.z * (d.x - a.w * d.y);
                    let z = b.x * d.y;
                    let e = b.y - u * u - z * z;
                    if e >= -LOG2_REACH {
                        let alpha = min(exp2(e), ALPHA_MAX);
                        let next = light - alpha * light;
                        if next <= TRANSMITTANCE_MIN {
                            light = 0.0;
                        } else {
                            w = alpha * light;
                            light = next;
                        }
                    }
                }
                weights[k * GROUP + lane] = w;
            }
            workgroupBarrier();
            var sums = vec4(0.0);
            if base + mine < count {
                let mean = batch[2u * (base + mine)].xy;
                for (var k = 0u; k < 4u; k++) {
                    let p = share * 4u + k;
                    let w = weights[mine * GROUP + p];
                    if w > 0.0 {
                        let d = vec2<f32>(pixel_of(p)) + 0.5 - mean;
                        sums += vec4(map_of[p], 1.0, w, sqrt(dot(d, d)));
                    }
                }
            }
            parts[lane] = sums;
            workgroupBarrier();
            if lane < SPLATS && base + lane < count {
                let half = added(vec4(0.0), lane * SHARE);
                records[slots[base + lane]] = added(half, lane * SHARE + ROUND);
            }
            workgroupBarrier();
        }
    }
}

@group(0) @binding(8) var<storage, read> depths: array<u32>;
@group(0) @binding(9) var<storage, read> slots_of_row: array<vec2<u32>>;
@group(0) @binding(10) var<storage, read> all_records: array<vec4<f32>>;
@group(0) @binding(11) var<storage, read_write> row_sums: array<vec4<f32>>;

// Adds a row's records in order; now.a: the band.
@compute @workgroup_size(256)
fn gather_columns(
    @builtin(workgroup_id) id: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let row = group_of(id) * GROUP + lane;
    if row >= frame.model.x {
        return;
    }
    var total = vec4(0.0);
    if now.a > 0u {
        total = row_sums[row];
    }
    if depths[row] != NONE {
        let slots = slots_of_row[row];
        for (var i = 0u; i < slots.y; i++) {
            total += all_records[slots.x + i];
        }
    }
    row_sums[row] = total;
}
