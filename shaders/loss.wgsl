// Stage 4: 0.8·L1 + 0.2·(1 − SSIM) and its gradient, one tile per group; src/backend/cpu/loss.rs.
// SSIM is written in e = rendering − target, by an exact identity. The 11×11 window is taken apart
// into columns and rows; beyond the image there are zeros. An invocation sums for four pixels in a row,
// whose windows have eight of fourteen values in common.

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

// Weights of the kth of fourteen values in a row, in the windows around the sixth to the ninth.
fn windows(k: u32) -> vec4<f32> {
    var weights = array<f32, 17>(
        0.0, 0.0, 0.0,
        0.0010283802, 0.007598758, 0.036000773, 0.10936069, 0.21300553, 0.26601174,
        0.21300553, 0.10936069, 0.036000773, 0.007598758, 0.0010283802,
        0.0, 0.0, 0.0,
    );
    return vec4(weights[k + 3u], weights[k + 2u], weights[k + 1u], weights[k]);
}

fn weight_of(at: u32) -> f32 {
    if (frame.draw.w & HAS_MASK) == 0u {
        return 1.0;
    }
    return f32((mask[at / 4u] >> (8u * (at % 4u))) & 0xffu) * (1.0 / 255.0);
}

fn is_inside(pixel: vec2<i32>) -> bool {
    return all(pixel >= vec2(0)) && all(pixel < vec2<i32>(frame.image.xy));
}

// e and y of one channel of a pixel; 0 beyond the image.
fn difference(pixel: vec2<i32>, channel: u32) -> vec2<f32> {
    if !is_inside(pixel) {
        return vec2(0.0);
    }
    let at = u32(pixel.y) * frame.image.x + u32(pixel.x);
    let word = truth[at];
    var target_value = f32((word >> (8u * channel)) & 0xffu) * (1.0 / 255.0);
    if (frame.draw.w & HAS_ALPHA) != 0u {
        let a = f32(word >> 24u) * (1.0 / 255.0);
        target_value = a * target_value + (1.0 - a) * frame.background[channel];
    }
    return vec2((canvas[at][channel] - target_value) * weight_of(at), target_value);
}

// Values in reach of four in a row.
const SPAN: u32 = 14u;
// Fours in a column of the tile, for all columns of its surroundings; fours in the tile's lines.
const COLUMNS: u32 = SIDE * TILE / 4u;
const LINES: u32 = TILE * TILE / 4u;

// A tile with its surroundings: up to three values per pixel, then up to five per pixel of its columns.
var<workgroup> around: array<vec2<f32>, 676>;
var<workgroup> thirds: array<f32, 676>;
var<workgroup> rows_a: array<vec4<f32>, 416>;
var<workgroup> rows_b: array<f32, 416>;
var<workgroup> reduced: array<vec2<f32>, GROUP>;

// Four pixels of a line of a tile.
struct Four {
    // The first one's column, and their line, from the tile's corner [px].
    column: u32,
    line: u32,
    // Place of the first in the image, row after row, and how many are within it.
    place: u32,
    inside: u32,
}

fn four_of(corner: vec2<u32>, i: u32) -> Four {
    let column = 4u * (i % 4u);
    let line = i / 4u;
    let x = corner.x + column;
    let y = corner.y + line;
    let there = select(0u, min(frame.image.x - x, 4u), x < frame.image.x && y < frame.image.y);
    return Four(column, line, y * frame.image.x + x, there);
}

// The pixel of `around` at a place; its coordinates may be outside of the image.
fn pixel_around(corner: vec2<u32>, i: u32) -> vec2<i32> {
    return vec2<i32>(corner) + vec2(i32(i % SIDE), i32(i / SIDE)) - REACH;
}

