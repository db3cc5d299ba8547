// Stage 4: 0.8·L1 + 0.2·(1 − SSIM), and its gradient with the policy's pixel term in place of L1, one tile per group and
// one channel per launch, as in src/render/cpu/loss/.
// SSIM is rewritten, exactly, in terms of e = x − y, the difference of rendering x and target y, and of the
// mean of x·y, from which the sum of both variances follows. The 11×11 window is separable; pixels outside the image
// are zero. An invocation sums neighbouring windows at once, eight below or four beside one another: eight together read
// 18 values instead of 8 × 11, and reading costs more than adding.
//
// launch.a: the channel.

@group(0) @binding(1) var<storage, read_write> state: State;
// The image. dL/dpixel replaces it, channel by channel; each pixel's error replaces the depth, if errors are requested:
// for the row scores, else for candidates.
@group(0) @binding(2) var<storage, read_write> canvas: array<vec4<f32>>;
// Red, green, blue, alpha, a byte each.
@group(0) @binding(3) var<storage, read> truth: array<u32>;
// Weights of the pixels, one byte each.
@group(0) @binding(4) var<storage, read> mask: array<u32>;
// Derivatives of SSIM with respect to the window's means of e, e² and e·y in this channel: three planes.
@group(0) @binding(5) var<storage, read_write> derivatives: array<f32>;
// The weights of pixels at edges in the row scores, if used.
@group(0) @binding(6) var<storage, read> edges: array<f32>;
// Sums of |e| and of SSIM per tile.
@group(0) @binding(7) var<storage, read_write> tile_sums: array<vec2<f32>>;
// Error per pixel for candidates, if there are row scores too.
@group(0) @binding(8) var<storage, read_write> error: array<f32>;
// See exposure.wgsl.
@group(0) @binding(9) var<storage, read> exposure: array<vec4<f32>>;

const C1: f32 = 0.01 * 0.01;
const C2: f32 = 0.03 * 0.03;
const SSIM_WEIGHT: f32 = 0.2;
// The pixel difference from which the gradient no longer grows; 0 for L1.
override PIXEL_BOUND: f32 = 0.0;
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

// Number of invocations of a tile.
const MEMBERS: u32 = 64u;

// The weight of value k in the window centred on value 5.
fn of_first(k: u32) -> f32 {
    var weights = array<f32, 11>(
        0.0010283802, 0.007598758, 0.036000773, 0.10936069, 0.21300553, 0.26601174,
        0.21300553, 0.10936069, 0.036000773, 0.007598758, 0.0010283802,
    );
    return select(0.0, weights[min(k, 10u)], k <= 10u);
}

// Weights of value k (of 18) in the eight windows centred on values 5 to 12, computed from the weights of
// value k − 1: this reads the table once instead of eight times.
fn next_of_eight(before: mat2x4<f32>, k: u32) -> mat2x4<f32> {
    return mat2x4(vec4(of_first(k), before[0].xyz), vec4(before[0].w, before[1].xyz));
}

