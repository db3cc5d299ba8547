// The worst pixels of a view, and surface points of chosen pixels, one per invocation;
// src/backend/cpu/candidates.rs.

@group(0) @binding(1) var<storage, read> state: State;
@group(0) @binding(2) var<storage, read> list: array<u32>;
@group(0) @binding(3) var<storage, read> row_of_slot: array<u32>;
@group(0) @binding(4) var<storage, read> tile_starts: array<u32>;
@group(0) @binding(5) var<storage, read> splats: array<vec4<f32>>;
@group(0) @binding(6) var<storage, read> rows: array<f32>;
// Numbers of the pixels.
@group(0) @binding(7) var<storage, read> pixels: array<u32>;
// Where the surface is, and its depth; depth 0 where there is none.
@group(0) @binding(8) var<storage, read_write> points: array<vec4<f32>>;


// now.a: the band, now.b: how many pixels, now.c: the surface is at the largest blend weight (0) or
// where half the light is gone (1), now.d: place of the first in `points`.
@compute @workgroup_size(256)
fn surface(
    @builtin(workgroup_id) id: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let i = group_of(id) * GROUP + lane;
    if i >= now.b {
        return;
    }
    let pixel = vec2(pixels[i] % frame.image.x, pixels[i] / frame.image.x);
    let tile = pixel.y / TILE * frame.image.z + pixel.x / TILE;
    if tile < state.cuts[now.a] || tile >= state.cuts[now.a + 1u] {
        return;
    }
    let at = vec2<f32>(pixel) + 0.5;
    let row = surface_row(tile, at, now.c == 1u);
    var point = vec4(0.0);
    if row != NONE {
        point = closest_approach(row, at);
    }
    points[now.d + i] = point;
}

fn surface_row(tile: u32, at: vec2<f32>, is_median: bool) -> u32 {
    var light = 1.0;
    var best = NONE;
    var most = 0.0;
    for (var k = tile_starts[tile]; k < tile_starts[tile + 1u]; k++) {
        let row = row_of_slot[list[k]];
        let a = splats[3u * row];
        let b = splats[3u * row + 1u];
        let d = at - a.xy;
        let u = a.z * (d.x - a.w * d.y);
        let z = b.x * d.y;
        let alpha = min(exp2(b.y - u * u - z * z), ALPHA_MAX);
        if !(alpha >= ALPHA_MIN) {
            continue;
        }
        let weight = alpha * light;
        light -= weight;
        if is_median {
            if light < 0.5 {
                return row;
            }
        } else if weight > most {
            most = weight;
            best = row;
        }
        if light <= TRANSMITTANCE_MIN {
            break;
        }
    }
    return best;
}

// Where the ray through `at` comes closest to the row, in its Mahalanobis metric; w: the depth there.
fn closest_approach(row: u32, at: vec2<f32>) -> vec4<f32> {
    let ratio = (at - frame.lens.zw) / frame.lens.xy;
    // Camera z along this vector is 1, so that the parameter of the ray is the depth.
    let ray = frame.rotation[0].xyz * ratio.x + frame.rotation[1].xyz * ratio.y + frame.rotation[2].xyz;
    let base = 12u * row;
    let mean = vec3(rows[base], rows[base + 1u], rows[base + 2u]);
    let scale = vec3(
        exp_exact(rows[base + 3u]),
        exp_exact(rows[base + 4u]),
        exp_exact(rows[base + 5u]),
    );
    let back = vec4(rows[base + 6u], -rows[base + 7u], -rows[base + 8u], -rows[base + 9u]);
    let direction = rotate(back, ray) / scale;
    let offset = rotate(back, frame.centre.xyz - mean) / scale;
    let depth = -dot(direction, offset) / dot(direction, direction);
    if !below(depth, LARGEST) || depth <= frame.centre.w {
        return vec4(0.0);
    }
    return vec4(frame.centre.xyz + ray * depth, depth);
}

