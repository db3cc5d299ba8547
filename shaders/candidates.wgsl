// Finds the surface points of given pixels, one pixel per invocation, and the pixels of a view with the largest
// errors; see src/render/cpu/candidates.rs.

@group(0) @binding(1) var<storage, read> state: State;
@group(0) @binding(4) var<storage, read> tile_starts: array<u32>;
@group(0) @binding(5) var<storage, read> splats: array<f32>;
@group(0) @binding(6) var<storage, read> rows: array<RowPart>;
// Indices of the pixels.
@group(0) @binding(7) var<storage, read> pixels: array<u32>;
// Surface points, with their depths; depth 0: no surface.
@group(0) @binding(8) var<storage, read_write> points: array<vec4<f32>>;


// launch.a: the band of tiles, launch.b: number of pixels, launch.c: the surface is at the largest blend weight (0) or
// at transmittance 1/2 (1), launch.d: index in `points` of the first pixel's point.
@compute @workgroup_size(256)
fn surface(@builtin(global_invocation_id) id: vec3<u32>) {
    let i = index_of(id);
    if i >= launch.b {
        return;
    }
    let pixel = vec2(pixels[i] % frame.image.x, pixels[i] / frame.image.x);
    let tile = pixel.y / TILE * frame.image.z + pixel.x / TILE;
    if tile < state.cuts[launch.a] || tile >= state.cuts[launch.a + 1u] {
        return;
    }
    let at = vec2<f32>(pixel) + 0.5;
    let row = surface_row(tile, at, launch.c == 1u);
    var point = vec4(0.0);
    if row != NONE {
        point = closest_approach(row, at);
    }
    points[launch.d + i] = point;
}

// A quarter of numbers for another purpose, then the depths of the pixels; 0: not known.
@group(0) @binding(13) var<storage, read_write> depths: array<f32>;

// Completes the depths with those of the rows at which transmittance falls below 1/2, and reduces all to those below
// which a row is in front of the surface. launch.a: the band of tiles, launch.b: number of pixels, launch.c: bits of the
// factor.
@compute @workgroup_size(256)
fn find_front(@builtin(global_invocation_id) id: vec3<u32>) {
    let pixel = index_of(id);
    if pixel >= launch.b {
        return;
    }
    let at = vec2(pixel % frame.image.x, pixel / frame.image.x);
    let tile = at.y / TILE * frame.image.z + at.x / TILE;
    if tile < state.cuts[launch.a] || tile >= state.cuts[launch.a + 1u] {
        return;
    }
    var depth = depths[launch.b + pixel];
    if depth == 0.0 {
        let row = surface_row(tile, vec2<f32>(at) + 0.5, true);
        if row != NONE {
            depth = splats[SPLAT * row + DEPTH];
        }
    }
    depths[launch.b + pixel] = depth * bitcast<f32>(launch.c);
}

