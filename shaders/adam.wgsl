// Stage 7: Adam with a bias correction by each row's age, its number of steps; as in src/render/cpu/adam.rs.
// The coefficients of colour come first: one kernel per band, a pair of a row's parameters per invocation, so that
// reads are coalesced. Their gradient, the basis at the view direction times dL/dcolour, is computed
// here and never stored. The geometry comes last, one row per invocation, together with the loss
// terms and the noise on means that policies add (regularise.rs). Where the optimiser does not step
// at every iteration, gradients are summed until it does (summed.rs).

// A band of colour of all rows, and their other parameters. Moments and waiting gradients are those of the rows that
// are not frozen, with indices called `own`.
@group(0) @binding(2) var<storage, read_write> params: array<Coefficient>;
@group(0) @binding(9) var<storage, read_write> rows: array<RowPart>;
@group(0) @binding(5) var<storage, read_write> waiting: array<f32>;
// Each row's ages, its numbers of optimiser steps, in the halves of a word. Lower half: the age of all parameters but
// bands 1-3; upper half: that of bands 1-3, if they have a schedule of their own.
@group(0) @binding(6) var<storage, read_write> ages: array<u32>;
// The derivatives that project_bwd.wgsl has left; see record.wgsl.
@group(0) @binding(7) var<storage, read> row_sums: array<f32>;
@group(0) @binding(10) var<storage, read> splats: array<f32>;
// 1/(1 − β₁^age) and √(1/(1 − β₂^age)).
@group(0) @binding(8) var<storage, read> bias: array<vec2<f32>>;

const LOG_SCALE_LEAST: f32 = -13.8;
const LOG_SCALE_MOST: f32 = 2.3;
const LEAST_SHARE: f32 = 5.9604645e-8;

// Bits of frame.draw.z. REST: bands 1-3; MAIN: all other parameters.
const MAIN_STEPS: u32 = 1u;
const REST_STEPS: u32 = 2u;
const MAIN_WAITED: u32 = 4u;
const REST_WAITED: u32 = 8u;
const REST_AGES: u32 = 16u;
const TERMS: u32 = 32u;
const NOISE: u32 = 64u;

fn is_set(bit: u32) -> bool {
    return (frame.draw.z & bit) != 0u;
}

// Adds g to the waiting gradient at `own`: returns the sum if the optimiser steps now, or else keeps
// it waiting and returns 0.
fn take_gradient(own: u32, g: f32, steps: bool, waited: bool) -> f32 {
    if !steps {
        waiting[own] += g;
        return 0.0;
    }
    if waited {
        let sum = g + waiting[own];
        waiting[own] = 0.0;
        return sum;
    }
    return g;
}

// A pair of parameters after an optimiser step, whose moments it updates.
fn stepped(
    x: vec2<f32>,
    g: vec2<f32>,
    rate: vec2<f32>,
    correction: vec2<f32>,
    moments: ptr<function, Moments>,
) -> vec2<f32> {
    let m = (*moments).first * BETA1 + g * (1.0 - BETA1);
    let v = (*moments).second * BETA2 + g * g * (1.0 - BETA2);
    *moments = Moments(m, v);
    return x - m * correction.x * rate / (sqrt(v) * correction.y + EPSILON);
}

// The age after one more step, which saturates, as an age has 16 bits.
fn next_age(age: u32) -> u32 {
    return min(age + 1u, 0xffffu);
}

