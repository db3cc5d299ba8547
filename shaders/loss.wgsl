// Stage 4: 0.8·L1 + 0.2·(1 − SSIM) and its gradient, one tile per group, as in src/render/cpu/loss/.
// SSIM is rewritten, exactly, in terms of e = x − y, the difference of rendering x and target y, and of the
// mean of x·y, from which the sum of both variances follows. The 11×11 window is separable; pixels outside the image
// are zero. An invocation sums eight neighbouring windows at once, which together read 18 values instead of 8 × 11,
// since reading costs more than adding.

@group(0) @binding(1) var<storage, read_write> state: State;
@group(0) @binding(2) var<storage, read> canvas: array<vec4<f32>>;
// Red, green, blue, alpha, a byte each.
@group(0) @binding(3) var<storage, read> truth: array<u32>;
// Weights of the pixels, one byte each.
@group(0) @binding(4) var<storage, read> mask: array<u32>;
// Derivatives of SSIM with respect to the window's means of e, e² and e·y, per channel: nine planes.
@group(0) @binding(5) var<storage, read_write> derivatives: array<f32>;
// dL/dpixel: three planes; then each pixel's error for the row scores, if requested, and its edge
// weight, if used.
@group(0) @binding(6) var<storage, read_write> gradient: array<f32>;
// Sums of |e| and of SSIM per tile.
@group(0) @binding(7) var<storage, read_write> tile_sums: array<vec2<f32>>;
// Error per pixel, if candidates are requested.
@group(0) @binding(8) var<storage, read_write> error: array<f32>;
// See exposure.wgsl.
@group(0) @binding(9) var<storage, read> exposure: array<vec4<f32>>;

const C1: f32 = 0.01 * 0.01;
const C2: f32 = 0.03 * 0.03;
const SSIM_WEIGHT: f32 = 0.2;
// Radius of the window [px].
const REACH: i32 = 5;
// Side of a tile with its margin of REACH pixels.
const SIDE: u32 = 26u;
// Bits of frame.draw.w.
const HAS_ALPHA: u32 = 1u;
const HAS_MASK: u32 = 2u;
const WITH_ERROR: u32 = 4u;
const BY_PIXEL: u32 = 8u;
const EXPOSED: u32 = 16u;

