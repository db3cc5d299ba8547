// Stage 7: Adam with a bias correction by each row's age, its number of steps; as in src/render/cpu/adam.rs.
// The coefficients of colour come first: one kernel per band, a pair of a row's parameters per invocation, so that
// reads are coalesced. Their gradient, the basis at the view direction times dL/dcolour, is computed
// here and never stored. The geometry comes last, one row per invocation, together with the loss
// terms and the noise on means that policies add (regularise.rs). Where the optimiser does not step
// at every iteration, gradients are summed until it does (summed.rs).

@group(0) @binding(1) var<storage, read> state: State;
// Parameters of all rows; moments and waiting gradients of the rows that are not frozen, with indices called `own`.
@group(0) @binding(2) var<storage, read_write> params: array<f32>;
@group(0) @binding(5) var<storage, read_write> waiting: array<f32>;
// Each row's ages, its numbers of optimiser steps, in the halves of a word. Lower half: the age of all parameters but
// bands 1-3; upper half: that of bands 1-3, if they have a schedule of their own.
@group(0) @binding(6) var<storage, read_write> ages: array<u32>;
// See project_bwd.wgsl.
@group(0) @binding(7) var<storage, read> gradient: array<vec4<f32>>;
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
    if row < frame.frozen.x || row >= frame.model.x || state.short != 0u {
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
    let d = gradient[5u * own + 4u].xyz;
    let by_colour = gradient[5u * own + 3u];
    var g = vec2(0.0);
    for (var p = 0u; p < 2u; p++) {
        let number = 2u * j + p;
        if number < width {
            let by_number = basis_of(launch.a + number / 3u, d) * by_colour[number % 3u];
            g[p] = take_gradient(own * width + number, by_number, steps, waited);
        }
    }
    if steps {
        let at = row * width + 2u * j;
        let has_two = 2u * j + 1u < width;
        var x = vec2(params[at], 0.0);
        if has_two {
            x.y = params[at + 1u];
        }
        var moments = load_moments(own, width, j);
        x = stepped(x, g, vec2(rate), correction, &moments);
        store_moments(own, width, j, row, 11u + 3u * launch.a + 2u * j, moments);
        params[at] = x.x;
        if has_two {
            params[at + 1u] = x.y;
        }
    }
}

// All parameters but colour; updates the ages.
@compute @workgroup_size(256)
fn adam_geometry(@builtin(global_invocation_id) id: vec3<u32>) {
    let row = index_of(id);
    if row < frame.frozen.x || row >= frame.model.x || state.short != 0u {
        return;
    }
    let steps = is_set(MAIN_STEPS);
    let waited = is_set(MAIN_WAITED);
    let own = row - frame.frozen.x;
    let age = ages[own];
    let correction = bias[min(next_age(age & 0xffffu), MATURE)];
    let base = 12u * row;
    var add = array<f32, 11>();
    if is_set(TERMS) {
        // The sigmoid's derivative e^x / (1 + e^x)² is even; evaluated for x <= 0, nothing cancels.
        let e = exp_exact(-abs(params[base + 10u]));
        add[10] = e / ((1.0 + e) * (1.0 + e)) * frame.more_rates.z;
        for (var k = 3u; k < 6u; k++) {
            add[k] = exp_exact(params[base + k]) * frame.more_rates.w;
        }
    }
    let rates = frame.rates;
    // In pairs; the last number is padding.
    var rate = array<vec2<f32>, 6>(
        rates.xx, rates.xy, rates.yy, rates.zz, rates.zz, vec2(rates.w, 0.0),
    );
    for (var j = 0u; j < 6u; j++) {
        var g = vec2(0.0);
        for (var p = 0u; p < 2u; p++) {
            let k = 2u * j + p;
            if k < 11u {
                let by_number = gradient[5u * own + k / 4u][k % 4u] + add[k];
                g[p] = take_gradient(12u * own + k, by_number, steps, waited);
            }
        }
        if steps {
            let at = base + 2u * j;
            var moments = load_moments(own, 12u, j);
            let x = stepped(vec2(params[at], params[at + 1u]), g, rate[j], correction, &moments);
            store_moments(own, 12u, j, row, 2u * j, moments);
            params[at] = x.x;
            params[at + 1u] = x.y;
        }
    }
    var main_age = age & 0xffffu;
    var rest_age = age >> 16u;
    if steps {
        main_age = next_age(main_age);
        confine(base);
        if is_set(NOISE) {
            add_noise(row, base);
        }
    }
    if is_set(REST_STEPS) && is_set(REST_AGES) {
        rest_age = next_age(rest_age);
    }
    ages[own] = main_age | rest_age << 16u;
}

// Normalises the quaternion of a row, and clamps its scales and opacity.
fn confine(base: u32) {
    let q = vec4(params[base + 6u], params[base + 7u], params[base + 8u], params[base + 9u]);
    let norm2 = dot(q, q);
    // A quaternion this short has lost its direction, and is reset to the identity. Here and below,
    // NaN stays NaN, so that the audit finds it.
    var unit = q / sqrt(norm2);
    if below(norm2, 1e-12) {
        unit = vec4(1.0, 0.0, 0.0, 0.0);
    }
    for (var k = 0u; k < 4u; k++) {
        params[base + 6u + k] = unit[k];
    }
    for (var k = 3u; k < 6u; k++) {
        confine_to(base + k, LOG_SCALE_LEAST, LOG_SCALE_MOST);
    }
    confine_to(base + 10u, -LOGIT_MAX, LOGIT_MAX);
}

fn confine_to(at: u32, least: f32, most: f32) {
    let x = params[at];
    if below(x, LARGEST) {
        params[at] = clamp(x, least, most);
    }
}

// Adds noise to a row's mean: Δμ = R·S²·Rᵀ·ξ · share · strength. The share falls from 1 to 0 as the opacity rises.
fn add_noise(row: u32, base: u32) {
    let opacity = sigmoid(params[base + 10u]);
    let share = 1.0 / (1.0 + exp_exact(frame.noise.y * (opacity - frame.noise.z)));
    if share < LEAST_SHARE {
        return;
    }
    let xi = normal3(row, frame.draw.y, frame.draw.x, PURPOSE_NOISE, 0u);
    let q = vec4(params[base + 6u], params[base + 7u], params[base + 8u], params[base + 9u]);
    let scale = vec3(
        exp_exact(params[base + 3u]),
        exp_exact(params[base + 4u]),
        exp_exact(params[base + 5u]),
    );
    let local = rotate(vec4(q.x, -q.yzw), xi);
    let move_by = rotate(q, scale * scale * local) * (frame.noise.x * share);
    if below(move_by.x, LARGEST) && below(move_by.y, LARGEST) && below(move_by.z, LARGEST) {
        for (var k = 0u; k < 3u; k++) {
            params[base + k] += move_by[k];
        }
    }
}
