// Depth in the loss, after stage 3: its value, and the channel that the backward pass differentiates.
// src/render/cpu/depth_gradient.rs derives the formulas.
//
// The channel has two numbers per pixel, which follow those of rasterize.wgsl in `finish`: the centre, which is negative
// if the second number, a factor, is that of a square. The gradient with respect to alpha is a multiple of the factor.

@group(0) @binding(1) var<storage, read_write> state: State;
@group(0) @binding(2) var<storage, read_write> canvas: array<vec4<f32>>;
// See rasterize.wgsl.
@group(0) @binding(3) var<storage, read_write> finish: array<vec2<u32>>;
// Weights of the pixels, one byte each.
@group(0) @binding(4) var<storage, read> mask: array<u32>;
// Per pixel, 16 bits each: given inverse depth in multiples of its unit, and confidence times mask in units of 1/255².
// Both are 0 where no depth is given.
@group(0) @binding(5) var<storage, read> given_depth: array<u32>;
// Sums of the depth term per group of pixels.
@group(0) @binding(6) var<storage, read_write> depth_sums: array<f32>;

// See loss.wgsl.
const HAS_MASK: u32 = 2u;

alias Summand = f32;
const ADDERS: u32 = GROUP;

// The inverse depth given in a pixel, and its confidence times its mask.
fn given(at: u32) -> vec2<f32> {
    if (frame.draw.w & GIVEN_DEPTH) == 0u {
        return vec2(0.0);
    }
    let word = given_depth[at];
    return vec2(f32(word & 0xffffu) * bitcast<f32>(frame.frozen.y), f32(word >> 16u) * (1.0 / 65025.0));
}

// Writes the inverse depth from which the forward pass takes distances.
@compute @workgroup_size(256)
fn place_depth(@builtin(global_invocation_id) id: vec3<u32>) {
    let at = index_of(id);
    if at < frame.image.x * frame.image.y {
        canvas[at].w = given(at).x;
    }
}

fn weight_of(at: u32) -> f32 {
    if (frame.draw.w & HAS_MASK) == 0u {
        return 1.0;
    }
    return f32((mask[at / 4u] >> (8u * (at % 4u))) & 0xffu) * (1.0 / 255.0);
}

// Writes the channel of a pixel and returns its part of the depth term. launch.a: weight of the distortion of a pixel;
// launch.b: the smallest expected inverse depth with a distortion term; launch.c: weight of the depth term; launch.d:
// 1/Σκ. All are bits of f32.
fn differentiate(at: u32) -> f32 {
    let here = given(at);
    let light = bitcast<f32>(finish[at].x);
    let alpha = 1.0 - light;
    let is_seen = alpha > 0.0;
    let divisor = select(1.0, alpha, is_seen);
    let sum = canvas[at].w;
    let expected = sum / divisor;
    let by_light = here.y * bitcast<f32>(launch.d);
    let by_distance = by_light * bitcast<f32>(frame.frozen.z);
    var value = 0.0;
    var centre = expected;
    var factor = 0.0;
    if here.y > 0.0 {
        if (frame.draw.w & DEPTH_DISTANCES) != 0u {
            value = by_distance * sum + by_light * light;
            centre = here.x;
            factor = bitcast<f32>(launch.c) * by_distance;
        } else if is_seen {
            let error = expected - here.x;
            value = by_distance * abs(error);
            factor = bitcast<f32>(launch.c) * by_distance / divisor * sign(error);
        }
    } else if is_seen && expected >= bitcast<f32>(launch.b) {
        centre = -expected;
        factor = bitcast<f32>(launch.a) * weight_of(at) / expected / expected;
    }
    finish[frame.image.x * frame.image.y + at] = bitcast<vec2<u32>>(vec2(centre, factor));
    return value;
}

@compute @workgroup_size(256)
fn depth_gradient(
    @builtin(global_invocation_id) id: vec3<u32>,
    @builtin(workgroup_id) group_id: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let at = index_of(id);
    let is_inside = at < frame.image.x * frame.image.y;
    var value = 0.0;
    if is_inside {
        value = differentiate(at);
    }
    reduced[lane] = value;
    let all = reduced_sum(lane);
    if lane == 0u && is_inside {
        depth_sums[group_of(group_id)] = all;
    }
}

// Computes the sum over the image; a single group.
@compute @workgroup_size(256)
fn total_depth(@builtin(local_invocation_index) lane: u32) {
    let groups = (frame.image.x * frame.image.y + GROUP - 1u) / GROUP;
    var sum = 0.0;
    for (var group = lane; group < groups; group += GROUP) {
        sum += depth_sums[group];
    }
    reduced[lane] = sum;
    let all = reduced_sum(lane);
    if lane == 0u {
        state.depth = all;
    }
}