// Weights of value k (of 18) in the eight windows centred on values 5 to 12, computed from the weights of
// value k − 1: this reads the table once instead of eight times.
fn next_weights(before: mat2x4<f32>, k: u32) -> mat2x4<f32> {
    var weights = array<f32, 11>(
        0.0010283802, 0.007598758, 0.036000773, 0.10936069, 0.21300553, 0.26601174,
        0.21300553, 0.10936069, 0.036000773, 0.007598758, 0.0010283802,
    );
    let of_first = select(0.0, weights[min(k, 10u)], k <= 10u);
    return mat2x4(vec4(of_first, before[0].xyz), vec4(before[0].w, before[1].xyz));
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

// e and y of one channel of a pixel; 0 outside the image.
fn difference(pixel: vec2<i32>, channel: u32) -> vec2<f32> {
    if !is_inside(pixel) {
        return vec2(0.0);
    }
    let at = u32(pixel.y) * frame.image.x + u32(pixel.x);
    let word = truth[at];
    var target_value = f32((word >> (8u * channel)) & 0xffu) * (1.0 / 255.0);
    if (frame.draw.w & HAS_ALPHA) != 0u {
        let a = f32(word >> 24u) * (1.0 / 255.0);
        var background = frame.background[channel];
        if (frame.draw.w & EXPOSED) != 0u {
            background = exposure[3][channel];
        }
        target_value = a * target_value + (1.0 - a) * background;
    }
    return vec2((canvas[at][channel] - target_value) * weight_of(at), target_value);
}

// Values read by eight neighbouring windows.
const SPAN: u32 = 18u;
// Numbers of runs of eight windows in the columns of a tile with its margin, and in the lines of the tile.
const COLUMNS: u32 = SIDE * TILE / 8u;
const LINES: u32 = TILE * TILE / 8u;

// A tile with its margin: two values per pixel. Then up to four sums over columns per pixel.
var<workgroup> around: array<vec2<f32>, 676>;
var<workgroup> rows: array<vec4<f32>, 416>;
var<workgroup> reduced: array<vec2<f32>, GROUP>;

// Eight neighbouring pixels of a tile in the same line.
struct Eight {
    // Column of the first, and their line, relative to the tile's corner [px].
    column: u32,
    line: u32,
    // Index of the first in the image, and how many are inside the image.
    place: u32,
    inside: u32,
}

fn eight_of(corner: vec2<u32>, i: u32) -> Eight {
    let column = 8u * (i % 2u);
    let line = i / 2u;
    let x = corner.x + column;
    let y = corner.y + line;
    let there = select(0u, min(frame.image.x - x, 8u), x < frame.image.x && y < frame.image.y);
    return Eight(column, line, y * frame.image.x + x, there);
}

// Coordinates of pixel i of a tile with its margin; the pixel may be outside the image.
fn pixel_around(corner: vec2<u32>, i: u32) -> vec2<i32> {
    return vec2<i32>(corner) + vec2(i32(i % SIDE), i32(i / SIDE)) - REACH;
}

// The first pixel of the ith run of eight windows in a column, in a tile with its margin.
fn first_of_run(i: u32) -> u32 {
    return i / SIDE * 8u * SIDE + i % SIDE;
}

// Stores the sums of four windows below one another, up to four sums for each window, in `rows`.
fn store_four(first: u32, a: vec4<f32>, b: vec4<f32>, c: vec4<f32>, d: vec4<f32>) {
    let of_window = transpose(mat4x4(a, b, c, d));
    rows[first] = of_window[0];
    rows[first + SIDE] = of_window[1];
    rows[first + 2u * SIDE] = of_window[2];
    rows[first + 3u * SIDE] = of_window[3];
}

// Stores the sums of eight windows below one another.
fn store_eight(
    first: u32,
    a: mat2x4<f32>,
    b: mat2x4<f32>,
    c: mat2x4<f32>,
    d: mat2x4<f32>,
) {
    store_four(first, a[0], b[0], c[0], d[0]);
    store_four(first + 4u * SIDE, a[1], b[1], c[1], d[1]);
}

// SSIM at four pixels, and its derivatives with respect to the window's means.
struct Ssim {
    ssim: vec4<f32>,
    by_e: vec4<f32>,
    by_ee: vec4<f32>,
    by_ey: vec4<f32>,
}

fn ssim_of(
    mu_e: vec4<f32>,
    mu_y: vec4<f32>,
    mean_ee: vec4<f32>,
    mean_xy: vec4<f32>,
) -> Ssim {
    let mu_x = mu_e + mu_y;
    let var_e = max(mean_ee - mu_e * mu_e, vec4(0.0));
    let variances = max(2.0 * (mean_xy - mu_x * mu_y) + var_e, vec4(0.0));
    let inv_a = 1.0 / (mu_x * mu_x + mu_y * mu_y + C1);
    let inv_b = 1.0 / (variances + C2);
    let luminance = 1.0 - mu_e * mu_e * inv_a;
    let contrast = 1.0 - var_e * inv_b;
    let by_luminance = -2.0 * mu_e * inv_a * (1.0 - mu_e * mu_x * inv_a);
    let two_ve_bb = 2.0 * var_e * inv_b * inv_b;
    let by_contrast = 2.0 * mu_e * contrast * inv_b - mu_y * two_ve_bb;
    return Ssim(
        luminance * contrast,
        contrast * by_luminance + luminance * by_contrast,
        -(luminance * contrast * inv_b),
        luminance * two_ve_bb,
    );
}

// Computes SSIM, its derivatives, and the sums of the tile. Bits of the weights of |e| and of 1 − SSIM: in the
// pixel's error (launch.a, launch.b) and in its error for row scores (launch.c, launch.d).
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
    var pixel_error = mat2x4<f32>();
    var score_error = mat2x4<f32>();
    for (var channel = 0u; channel < 3u; channel++) {
        workgroupBarrier();
        for (var i = lane; i < SIDE * SIDE; i += GROUP) {
            around[i] = difference(pixel_around(corner, i), channel);
        }
        workgroupBarrier();
        for (var i = lane; i < COLUMNS; i += GROUP) {
            let first = first_of_run(i);
            var e = mat2x4<f32>();
            var y = mat2x4<f32>();
            var ee = mat2x4<f32>();
            var xy = mat2x4<f32>();
            var w = mat2x4<f32>();
            for (var k = 0u; k < SPAN; k++) {
                w = next_weights(w, k);
                let here = around[first + k * SIDE];
                let we = w * here.x;
                let wy = w * here.y;
                e += we;
                y += wy;
                ee += we * here.x;
                xy += wy * (here.x + here.y);
            }
            store_eight(first, e, y, ee, xy);
        }
        workgroupBarrier();
        for (var i = lane; i < LINES; i += GROUP) {
            let eight = eight_of(corner, i);
            let first = eight.line * SIDE + eight.column;
            var e = mat2x4<f32>();
            var y = mat2x4<f32>();
            var ee = mat2x4<f32>();
            var xy = mat2x4<f32>();
            var w = mat2x4<f32>();
            for (var k = 0u; k < SPAN; k++) {
                w = next_weights(w, k);
                let here = rows[first + k];
                e += w * here.x;
                y += w * here.y;
                ee += w * here.z;
                xy += w * here.w;
            }
            for (var half = 0u; half < 2u; half++) {
                let found = ssim_of(e[half], y[half], ee[half], xy[half]);
                let n = 4u * half;
                let centre = first + 5u * SIDE + 5u + n;
                let abs_e = abs(vec4(
                    around[centre].x,
                    around[centre + 1u].x,
                    around[centre + 2u].x,
                    around[centre + 3u].x,
                ));
                let there = vec4(n, n + 1u, n + 2u, n + 3u) < vec4(eight.inside);
                let counts = select(vec4(0.0), vec4(1.0), there);
                sums += vec2(dot(counts, abs_e), dot(counts, found.ssim));
                pixel_error[half] +=
                    abs_e * bitcast<f32>(launch.a) + (1.0 - found.ssim) * bitcast<f32>(launch.b);
                if (frame.draw.w & BY_PIXEL) != 0u {
                    score_error[half] +=
                        abs_e * bitcast<f32>(launch.c) + (1.0 - found.ssim) * bitcast<f32>(launch.d);
                }
                for (var p = 0u; p < 4u; p++) {
                    if n + p < eight.inside {
                        let to = 3u * channel * size + eight.place + n + p;
                        derivatives[to] = found.by_e[p];
                        derivatives[to + size] = found.by_ee[p];
                        derivatives[to + 2u * size] = found.by_ey[p];
                    }
                }
            }
        }
    }
    if lane < LINES && (frame.draw.w & WITH_ERROR) != 0u {
        let eight = eight_of(corner, lane);
        for (var p = 0u; p < eight.inside; p++) {
            error[eight.place + p] = pixel_error[p / 4u][p % 4u] * (1.0 / 3.0);
        }
    }
    if lane < LINES && (frame.draw.w & BY_PIXEL) != 0u {
        let eight = eight_of(corner, lane);
        for (var p = 0u; p < eight.inside; p++) {
            let to = 3u * size + eight.place + p;
            gradient[to] = score_contribution(score_error[p / 4u][p % 4u] * (1.0 / 3.0), to + size);
        }
    }
    reduced[lane] = sums;
    let of_tile = reduced_sum(lane);
    if lane == 0u {
        tile_sums[tile] = of_tile;
    }
}

