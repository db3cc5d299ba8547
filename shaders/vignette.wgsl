// Dims the exposed image as the vignette of the current photograph does, and backpropagates through it, as in
// src/render/cpu/vignette.rs. A group handles 256 consecutive pixels, and an invocation of the backward kernel
// four of them.

// The coefficients; then the photograph's middle [px], and the size of a pixel as a share of its longer side.
@group(0) @binding(1) var<storage, read> vignette: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read> canvas: array<vec4<f32>>;
// The exposed image; in the backward kernel the derivatives with respect to the dimmed one.
@group(0) @binding(4) var<storage, read_write> exposed: array<vec4<f32>>;
// See loss.wgsl.
@group(0) @binding(5) var<storage, read> truth: array<u32>;
// Sums of each group: the derivatives with respect to the coefficients.
@group(0) @binding(6) var<storage, read_write> vignette_sums: array<vec4<f32>>;
// The same sums over the whole image.
@group(0) @binding(7) var<storage, read_write> vignette_total: array<vec4<f32>>;

// Number of invocations per group in the kernels that compute sums.
const ADDERS: u32 = 64u;
const DARKEST: f32 = 1.0 / 64.0;
const CURVE_OFFSET: f32 = 0.055;
const CURVE: f32 = 2.4;
// A bit of frame.draw.w.
const HAS_ALPHA: u32 = 1u;

alias Summand = vec3<f32>;

// What the vignette does to a pixel: the factor on an encoded value, its derivative with respect to V, and r².
fn dimming(at: u32) -> vec3<f32> {
    let pixel = vec2<f32>(vec2(at % frame.image.x, at / frame.image.x));
    let d = (pixel + 0.5 - vignette[1].xy) * vignette[1].zw;
    let s = d.x * d.x + d.y * d.y;
    let light = 1.0 + s * (vignette[0].x + s * (vignette[0].y + s * vignette[0].z));
    let limited = clamp(light, DARKEST, 1.0);
    let v = pow(limited, 1.0 / CURVE);
    var alpha = 1.0;
    if (frame.draw.w & HAS_ALPHA) != 0u {
        alpha = f32(truth[at] >> 24u) * (1.0 / 255.0);
    }
    let within = select(0.0, alpha, light >= DARKEST && light <= 1.0);
    return vec3(1.0 - alpha * (1.0 - v), within * v / (CURVE * limited), s);
}

// Dims the exposed image.
@compute @workgroup_size(256)
fn dim(@builtin(global_invocation_id) id: vec3<u32>) {
    let at = index_of(id);
    if at < frame.image.x * frame.image.y {
        let colour = dimming(at).x * (exposed[at].xyz + CURVE_OFFSET) - CURVE_OFFSET;
        exposed[at] = vec4(colour, exposed[at].w);
    }
}

// Replaces the derivatives with respect to the dimmed image by those with respect to the exposed one, and computes the
// sums of the group.
@compute @workgroup_size(64)
fn dim_bwd(
    @builtin(workgroup_id) id: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let size = frame.image.x * frame.image.y;
    let group = group_of(id);
    var sums = vec3(0.0);
    for (var k = 0u; k < GROUP / ADDERS; k++) {
        let at = group * GROUP + k * ADDERS + lane;
        if at < size {
            let g = exposed[at].xyz;
            let colour = exposed_colour(canvas[at].xyz);
            let found = dimming(at);
            let s = found.z;
            let power = dot(g, colour + CURVE_OFFSET) * found.y * s;
            sums += vec3(power, power * s, power * s * s);
            exposed[at] = vec4(g * found.x, exposed[at].w);
        }
    }
    reduced[lane] = sums;
    let of_group = reduced_sum(lane);
    if lane == 0u && group * GROUP < size {
        vignette_sums[group] = vec4(of_group, 0.0);
    }
}

// Computes the sums over the image; a single group.
@compute @workgroup_size(64)
fn total_vignette(@builtin(local_invocation_index) lane: u32) {
    let groups = (frame.image.x * frame.image.y + GROUP - 1u) / GROUP;
    var sums = vec3(0.0);
    for (var group = lane; group < groups; group += ADDERS) {
        sums += vignette_sums[group].xyz;
    }
    reduced[lane] = sums;
    let all = reduced_sum(lane);
    if lane == 0u {
        vignette_total[0] = vec4(all, 0.0);
    }
}