// Basis function k at the unit vector d.
fn basis_of(k: u32, d: vec3<f32>) -> f32 {
    let xx = d.x * d.x;
    let yy = d.y * d.y;
    let zz = d.z * d.z;
    switch k {
        case 0u: { return 0.28209479; }
        case 1u: { return -0.48860251 * d.y; }
        case 2u: { return 0.48860251 * d.z; }
        case 3u: { return -0.48860251 * d.x; }
        case 4u: { return 1.0925484 * d.x * d.y; }
        case 5u: { return -1.0925484 * d.y * d.z; }
        case 6u: { return 0.31539157 * (2.0 * zz - xx - yy); }
        case 7u: { return -1.0925484 * d.x * d.z; }
        case 8u: { return 0.5462742 * (xx - yy); }
        case 9u: { return -0.5900436 * d.y * (3.0 * xx - yy); }
        case 10u: { return 2.8906114 * d.x * d.y * d.z; }
        case 11u: { return -0.4570458 * d.y * (4.0 * zz - xx - yy); }
        case 12u: { return 0.37317633 * d.z * (2.0 * zz - 3.0 * xx - 3.0 * yy); }
        case 13u: { return -0.4570458 * d.x * (4.0 * zz - xx - yy); }
        case 14u: { return 1.4453057 * d.z * (xx - yy); }
        default: { return -0.5900436 * d.x * (xx - 3.0 * yy); }
    }
}

// One band; launch.a: its first coefficient, launch.b: its number of coefficients.
@compute @workgroup_size(256)
fn adam_band(@builtin(global_invocation_id) id: vec3<u32>) {
    let i = index_of(id);
    let width = 3u * launch.b;
    let pairs = (width + 1u) / 2u;
    let row = i / pairs;
    if row < frame.frozen.x || row >= frame.model.x {
        return;
    }
    let own = row - frame.frozen.x;
    let j = i - row * pairs;
    let is_rest = launch.a > 0u;
    let steps = is_set(select(MAIN_STEPS, REST_STEPS, is_rest));
    let waited = is_set(select(MAIN_WAITED, REST_WAITED, is_rest));
    let rate = select(frame.more_rates.x, frame.more_rates.y, is_rest);
    let has_rest_age = is_rest && is_set(REST_AGES);
    let age = next_age(select(ages[own] & 0xffffu, ages[own] >> 16u, has_rest_age));
    let correction = bias[min(age, MATURE)];
    let at = RECORD * row;
    let d = direction(load_row(row).mean).xyz;
    let unclamped = u32(row_sums[at + UNCLAMPED_AT]);
    var g = vec2(0.0);
    for (var p = 0u; p < 2u; p++) {
        let number = 2u * j + p;
        if number < width {
            let channel = number % 3u;
            let by_sum = row_sums[at + COLOUR_AT + channel];
            let by_colour = select(0.0, by_sum, ((unclamped >> channel) & 1u) != 0u);
            let by_number = basis_of(launch.a + number / 3u, d) * by_colour;
            g[p] = take_gradient(own * width + number, by_number, steps, waited);
        }
    }
    if steps {
        let plane = 11u + 3u * launch.a + 2u * j;
        var moments = load_moments(own, width, j);
        let x = stepped(load_pair(row, width, j), g, vec2(rate), correction, &moments);
        store_moments(own, width, j, row, plane, moments);
        store_pair(row, width, j, plane, x);
    }
}