// A pixel's contribution to row scores, from its error; `place`: index of its edge weight.
fn score_contribution(error: f32, place: u32) -> f32 {
    var map = error;
    if frame.score.x != 1.0 {
        map = pow(max(error, 0.0), frame.score.x);
    }
    if frame.score.y > 0.0 {
        map *= gradient[place];
    }
    return map;
}

// The sum of `reduced`; valid in the first invocation.
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

// Computes dL/dpixel.
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
        for (var i = lane; i < COLUMNS; i += GROUP) {
            let first = first_of_run(i);
            let top = pixel_around(corner, first);
            var x = mat2x4<f32>();
            var y = mat2x4<f32>();
            var z = mat2x4<f32>();
            var w = mat2x4<f32>();
            for (var k = 0u; k < SPAN; k++) {
                w = next_weights(w, k);
                let at = top + vec2(0, i32(k));
                if is_inside(at) {
                    let source = 3u * channel * size + u32(at.y) * frame.image.x + u32(at.x);
                    x += w * derivatives[source];
                    y += w * derivatives[source + size];
                    z += w * derivatives[source + 2u * size];
                }
            }
            store_eight(first, x, y, z, mat2x4<f32>());
        }
        workgroupBarrier();
        for (var i = lane; i < LINES; i += GROUP) {
            let eight = eight_of(corner, i);
            let first = eight.line * SIDE + eight.column;
            var x = mat2x4<f32>();
            var y = mat2x4<f32>();
            var z = mat2x4<f32>();
            var w = mat2x4<f32>();
            for (var k = 0u; k < SPAN; k++) {
                w = next_weights(w, k);
                let here = rows[first + k];
                x += w * here.x;
                y += w * here.y;
                z += w * here.z;
            }
            let pixel = vec2<i32>(corner + vec2(eight.column, eight.line));
            for (var n = 0u; n < 8u; n++) {
                if n < eight.inside {
                    let ey = difference(pixel + vec2(i32(n), 0), channel);
                    let half = n / 4u;
                    let p = n % 4u;
                    let by_ssim = x[half][p] + 2.0 * ey.x * y[half][p] + ey.y * z[half][p];
                    let g = (1.0 - SSIM_WEIGHT) * scale * sign(ey.x) - SSIM_WEIGHT * scale * by_ssim;
                    // The loss is a function of e·mask, so the chain rule multiplies by the mask.
                    let to = eight.place + n;
                    gradient[channel * size + to] = g * weight_of(to);
                }
            }
        }
    }
}

// Computes the mean |e| and the mean SSIM of the image; a single group.
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