// --- The worst pixels ------------------------------------------------------------------------------

// Bits of the final transmittance, and where the pixel stopped.
@group(0) @binding(9) var<storage, read> finish: array<vec2<u32>>;
// The error per pixel, or three planes of its gradient.
@group(0) @binding(10) var<storage, read> map: array<f32>;
// The first digits of the least error that is wanted; how many are wanted of those that begin so; how
// many are written down. Then, per digit, how many of those go on so.
@group(0) @binding(11) var<storage, read_write> selection: array<atomic<u32>>;
// How many there are; then bits of the error, and the pixel, in any order.
@group(0) @binding(12) var<storage, read_write> worst: array<vec2<u32>>;

// Base of the digits, and where their counts begin.
const DIGITS: u32 = 256u;
const COUNTS: u32 = 4u;

var<workgroup> counts: array<atomic<u32>, 256>;

// Bits of the error of a pixel at which a candidate may be, which are in the order of the errors; 0
// for others. now.c: bits of the least alpha, now.d: 1 where the map is the gradient's.
fn key_of(pixel: u32) -> u32 {
    let size = frame.image.x * frame.image.y;
    if pixel >= size || !(1.0 - bitcast<f32>(finish[pixel].x) >= bitcast<f32>(now.c)) {
        return 0u;
    }
    var error = map[pixel];
    if now.d == 1u {
        let g = vec3(error, map[size + pixel], map[2u * size + pixel]);
        error = sqrt(g.x * g.x + g.y * g.y + g.z * g.z);
    }
    return select(0u, bitcast<u32>(error), error > 0.0);
}

// Counts the digits that follow those found; now.a: how far up they stand, now.b: 1 for the first.
@compute @workgroup_size(256)
fn count_errors(
    @builtin(workgroup_id) id: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    atomicStore(&counts[lane], 0u);
    workgroupBarrier();
    let key = key_of(group_of(id) * GROUP + lane);
    // A shift by all 32 bits is none.
    if key != 0u && (now.b == 1u || key >> (now.a + 8u) == atomicLoad(&selection[0])) {
        atomicAdd(&counts[(key >> now.a) % DIGITS], 1u);
    }
    workgroupBarrier();
    let count = atomicLoad(&counts[lane]);
    if count > 0u {
        atomicAdd(&selection[COUNTS + lane], count);
    }
}

// now.a: 0 to begin, with now.b wanted; 1 to find the next digit; 2 to say how many were written.
@compute @workgroup_size(256)
fn narrow(@builtin(local_invocation_index) lane: u32) {
    if lane == 0u {
        if now.a == 0u {
            atomicStore(&selection[0], 0u);
            atomicStore(&selection[1], now.b);
            atomicStore(&selection[2], 0u);
        } else if now.a == 1u {
            var wanted = atomicLoad(&selection[1]);
            var digit = DIGITS - 1u;
            for (; digit > 0u; digit--) {
                let here = atomicLoad(&selection[COUNTS + digit]);
                if here >= wanted {
                    break;
                }
                wanted -= here;
            }
            atomicStore(&selection[0], atomicLoad(&selection[0]) * DIGITS + digit);
            atomicStore(&selection[1], wanted);
        } else {
            worst[0] = vec2(atomicLoad(&selection[2]), 0u);
        }
    }
    storageBarrier();
    atomicStore(&selection[COUNTS + lane], 0u);
}

// Writes down every pixel whose error is not less than the least that is wanted; now.b: how many there
// is room for.
@compute @workgroup_size(256)
fn write_worst(
    @builtin(workgroup_id) id: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let pixel = group_of(id) * GROUP + lane;
    let key = key_of(pixel);
    if key != 0u && key >= atomicLoad(&selection[0]) {
        let place = atomicAdd(&selection[2], 1u);
        if place < now.b {
            worst[1u + place] = vec2(key, pixel);
        }
    }
}