fn surface_row(tile: u32, at: vec2<f32>, is_median: bool) -> u32 {
    var light = 1.0;
    var best = NONE;
    var most = 0.0;
    for (var k = tile_starts[tile]; k < tile_starts[tile + 1u]; k++) {
        let row = row_at(k);
        let first = SPLAT * row;
        let d = at - vec2(splats[first], splats[first + 1u]);
        let u = splats[first + 2u] * (d.x - splats[first + 3u] * d.y);
        let z = splats[first + 4u] * d.y;
        let alpha = min(exp2(splats[first + 5u] - u * u - z * z), ALPHA_MAX);
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

// The point of the ray through `at` that is closest to the row's mean in the row's Mahalanobis
// metric; w: the point's depth.
fn closest_approach(row: u32, at: vec2<f32>) -> vec4<f32> {
    let ratio = (at - frame.lens.zw) / frame.lens.xy;
    // This vector has camera z = 1, so the parameter along the ray is the depth.
    let ray = frame.rotation[0].xyz * ratio.x + frame.rotation[1].xyz * ratio.y + frame.rotation[2].xyz;
    let known = load_row(row);
    let mean = known.mean;
    let s = known.log_scale;
    let scale = vec3(exp_exact(s.x), exp_exact(s.y), exp_exact(s.z));
    let back = vec4(known.quat.x, -known.quat.yzw);
    let direction = rotate(back, ray) / scale;
    let offset = rotate(back, frame.centre.xyz - mean) / scale;
    let depth = -dot(direction, offset) / dot(direction, direction);
    if !below(depth, LARGEST) || depth <= frame.centre.w {
        return vec4(0.0);
    }
    return vec4(frame.centre.xyz + ray * depth, depth);
}

// --- The pixels with the largest errors: a radix selection -----------------------------------------

// Bits of the final transmittance, and the index at which the pixel stopped.
@group(0) @binding(9) var<storage, read> finish: array<vec2<u32>>;
// The error per pixel; or the canvas, with the gradient and then an error in four numbers per pixel.
@group(0) @binding(10) var<storage, read> map: array<f32>;
// The known leading digits of the smallest error to be selected; the number of pixels still to be selected among
// those whose errors begin with these digits; the number of pixels written. Then a histogram of the next digit.
@group(0) @binding(11) var<storage, read_write> selection: array<atomic<u32>>;
// The number of selected pixels; then, in no particular order, bits of the error and index of each.
@group(0) @binding(12) var<storage, read_write> worst: array<vec2<u32>>;

// Base of the digits, and start of the histogram.
const DIGITS: u32 = 256u;
const COUNTS: u32 = 4u;

var<workgroup> counts: array<atomic<u32>, 256>;

// Bits of a pixel's error, which sort like the errors; 0 for a pixel that cannot be a candidate.
// launch.c: bits of the smallest alpha allowed; launch.d: the error is in a map of its own (0), the
// length of the gradient (1), or the last number of the canvas (2).
fn key_of(pixel: u32) -> u32 {
    if pixel >= frame.image.x * frame.image.y || !(1.0 - bitcast<f32>(finish[pixel].x) >= bitcast<f32>(launch.c)) {
        return 0u;
    }
    var error = 0.0;
    if launch.d == 1u {
        let g = vec3(map[4u * pixel], map[4u * pixel + 1u], map[4u * pixel + 2u]);
        error = sqrt(g.x * g.x + g.y * g.y + g.z * g.z);
    } else if launch.d == 2u {
        error = map[4u * pixel + 3u];
    } else {
        error = map[pixel];
    }
    return select(0u, bitcast<u32>(error), error > 0.0);
}

// Histogram of the next digit of the errors that begin with the known digits; launch.a: the digit's lowest bit,
// launch.b: 1 for the first digit.
@compute @workgroup_size(256)
fn count_errors(
    @builtin(workgroup_id) id: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    atomicStore(&counts[lane], 0u);
    workgroupBarrier();
    let key = key_of(group_of(id) * GROUP + lane);
    // The first digit is a special case: WGSL cannot shift by 32 bits.
    if key != 0u && (launch.b == 1u || key >> (launch.a + 8u) == atomicLoad(&selection[0])) {
        atomicAdd(&counts[(key >> launch.a) % DIGITS], 1u);
    }
    workgroupBarrier();
    let count = atomicLoad(&counts[lane]);
    if count > 0u {
        atomicAdd(&selection[COUNTS + lane], count);
    }
}

// launch.a: 0: starts a selection of launch.b pixels; 1: finds the next digit; 2: stores the number written.
@compute @workgroup_size(256)
fn narrow(@builtin(local_invocation_index) lane: u32) {
    if lane == 0u {
        if launch.a == 0u {
            atomicStore(&selection[0], 0u);
            atomicStore(&selection[1], launch.b);
            atomicStore(&selection[2], 0u);
        } else if launch.a == 1u {
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

// Writes every pixel whose error is at least the smallest one selected; launch.b: capacity.
@compute @workgroup_size(256)
fn write_worst(@builtin(global_invocation_id) id: vec3<u32>) {
    let pixel = index_of(id);
    let key = key_of(pixel);
    if key != 0u && key >= atomicLoad(&selection[0]) {
        let place = atomicAdd(&selection[2], 1u);
        if place < launch.b {
            worst[1u + place] = vec2(key, pixel);
        }
    }
}