// All parameters but colour; updates the ages.
@compute @workgroup_size(256)
fn adam_geometry(@builtin(global_invocation_id) id: vec3<u32>) {
    let row = index_of(id);
    if row < frame.frozen.x || row >= frame.model.x {
        return;
    }
    let steps = is_set(MAIN_STEPS);
    let waited = is_set(MAIN_WAITED);
    let own = row - frame.frozen.x;
    let age = ages[own];
    let correction = bias[min(next_age(age & 0xffffu), MATURE)];
    var known = load_row(row);
    var add = array<f32, 11>();
    if is_set(TERMS) {
        // The sigmoid's derivative e^x / (1 + e^x)² is even; evaluated for x <= 0, nothing cancels.
        let e = exp_exact(-abs(known.logit));
        add[10] = e / ((1.0 + e) * (1.0 + e)) * frame.more_rates.z;
        for (var k = 0u; k < 3u; k++) {
            add[3u + k] = exp_exact(known.log_scale[k]) * frame.more_rates.w;
        }
    }
    let rates = frame.rates;
    // In pairs; the last number is padding.
    let mean = known.mean;
    let scale = known.log_scale;
    let quat = known.quat;
    var x = array<vec2<f32>, 6>(
        mean.xy, vec2(mean.z, scale.x), scale.yz, quat.xy, quat.zw, vec2(known.logit, 0.0),
    );
    var rate = array<vec2<f32>, 6>(
        rates.xx, rates.xy, rates.yy, rates.zz, rates.zz, vec2(rates.w, 0.0),
    );
    for (var j = 0u; j < 6u; j++) {
        var g = vec2(0.0);
        for (var p = 0u; p < 2u; p++) {
            let k = 2u * j + p;
            if k < 11u {
                var by_number = 0.0;
                if k < OF_SPLAT {
                    by_number = splats[SPLAT * row + k];
                } else {
                    by_number = row_sums[RECORD * row + k - OF_SPLAT];
                }
                by_number += add[k];
                g[p] = take_gradient(12u * own + k, by_number, steps, waited);
            }
        }
        if steps {
            var moments = load_moments(own, 12u, j);
            x[j] = stepped(x[j], g, rate[j], correction, &moments);
            store_moments(own, 12u, j, row, 2u * j, moments);
        }
    }
    var main_age = age & 0xffffu;
    var rest_age = age >> 16u;
    if steps {
        main_age = next_age(main_age);
        known.mean = vec3(x[0], x[1].x);
        known.log_scale = vec3(x[1].y, x[2]);
        known.quat = vec4(x[3], x[4]);
        known.logit = x[5].x;
        known = confined(known);
        if is_set(NOISE) {
            known.mean += noise_of(row, known);
        }
        store_stepped_row(row, known);
    }
    if is_set(REST_STEPS) && is_set(REST_AGES) {
        rest_age = next_age(rest_age);
    }
    ages[own] = main_age | rest_age << 16u;
}

// A row with its quaternion normalised, and its scales and opacity clamped.
fn confined(row: Row) -> Row {
    var x = row;
    let norm2 = dot(x.quat, x.quat);
    // A quaternion this short has lost its direction, and is reset to the identity. Here and below,
    // NaN stays NaN, so that the audit finds it.
    if below(norm2, 1e-12) {
        x.quat = vec4(1.0, 0.0, 0.0, 0.0);
    } else if !below(norm2 - 1.0, SLACK) {
        x.quat = x.quat / sqrt(norm2);
    }
    for (var k = 0u; k < 3u; k++) {
        x.log_scale[k] = confined_to(x.log_scale[k], LOG_SCALE_LEAST, LOG_SCALE_MOST);
    }
    x.logit = confined_to(x.logit, -LOGIT_MAX, LOGIT_MAX);
    return x;
}

fn confined_to(x: f32, least: f32, most: f32) -> f32 {
    if below(x, LARGEST) {
        return clamp(x, least, most);
    }
    return x;
}

// Noise for a row's mean: Δμ = R·S²·Rᵀ·ξ · share · strength. The share falls from 1 to 0 as the opacity rises.
fn noise_of(row: u32, x: Row) -> vec3<f32> {
    let opacity = sigmoid(x.logit);
    let share = 1.0 / (1.0 + exp_exact(frame.noise.y * (opacity - frame.noise.z)));
    if share < LEAST_SHARE {
        return vec3(0.0);
    }
    let xi = normal3(row, frame.draw.y, frame.draw.x, PURPOSE_NOISE, 0u);
    let s = x.log_scale;
    let scale = vec3(exp_exact(s.x), exp_exact(s.y), exp_exact(s.z));
    let local = rotate(vec4(x.quat.x, -x.quat.yzw), xi);
    let noise = rotate(x.quat, scale * scale * local) * (frame.noise.x * share);
    if below(noise.x, LARGEST) && below(noise.y, LARGEST) && below(noise.z, LARGEST) {
        return noise;
    }
    return vec3(0.0);
}
