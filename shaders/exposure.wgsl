// Applies the exposure of the current photograph before the loss, and backpropagates through it, as in
// src/render/cpu/exposure.rs. A group handles 256 consecutive pixels, and an invocation of the
// backward kernel four of them.

@group(0) @binding(1) var<storage, read_write> canvas: array<vec4<f32>>;
// See rasterize.wgsl.
@group(0) @binding(3) var<storage, read> finish: array<vec2<u32>>;
// The image with the exposure, which the loss replaces by dL/dpixel; w: as in the canvas.
@group(0) @binding(4) var<storage, read_write> exposed: array<vec4<f32>>;
// Sums of each group, in four vectors: per channel the derivatives times red, green and blue, and the
// derivatives alone; then, per channel, the derivatives times the transmittance.
@group(0) @binding(5) var<storage, read_write> exposure_sums: array<vec4<f32>>;
// The same sums over the whole image.
@group(0) @binding(6) var<storage, read_write> exposure_total: array<vec4<f32>>;

// Number of invocations per group in the kernels that compute sums.
const ADDERS: u32 = 64u;

alias Summand = mat4x4<f32>;

// Applies the photograph's exposure to the image.
@compute @workgroup_size(256)
fn expose(@builtin(global_invocation_id) id: vec3<u32>) {
    let at = index_of(id);
    if at < frame.image.x * frame.image.y {
        exposed[at] = vec4(exposed_colour(canvas[at].xyz), canvas[at].w);
    }
}

// Replaces the image before the exposure by dL/dpixel, and computes the sums of the group.
@compute @workgroup_size(64)
fn expose_bwd(
    @builtin(workgroup_id) id: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let size = frame.image.x * frame.image.y;
    let group = group_of(id);
    var sums = mat4x4<f32>();
    for (var k = 0u; k < GROUP / ADDERS; k++) {
        let at = group * GROUP + k * ADDERS + lane;
        if at < size {
            let g = exposed[at].xyz;
            let colour = vec4(exposed_colour(canvas[at].xyz), 1.0);
            let light = bitcast<f32>(finish[at].x);
            sums += mat4x4(g.x * colour, g.y * colour, g.z * colour, vec4(g * light, 0.0));
            let back = g.x * exposure[0].xyz + g.y * exposure[1].xyz + g.z * exposure[2].xyz;
            canvas[at] = vec4(back, exposed[at].w);
        }
    }
    reduced[lane] = sums;
    let of_group = reduced_sum(lane);
    if lane == 0u && group * GROUP < size {
        let to = 4u * group;
        exposure_sums[to] = of_group[0];
        exposure_sums[to + 1u] = of_group[1];
        exposure_sums[to + 2u] = of_group[2];
        exposure_sums[to + 3u] = of_group[3];
    }
}

// Computes the sums over the image; a single group.
@compute @workgroup_size(64)
fn total_exposure(@builtin(local_invocation_index) lane: u32) {
    let groups = (frame.image.x * frame.image.y + GROUP - 1u) / GROUP;
    var sums = mat4x4<f32>();
    for (var group = lane; group < groups; group += ADDERS) {
        let at = 4u * group;
        sums += mat4x4(
            exposure_sums[at],
            exposure_sums[at + 1u],
            exposure_sums[at + 2u],
            exposure_sums[at + 3u],
        );
    }
    reduced[lane] = sums;
    let all = reduced_sum(lane);
    if lane == 0u {
        exposure_total[0] = all[0];
        exposure_total[1] = all[1];
        exposure_total[2] = all[2];
        exposure_total[3] = all[3];
    }
}
