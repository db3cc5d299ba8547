// Sums over the pixels that a row is blended into, as in observe.wgsl, straight to the sums of rows, as
// in rasterize_bwd_atomic.wgsl.

@group(0) @binding(1) var<storage, read> state: State;
@group(0) @binding(2) var<storage, read> list: array<u32>;
@group(0) @binding(3) var<storage, read> row_of_slot: array<u32>;
@group(0) @binding(4) var<storage, read> tile_starts: array<u32>;
@group(0) @binding(5) var<storage, read> splats: array<vec4<f32>>;
// The pixel map.
@group(0) @binding(6) var<storage, read> map: array<f32>;

// Sums of the map, of pixels, of weights, of distances.
const COLUMNS: u32 = 4u;

var<workgroup> batch: array<vec4<f32>, 32>;

// Splat i of the batch in a pixel that has `light` left: 0 once it has stopped, and outside the image.
fn take(
    i: u32,
    count: u32,
    m: Member,
    at: vec2<f32>,
    map_here: f32,
    light: ptr<function, f32>,
) {
    var w = 0.0;
    var sums = vec4(0.0);
    if i < count && *light > 0.0 {
        let a = batch[2u * i];
        let b = batch[2u * i + 1u];
        let d = at - a.xy;
        let u = a.z * (d.x - a.w * d.y);
        let z = b.x * d.y;
        let e = b.y - u * u - z * z;
        if e >= -LOG2_REACH {
            let alpha = min(exp2(e), ALPHA_MAX);
            let next = *light - alpha * *light;
            if next <= TRANSMITTANCE_MIN {
                *light = 0.0;
            } else {
                w = alpha * *light;
                *light = next;
                sums = vec4(map_here, 1.0, w, sqrt(dot(d, d)));
            }
        }
    }
    if subgroupAny(w > 0.0) {
        sums = subgroupAdd(sums);
    }
    if m.is_first && i < count {
        let first = (i * m.subgroups + m.subgroup) * COLUMNS;
        for (var f = 0u; f < COLUMNS; f++) {
            parts[first + f] = sums[f];
        }
    }
}

// now.a: the band.
@compute @workgroup_size(256)
fn replay_atomic(
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
    var light = select(0.0, 1.0, inside);
    var map_here = 0.0;
    if inside {
        map_here = map[pixel.y * frame.image.x + pixel.x];
    }
    let begin = tile_starts[tile];
    let end = tile_starts[tile + 1u];
    let m = member(lane);
    let most = room(m, COLUMNS);
    for (var first = begin; first < end; first += most) {
        let count = min(most, end - first);
        workgroupBarrier();
        if lane < count {
            let row = row_of_slot[list[first + lane]];
            let a = splats[3u * row];
            rows[lane] = row;
            batch[2u * lane] = vec4(a.xy - vec2<f32>(corner), a.zw);
            batch[2u * lane + 1u] = splats[3u * row + 1u];
        }
        workgroupBarrier();
        // Four in a round, written out, as in rasterize_bwd_atomic.wgsl.
        for (var i = 0u; i < count; i += 4u) {
            take(i, count, m, at, map_here, &light);
            take(i + 1u, count, m, at, map_here, &light);
            take(i + 2u, count, m, at, map_here, &light);
            take(i + 3u, count, m, at, map_here, &light);
        }
        workgroupBarrier();
        deliver(m, lane, count, COLUMNS, NONE);
    }
}
