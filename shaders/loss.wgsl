// Stage 4: 0.8·L1 + 0.2·(1 − SSIM) and its gradient, one tile per group; src/backend/cpu/loss.rs.
// SSIM is written in e = rendering − target, by an exact identity. The 11×11 window is taken apart
// into columns and rows; beyond the image there are zeros.

@group(0) @binding(1) var<storage, read_write> state: State;
@group(0) @binding(2) var<storage, read> canvas: array<vec4<f32>>;
// Red, green, blue, alpha, a byte each.
@group(0) @binding(3) var<storage, read> truth: array<u32>;
// Weights of the pixels, four to a word.
@group(0) @binding(4) var<storage, read> mask: array<u32>;
// Derivatives of SSIM by the window's mean of e, e² and e·y, per channel: nine planes.
@group(0) @binding(5) var<storage, read_write> derivatives: array<f32>;
// dL/dpixel: three planes.
@group(0) @binding(6) var<storage, read_write> gradient: array<f32>;
// Sums of |e| and of SSIM per tile.
@group(0) @binding(7) var<storage, read_write> tile_sums: array<vec2<f32>>;
// Error per pixel, where candidates are asked for.
@group(0) @binding(8) var<storage, read_write> error: array<f32>;

const C1: f32 = 0.01 * 0.01;
const C2: f32 = 0.03 * 0.03;
const SSIM_WEIGHT: f32 = 0.2;
const REACH: i32 = 5;
// Side of a tile with its surroundings.
const SIDE: u32 = 26u;
// Bits of frame.draw.w.
const HAS_ALPHA: u32 = 1u;
const HAS_MASK: u32 = 2u;
const WITH_ERROR: u32 = 4u;

fn window(k: u32) -> f32 {
    var weights = array<f32, 11>(
        0.0010283802, 0.007598758, 0.036000773, 0.10936069, 0.21300553, 0.26601174,
        0.21300553, 0.10936069, 0.036000773, 0.007598758, 0.0010283802,
    );
    return weights[k];
}

fn weight_of(at: u32) -> f32 {
    if (frame.draw.w & HAS_MASK) == 0u {
        return 1.0;
    }
    return f32((mask[at / 4u] >> (8u * (at % 4u))) & 0xffu) * (1.0 / 255.0);
}

// e and y of one channel of a pixel; 0 beyond the image.
fn difference(x: i32, y: i32, channel: u32) -> vec2<f32> {
    if x < 0 || y < 0 || x >= i32(frame.image.x) || y >= i32(frame.image.y) {
        return vec2(0.0);
    }
    let at = u32(y) * frame.image.x + u32(x);
    let word = truth[at];
    var target_value = f32((word >> (8u * channel)) & 0xffu) * (1.0 / 255.0);
    if (frame.draw.w & HAS_ALPHA) != 0u {
        let a = f32(word >> 24u) * (1.0 / 255.0);
        target_value = a * target_value + (1.0 - a) * frame.background[channel];
    }
    return vec2((canvas[at][channel] - target_value) * weight_of(at), target_value);
}

// A tile with its surroundings: two values per pixel, then up to five per pixel of its columns.
var<workgroup> around: array<vec2<f32>, 676>;
var<workgroup> rows_a: array<vec4<f32>, 416>;
var<workgroup> rows_b: array<f32, 416>;
var<workgroup> reduced: array<vec2<f32>, 256>;

fn corner_of(tile: u32) -> vec2<i32> {
    return vec2<i32>(vec2(tile % frame.image.z, tile / frame.image.z) * TILE);
}