// The same for value k (of 14) in four windows.
fn next_of_four(before: vec4<f32>, k: u32) -> vec4<f32> {
    return vec4(of_first(k), before.xyz);
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

// Values read by eight and by four neighbouring windows.
const SPAN_OF_EIGHT: u32 = 18u;
const SPAN_OF_FOUR: u32 = 14u;
// Number of runs of eight windows in the columns of a tile with its margin.
const COLUMNS: u32 = SIDE * TILE / 8u;

// A tile with its margin: two values per pixel. Then up to four sums over columns per pixel.
var<workgroup> around: array<vec2<f32>, 676>;
var<workgroup> rows: array<vec4<f32>, 416>;
alias Summand = vec2<f32>;
const ADDERS: u32 = MEMBERS;

// The four neighbouring pixels of an invocation, in one line of a tile.
struct Four {
    // Coordinates of the first in the image [px].
    pixel: vec2<u32>,
    // Index of the first in `rows`, and in the image.
    first: u32,
    place: u32,
    // How many are inside the image.
    inside: u32,
}

fn four_of(corner: vec2<u32>, lane: u32) -> Four {
    let within = vec2(4u * (lane % 4u), lane / 4u);
    let pixel = corner + within;
    let is_there = all(pixel < frame.image.xy);
    let inside = select(0u, min(frame.image.x - pixel.x, 4u), is_there);
    return Four(pixel, within.y * SIDE + within.x, pixel.y * frame.image.x + pixel.x, inside);
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

// The sums of an invocation's four windows, from the sums over columns.
fn sums_of_four(first: u32) -> mat4x4<f32> {
    var sums = mat4x4<f32>();
    var w = vec4(0.0);
    for (var k = 0u; k < SPAN_OF_FOUR; k++) {
        w = next_of_four(w, k);
        let here = rows[first + k];
        sums += mat4x4(w * here.x, w * here.y, w * here.z, w * here.w);
    }
    return sums;
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

// `before`, the sum over the channels so far, with the error of this channel; the mean after the last channel.
fn with_error(before: f32, error: f32) -> f32 {
    let sum = select(before, 0.0, launch.a == 0u) + error;
    return select(sum, sum * (1.0 / 3.0), launch.a == 2u);
}

// Adds a channel's |e| and 1 − SSIM to the pixel's errors.
fn add_errors(at: u32, abs_e: f32, dissimilarity: f32) {
    let for_candidates = abs_e * frame.errors.x + dissimilarity * frame.errors.y;
    let wanted = frame.draw.w & (WITH_ERROR | BY_PIXEL);
    if (wanted & BY_PIXEL) != 0u {
        let for_scores = abs_e * frame.errors.z + dissimilarity * frame.errors.w;
        canvas[at].w = with_error(canvas[at].w, for_scores);
        if wanted != BY_PIXEL {
            error[at] = with_error(error[at], for_candidates);
        }
    } else if wanted != 0u {
        canvas[at].w = with_error(canvas[at].w, for_candidates);
    }
}

// Computes SSIM, its derivatives, and the sums of the tile.
@compute @workgroup_size(64)
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
    for (var i = lane; i < SIDE * SIDE; i += MEMBERS) {
        around[i] = difference(pixel_around(corner, i), launch.a);
    }
    workgroupBarrier();
    if lane < COLUMNS {
        let first = first_of_run(lane);
        var e = mat2x4<f32>();
        var y = mat2x4<f32>();
        var ee = mat2x4<f32>();
        var xy = mat2x4<f32>();
        var w = mat2x4<f32>();
        for (var k = 0u; k < SPAN_OF_EIGHT; k++) {
            w = next_of_eight(w, k);
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
    let four = four_of(corner, lane);
    let sums = sums_of_four(four.first);
    let found = ssim_of(sums[0], sums[1], sums[2], sums[3]);
    let centre = four.first + 5u * SIDE + 5u;
    let abs_e = abs(vec4(
        around[centre].x,
        around[centre + 1u].x,
        around[centre + 2u].x,
        around[centre + 3u].x,
    ));
    for (var p = 0u; p < four.inside; p++) {
        let at = four.place + p;
        derivatives[at] = found.by_e[p];
        derivatives[at + size] = found.by_ee[p];
        derivatives[at + 2u * size] = found.by_ey[p];
        add_errors(at, abs_e[p], 1.0 - found.ssim[p]);
    }
    let counts = select(vec4(0.0), vec4(1.0), vec4(0u, 1u, 2u, 3u) < vec4(four.inside));
    reduced[lane] = vec2(dot(counts, abs_e), dot(counts, found.ssim));
    let of_tile = reduced_sum(lane);
    if lane == 0u {
        if launch.a == 0u {
            tile_sums[tile] = of_tile;
        } else {
            tile_sums[tile] += of_tile;
        }
    }
}

// A pixel's contribution to row scores, from its error.
fn score_contribution(error: f32, at: u32) -> f32 {
    var map = error;
    if frame.score.x != 1.0 {
        map = pow(max(error, 0.0), frame.score.x);
    }
    if frame.score.y > 0.0 {
        map *= edges[at];
    }
    return map;
}

// Computes dL/dpixel. Of the image it reads only the pixels that it replaces. The last launch also computes the means
// over the image.
@compute @workgroup_size(64)
fn pixel_gradient(
    @builtin(workgroup_id) id: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let tile = group_of(id);
    if tile >= frame.image.w {
        return;
    }
    let channel = launch.a;
    if channel == 2u && tile == 0u {
        total_of_tiles(lane);
    }
    let corner = corner_of(tile);
    let size = frame.image.x * frame.image.y;
    let scale = 1.0 / (3.0 * f32(size));
    if lane < COLUMNS {
        let first = first_of_run(lane);
        let top = pixel_around(corner, first);
        var x = mat2x4<f32>();
        var y = mat2x4<f32>();
        var z = mat2x4<f32>();
        var w = mat2x4<f32>();
        for (var k = 0u; k < SPAN_OF_EIGHT; k++) {
            w = next_of_eight(w, k);
            let at = top + vec2(0, i32(k));
            if is_inside(at) {
                let source = u32(at.y) * frame.image.x + u32(at.x);
                x += w * derivatives[source];
                y += w * derivatives[source + size];
                z += w * derivatives[source + 2u * size];
            }
        }
        store_eight(first, x, y, z, mat2x4<f32>());
    }
    workgroupBarrier();
    let four = four_of(corner, lane);
    let sums = sums_of_four(four.first);
    for (var p = 0u; p < four.inside; p++) {
        let ey = difference(vec2<i32>(four.pixel + vec2(p, 0u)), channel);
        let by_ssim = sums[0][p] + 2.0 * ey.x * sums[1][p] + ey.y * sums[2][p];
        var by_pixel = sign(ey.x);
        if PIXEL_BOUND > 0.0 {
            by_pixel = clamp(ey.x / PIXEL_BOUND, -1.0, 1.0);
        }
        let g = (1.0 - SSIM_WEIGHT) * scale * by_pixel - SSIM_WEIGHT * scale * by_ssim;
        // The loss is a function of e·mask, so the chain rule multiplies by the mask.
        let to = four.place + p;
        canvas[to][channel] = g * weight_of(to);
        if channel == 2u && (frame.draw.w & BY_PIXEL) != 0u {
            canvas[to].w = score_contribution(canvas[to].w, to);
        }
    }
}

// Computes the mean |e| and the mean SSIM of the image; to be called by all invocations of a group.
fn total_of_tiles(lane: u32) {
    var sums = vec2(0.0);
    for (var tile = lane; tile < frame.image.w; tile += MEMBERS) {
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

// The same where no gradient is computed; a single group.
@compute @workgroup_size(64)
fn total(@builtin(local_invocation_index) lane: u32) {
    total_of_tiles(lane);
}
