// Stage 8: what policies ask for, summed over views; src/backend/cpu/signals.rs. One row per
// invocation. Accumulators are planes of budget numbers; only what was asked for has one.

@group(0) @binding(1) var<storage, read> state: State;
@group(0) @binding(2) var<storage, read_write> signals: array<f32>;
// See project_bwd.wgsl.
@group(0) @binding(3) var<storage, read> gradient: array<vec4<f32>>;
@group(0) @binding(4) var<storage, read> row_sums: array<f32>;
@group(0) @binding(5) var<storage, read> depths: array<u32>;
@group(0) @binding(6) var<storage, read> splats: array<vec4<f32>>;
@group(0) @binding(7) var<storage, read> rows: array<f32>;
@group(0) @binding(8) var<storage, read> ages: array<u32>;

override DETAIL: u32 = 0u;

const FOLD: f32 = 0.8493218;

// Places in frame.planes.
const VISIBLE_COUNT: u32 = 0u;
const SCREEN_GRADIENT: u32 = 1u;
const SCREEN_GRADIENT_ABS: u32 = 2u;
const COLOUR_GRADIENT: u32 = 3u;
const MEAN_GRADIENT: u32 = 4u;
const MEAN_GRADIENT_NORM: u32 = 7u;
const WEIGHT_SUM: u32 = 8u;
const PIXEL_COUNT: u32 = 9u;
const WEIGHT_MAX: u32 = 10u;
const FRESH_WEIGHT_MAX: u32 = 11u;

fn plane(signal: u32) -> u32 {
    return frame.planes[signal / 4u][signal % 4u];
}

fn add(signal: u32, row: u32, value: f32) {
    let p = plane(signal);
    if p != NONE {
        signals[p * frame.model.w + row] += value;
    }
}

fn raise(signal: u32, row: u32, value: f32) {
    let p = plane(signal);
    if p != NONE {
        let at = p * frame.model.w + row;
        signals[at] = max(signals[at], value);
    }
}

fn largest_weight(row: u32) -> f32 {
    if DETAIL == 1u {
        return row_sums[10u * row + 9u];
    }
    if DETAIL == 2u {
        return row_sums[15u * row + 14u];
    }
    return 0.0;
}

@compute @workgroup_size(256)
fn accumulate(
    @builtin(workgroup_id) id: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let row = group_of(id) * GROUP + lane;
    if row >= frame.model.x || state.short != 0u || depths[row] == NONE {
        return;
    }
    let half = 0.5 * vec2<f32>(frame.image.xy);
    let by_mean = gradient[5u * row].xyz;
    let by_projected = vec2(gradient[5u * row + 2u].w, gradient[5u * row + 3u].w);
    let at = row * select(select(9u, 10u, DETAIL == 1u), 15u, DETAIL == 2u);
    let by_colour = vec3(row_sums[at + 6u], row_sums[at + 7u], row_sums[at + 8u]);
    add(VISIBLE_COUNT, row, 1.0);
    let depth = bitcast<f32>(depths[row]);
    let full = frame.background.w;
    var weight = 1.0;
    if depth < full {
        weight = (depth / full) * (depth / full);
    }
    add(SCREEN_GRADIENT, row, weight * norm2(by_projected * half));
    add(COLOUR_GRADIENT, row, weight * norm3(by_colour));
    for (var k = 0u; k < 3u; k++) {
        add(MEAN_GRADIENT + k, row, by_mean[k]);
    }
    add(MEAN_GRADIENT_NORM, row, norm3(by_mean));
    if DETAIL == 2u {
        // The sums are in folded units, and l1 is not in the first.
        let unfold = 1.0 / FOLD;
        let l1 = splats[3u * row].z * unfold;
        let abs_gradient = vec2(l1 * unfold * row_sums[at + 9u], unfold * unfold * row_sums[at + 10u]);
        add(SCREEN_GRADIENT_ABS, row, weight * norm2(abs_gradient * half));
        add(WEIGHT_SUM, row, row_sums[at + 11u]);
        add(PIXEL_COUNT, row, row_sums[at + 12u]);
    }
    if DETAIL >= 1u {
        raise(WEIGHT_MAX, row, largest_weight(row));
    }
}

// Squares of small gradients would underflow, and some devices flush them to 0 sooner.
fn norm2(v: vec2<f32>) -> f32 {
    let most = max(abs(v.x), abs(v.y));
    if !(most > 0.0) {
        return 0.0;
    }
    let scaled = v / most;
    return most * sqrt(dot(scaled, scaled));
}

fn norm3(v: vec3<f32>) -> f32 {
    let most = max(max(abs(v.x), abs(v.y)), abs(v.z));
    if !(most > 0.0) {
        return 0.0;
    }
    let scaled = v / most;
    return most * sqrt(dot(scaled, scaled));
}

// Counts one more view for the largest weight of fresh views.
@compute @workgroup_size(256)
fn measure(
    @builtin(workgroup_id) id: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let row = group_of(id) * GROUP + lane;
    if row < frame.model.x && state.short == 0u && depths[row] != NONE {
        raise(FRESH_WEIGHT_MAX, row, largest_weight(row));
    }
}

// Present values into the first plane of `signals`, which is a scratch buffer then; now.a: 0
// opacity, 1 largest scale, 2 product of the scales, 3 age.
@compute @workgroup_size(256)
fn present(
    @builtin(workgroup_id) id: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let row = group_of(id) * GROUP + lane;
    if row >= frame.model.x {
        return;
    }
    let s = vec3(rows[12u * row + 3u], rows[12u * row + 4u], rows[12u * row + 5u]);
    let logit = rows[12u * row + 10u];
    var value = f32(ages[row] & 0xffffu);
    switch now.a {
        case 0u: {
            let e = exp_exact(-abs(logit));
            value = select(e, 1.0, logit >= 0.0) / (1.0 + e);
        }
        case 1u: { value = exp_exact(max(max(s.x, s.y), s.z)); }
        case 2u: { value = exp_exact(s.x + s.y + s.z); }
        default: {}
    }
    signals[row] = value;
}