// SSIM, its derivatives, and the sums of the tile. now.a, now.b: bits of the weights of |e| and of
// 1 − SSIM in the error.
@compute @workgroup_size(256)
fn similarity(
    @builtin(workgroup_id) id: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let tile = group_of(id);
    if tile >= frame.image.w {
        return;
    }
    let corner = corner_of(tile);
    let place = vec2(lane % TILE, lane / TILE);
    let pixel = vec2<u32>(corner) + place;
    let inside = pixel.x < frame.image.x && pixel.y < frame.image.y;
    let size = frame.image.x * frame.image.y;
    let at = pixel.y * frame.image.x + pixel.x;
    var sums = vec2(0.0);
    var wrong = 0.0;
    for (var channel = 0u; channel < 3u; channel++) {
        workgroupBarrier();
        for (var i = lane; i < SIDE * SIDE; i += GROUP) {
            let x = corner.x + i32(i % SIDE) - REACH;
            let y = corner.y + i32(i / SIDE) - REACH;
            around[i] = difference(x, y, channel);
        }
        workgroupBarrier();
        // Columns: the tile's lines, all of its surroundings' columns.
        for (var i = lane; i < SIDE * TILE; i += GROUP) {
            var a = vec4(0.0);
            var b = 0.0;
            for (var k = 0u; k < 11u; k++) {
                let ey = around[i + k * SIDE];
                let w = window(k);
                let we = w * ey.x;
                let wy = w * ey.y;
                a += vec4(we, wy, we * ey.x, wy * ey.y);
                b += we * ey.y;
            }
            rows_a[i] = a;
            rows_b[i] = b;
        }
        workgroupBarrier();
        if inside {
            var a = vec4(0.0);
            var mean_ey = 0.0;
            for (var k = 0u; k < 11u; k++) {
                let i = place.y * SIDE + place.x + k;
                a += window(k) * rows_a[i];
                mean_ey += window(k) * rows_b[i];
            }
            let mu_e = a.x;
            let mu_y = a.y;
            let mu_x = mu_e + mu_y;
            let var_e = max(a.z - mu_e * mu_e, 0.0);
            let var_y = max(a.w - mu_y * mu_y, 0.0);
            let cov = mean_ey - mu_e * mu_y;
            let var_x = max(var_y + 2.0 * cov + var_e, 0.0);
            let inv_a = 1.0 / (mu_x * mu_x + mu_y * mu_y + C1);
            let inv_b = 1.0 / (var_x + var_y + C2);
            let luminance = 1.0 - mu_e * mu_e * inv_a;
            let contrast = 1.0 - var_e * inv_b;
            let by_luminance = -2.0 * mu_e * inv_a * (1.0 - mu_e * mu_x * inv_a);
            let two_ve_bb = 2.0 * var_e * inv_b * inv_b;
            let by_contrast = 2.0 * mu_e * contrast * inv_b - mu_y * two_ve_bb;
            derivatives[3u * channel * size + at] = contrast * by_luminance + luminance * by_contrast;
            derivatives[(3u * channel + 1u) * size + at] = -(luminance * contrast * inv_b);
            derivatives[(3u * channel + 2u) * size + at] = luminance * two_ve_bb;
            let e = around[(place.y + 5u) * SIDE + place.x + 5u].x;
            let ssim = luminance * contrast;
            sums += vec2(abs(e), ssim);
            wrong += abs(e) * bitcast<f32>(now.a) + (1.0 - ssim) * bitcast<f32>(now.b);
        }
    }
    if inside && (frame.draw.w & WITH_ERROR) != 0u {
        error[at] = wrong * (1.0 / 3.0);
    }
    reduced[lane] = sums;
    workgroupBarrier();
    for (var half = GROUP / 2u; half > 0u; half /= 2u) {
        if lane < half {
            reduced[lane] += reduced[lane + half];
        }
        workgroupBarrier();
    }
    if lane == 0u {
        tile_sums[tile] = reduced[0];
    }
}

// dL/dpixel.
@compute @workgroup_size(256)
fn pixel_gradient(
    @builtin(workgroup_id) id: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let tile = group_of(id);
    if tile >= frame.image.w {
        return;
    }
    let corner = corner_of(tile);
    let place = vec2(lane % TILE, lane / TILE);
    let pixel = vec2<u32>(corner) + place;
    let inside = pixel.x < frame.image.x && pixel.y < frame.image.y;
    let size = frame.image.x * frame.image.y;
    let at = pixel.y * frame.image.x + pixel.x;
    let scale = 1.0 / (3.0 * f32(size));
    for (var channel = 0u; channel < 3u; channel++) {
        workgroupBarrier();
        // `around` holds the first two derivatives, `rows_b` the third's columns; so the third is
        // taken straight from memory.
        for (var i = lane; i < SIDE * SIDE; i += GROUP) {
            let x = corner.x + i32(i % SIDE) - REACH;
            let y = corner.y + i32(i / SIDE) - REACH;
            var value = vec2(0.0);
            if x >= 0 && y >= 0 && x < i32(frame.image.x) && y < i32(frame.image.y) {
                let source = 3u * channel * size + u32(y) * frame.image.x + u32(x);
                value = vec2(derivatives[source], derivatives[source + size]);
            }
            around[i] = value;
        }
        workgroupBarrier();
        for (var i = lane; i < SIDE * TILE; i += GROUP) {
            let x = corner.x + i32(i % SIDE) - REACH;
            var sum = vec3(0.0);
            for (var k = 0u; k < 11u; k++) {
                let y = corner.y + i32(i / SIDE + k) - REACH;
                var third = 0.0;
                if x >= 0 && y >= 0 && x < i32(frame.image.x) && y < i32(frame.image.y) {
                    third = derivatives[(3u * channel + 2u) * size + u32(y) * frame.image.x + u32(x)];
                }
                sum += window(k) * vec3(around[i + k * SIDE], third);
            }
            rows_a[i] = vec4(sum, 0.0);
        }
        workgroupBarrier();
        if inside {
            var by = vec3(0.0);
            for (var k = 0u; k < 11u; k++) {
                by += window(k) * rows_a[place.y * SIDE + place.x + k].xyz;
            }
            let ey = difference(i32(pixel.x), i32(pixel.y), channel);
            let by_ssim = by.x + 2.0 * ey.x * by.y + ey.y * by.z;
            let g = (1.0 - SSIM_WEIGHT) * scale * sign(ey.x) - SSIM_WEIGHT * scale * by_ssim;
            // The loss sees e·mask, so the chain rule has the mask once more.
            gradient[channel * size + at] = g * weight_of(at);
        }
    }
}

// One group: the means over the image.
@compute @workgroup_size(256)
fn total(@builtin(local_invocation_index) lane: u32) {
    var sums = vec2(0.0);
    for (var tile = lane; tile < frame.image.w; tile += GROUP) {
        sums += tile_sums[tile];
    }
    reduced[lane] = sums;
    workgroupBarrier();
    for (var half = GROUP / 2u; half > 0u; half /= 2u) {
        if lane < half {
            reduced[lane] += reduced[lane + half];
        }
        workgroupBarrier();
    }
    if lane == 0u {
        let samples = 3.0 * f32(frame.image.x * frame.image.y);
        state.l1 = reduced[0].x / samples;
        state.ssim = reduced[0].y / samples;
    }
}
