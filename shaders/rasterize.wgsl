// Stage 3: tile lists to pixels, one tile per group and one pixel per invocation;
// src/backend/cpu/rasterize.rs.

@group(0) @binding(1) var<storage, read> state: State;
// Slots, tile after tile, front to back.
@group(0) @binding(2) var<storage, read> list: array<u32>;
@group(0) @binding(3) var<storage, read> row_of_slot: array<u32>;
@group(0) @binding(4) var<storage, read> tile_starts: array<u32>;
@group(0) @binding(5) var<storage, read> splats: array<vec4<f32>>;
// Red, green, blue (background included), depth.
@group(0) @binding(6) var<storage, read_write> canvas: array<vec4<f32>>;
// Bits of the final transmittance; place in the tile's list at which the pixel stopped, NONE if it
// did not.
@group(0) @binding(7) var<storage, read_write> finish: array<vec2<u32>>;

// Splats in a round of the inner loop, which compilers unroll; rasterize_bwd.wgsl says why.
const ROUND: u32 = 8u;

// Splats of a batch: mean within the tile, l1, shear | l3, log2 of the opacity, depth | colour.
var<workgroup> batch_a: array<vec4<f32>, 256>;
var<workgroup> batch_b: array<vec4<f32>, 256>;
var<workgroup> batch_c: array<vec4<f32>, 256>;
var<workgroup> stopped: atomic<u32>;
var<workgroup> all_stopped: u32;

// now.a: the band.
@compute @workgroup_size(256)
fn rasterize(
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
    let inside = pixel.x < frame.image.x && pixel.y < frame.image.y;
    let at = vec2<f32>(place) + 0.5;
    let begin = tile_starts[tile];
    let end = tile_starts[tile + 1u];

    var light = 1.0;
    var colour = vec3(0.0);
    var depth = 0.0;
    var stop = NONE;
    var done = !inside;
    if lane == 0u {
        atomicStore(&stopped, 0u);
    }
    workgroupBarrier();
    if done {
        atomicAdd(&stopped, 1u);
    }
    for (var first = begin; first < end; first += GROUP) {
        // Nobody reads the batch any more, and all have counted themselves.
        workgroupBarrier();
        if lane == 0u {
            all_stopped = atomicLoad(&stopped);
        }
        if first + lane < end {
            let row = row_of_slot[list[first + lane]];
            let a = splats[3u * row];
            batch_a[lane] = vec4(a.xy - vec2<f32>(corner), a.zw);
            batch_b[lane] = splats[3u * row + 1u];
            batch_c[lane] = splats[3u * row + 2u];
        }
        if workgroupUniformLoad(&all_stopped) == GROUP {
            break;
        }
        let count = min(GROUP, end - first);
        if !done {
            for (var round = 0u; round < count && !done; round += ROUND) {
                for (var i = 0u; i < ROUND; i++) {
                    let k = round + i;
                    let a = batch_a[k];
                    let b = batch_b[k];
                    let d = at - a.xy;
                    let u = a.z * (d.x - a.w * d.y);
                    let z = b.x * d.y;
                    let e = b.y - u * u - z * z;
                    if e >= -LOG2_REACH && k < count && !done {
                        let alpha = min(exp2(e), ALPHA_MAX);
                        let next = light - alpha * light;
                        if next <= TRANSMITTANCE_MIN {
                            stop = first - begin + k;
                            done = true;
                        } else {
                            let w = alpha * light;
                            colour += w * batch_c[k].xyz;
                            depth += w * b.z;
                            light = next;
                        }
                    }
                }
            }
            if done {
                atomicAdd(&stopped, 1u);
            }
        }
    }
    if inside {
        let to = pixel.y * frame.image.x + pixel.x;
        canvas[to] = vec4(colour + light * frame.background.xyz, depth);
        finish[to] = vec2(bitcast<u32>(light), stop);
    }
}