// Sums of four windows below one another, up to four of each, go to their places in `rows_a`.
fn keep_columns(first: u32, a: vec4<f32>, b: vec4<f32>, c: vec4<f32>, d: vec4<f32>) {
    let of_window = transpose(mat4x4(a, b, c, d));
    rows_a[first] = of_window[0];
    rows_a[first + SIDE] = of_window[1];
    rows_a[first + 2u * SIDE] = of_window[2];
    rows_a[first + 3u * SIDE] = of_window[3];
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
    let size = frame.image.x * frame.image.y;
    var sums = vec2(0.0);
    var wrong = vec4(0.0);
    for (var channel = 0u; channel < 3u; channel++) {
        workgroupBarrier();
        for (var i = lane; i < SIDE * SIDE; i += GROUP) {
            around[i] = difference(pixel_around(corner, i), channel);
        }
        workgroupBarrier();
        for (var i = lane; i < COLUMNS; i += GROUP) {
            let first = i / SIDE * 4u * SIDE + i % SIDE;
            var e = vec4(0.0);
            var y = vec4(0.0);
            var ee = vec4(0.0);
            var yy = vec4(0.0);
            var ey = vec4(0.0);
            for (var k = 0u; k < SPAN; k++) {
                let here = around[first + k * SIDE];
                let we = windows(k) * here.x;
                let wy = windows(k) * here.y;
                e += we;
                y += wy;
                ee += we * here.x;
                yy += wy * here.y;
                ey += we * here.y;
            }
            keep_columns(first, e, y, ee, yy);
            rows_b[first] = ey.x;
            rows_b[first + SIDE] = ey.y;
            rows_b[first + 2u * SIDE] = ey.z;
            rows_b[first + 3u * SIDE] = ey.w;
        }
        workgroupBarrier();
        for (var i = lane; i < LINES; i += GROUP) {
            let four = four_of(corner, i);
            let first = four.line * SIDE + four.column;
            var mu_e = vec4(0.0);
            var mu_y = vec4(0.0);
            var mean_ee = vec4(0.0);
            var mean_yy = vec4(0.0);
            var mean_ey = vec4(0.0);
            for (var k = 0u; k < SPAN; k++) {
                let here = rows_a[first + k];
                let w = windows(k);
                mu_e += w * here.x;
                mu_y += w * here.y;
                mean_ee += w * here.z;
                mean_yy += w * here.w;
                mean_ey += w * rows_b[first + k];
            }
            let mu_x = mu_e + mu_y;
            let var_e = max(mean_ee - mu_e * mu_e, vec4(0.0));
            let var_y = max(mean_yy - mu_y * mu_y, vec4(0.0));
            let cov = mean_ey - mu_e * mu_y;
            let var_x = max(var_y + 2.0 * cov + var_e, vec4(0.0));
            let inv_a = 1.0 / (mu_x * mu_x + mu_y * mu_y + C1);
            let inv_b = 1.0 / (var_x + var_y + C2);
            let luminance = 1.0 - mu_e * mu_e * inv_a;
            let contrast = 1.0 - var_e * inv_b;
            let by_luminance = -2.0 * mu_e * inv_a * (1.0 - mu_e * mu_x * inv_a);
            let two_ve_bb = 2.0 * var_e * inv_b * inv_b;
            let by_contrast = 2.0 * mu_e * contrast * inv_b - mu_y * two_ve_bb;
            let by_e = contrast * by_luminance + luminance * by_contrast;
            let by_ee = -(luminance * contrast * inv_b);
            let by_ey = luminance * two_ve_bb;
            let ssim = luminance * contrast;
            for (var p = 0u; p < 4u; p++) {
                if p < four.inside {
                    let to = 3u * channel * size + four.place + p;
                    derivatives[to] = by_e[p];
                    derivatives[to + size] = by_ee[p];
                    derivatives[to + 2u * size] = by_ey[p];
                    let e = abs(around[first + 5u * SIDE + 5u + p].x);
                    sums += vec2(e, ssim[p]);
                    wrong[p] += e * bitcast<f32>(now.a) + (1.0 - ssim[p]) * bitcast<f32>(now.b);
                }
            }
        }
    }
    if lane < LINES && (frame.draw.w & WITH_ERROR) != 0u {
        let four = four_of(corner, lane);
        for (var p = 0u; p < four.inside; p++) {
            error[four.place + p] = wrong[p] * (1.0 / 3.0);
        }
    }
    reduced[lane] = sums;
    let of_tile = reduced_sum(lane);
    if lane == 0u {
        tile_sums[tile] = of_tile;
    }
}

// The sum of `reduced`, for the first invocation.
fn reduced_sum(lane: u32) -> vec2<f32> {
    workgroupBarrier();
    for (var half = GROUP / 2u; half > 0u; half /= 2u) {
        if lane < half {
            reduced[lane] += reduced[lane + half];
        }
        workgroupBarrier();
    }
    return reduced[0];
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
    let size = frame.image.x * frame.image.y;
    let scale = 1.0 / (3.0 * f32(size));
    for (var channel = 0u; channel < 3u; channel++) {
        workgroupBarrier();
        for (var i = lane; i < SIDE * SIDE; i += GROUP) {
            let at = pixel_around(corner, i);
            var value = vec3(0.0);
            if is_inside(at) {
                let source = 3u * channel * size + u32(at.y) * frame.image.x + u32(at.x);
                value = vec3(
                    derivatives[source],
                    derivatives[source + size],
                    derivatives[source + 2u * size],
                );
            }
            around[i] = value.xy;
            thirds[i] = value.z;
        }
        workgroupBarrier();
        for (var i = lane; i < COLUMNS; i += GROUP) {
            let first = i / SIDE * 4u * SIDE + i % SIDE;
            var x = vec4(0.0);
            var y = vec4(0.0);
            var z = vec4(0.0);
            for (var k = 0u; k < SPAN; k++) {
                let here = around[first + k * SIDE];
                let w = windows(k);
                x += w * here.x;
                y += w * here.y;
                z += w * thirds[first + k * SIDE];
            }
            keep_columns(first, x, y, z, vec4(0.0));
        }
        workgroupBarrier();
        for (var i = lane; i < LINES; i += GROUP) {
            let four = four_of(corner, i);
            let first = four.line * SIDE + four.column;
            var x = vec4(0.0);
            var y = vec4(0.0);
            var z = vec4(0.0);
            for (var k = 0u; k < SPAN; k++) {
                let here = rows_a[first + k];
                let w = windows(k);
                x += w * here.x;
                y += w * here.y;
                z += w * here.z;
            }
            let pixel = vec2<i32>(corner + vec2(four.column, four.line));
            for (var p = 0u; p < 4u; p++) {
                if p < four.inside {
                    let ey = difference(pixel + vec2(i32(p), 0), channel);
                    let by_ssim = x[p] + 2.0 * ey.x * y[p] + ey.y * z[p];
                    let g = (1.0 - SSIM_WEIGHT) * scale * sign(ey.x) - SSIM_WEIGHT * scale * by_ssim;
                    // The loss sees e·mask, so the chain rule has the mask once more.
                    let to = four.place + p;
                    gradient[channel * size + to] = g * weight_of(to);
                }
            }
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
    let all = reduced_sum(lane);
    if lane == 0u {
        let samples = 3.0 * f32(frame.image.x * frame.image.y);
        state.l1 = all.x / samples;
        state.ssim = all.y / samples;
    }
}
