// Learned masks: one logit per row, trained so that rows that matter little are masked out, as in
// src/render/cpu/mask.rs. One row per invocation, before the geometry steps.

@group(0) @binding(2) var<storage, read_write> rows: array<RowPart>;
// Change of each mask's logit since its start; then the logit's two moments.
@group(0) @binding(3) var<storage, read_write> mask_offsets: array<f32>;
@group(0) @binding(4) var<storage, read_write> mask_moments: array<f32>;
@group(0) @binding(5) var<storage, read> ages: array<u32>;
// The derivatives that project_bwd.wgsl has left; see record.wgsl.
@group(0) @binding(1) var<storage, read> row_sums: array<f32>;
@group(0) @binding(6) var<storage, read> splats: array<f32>;
@group(0) @binding(7) var<storage, read> bias: array<vec2<f32>>;

// Bits of: the initial logit of masks (launch.a), the step size (launch.b), the derivative of the loss term
// with respect to a row's mask (launch.c), the logit of the threshold (launch.d).
@compute @workgroup_size(256)
fn step_masks(@builtin(global_invocation_id) id: vec3<u32>) {
    let row = index_of(id);
    if row < frame.frozen.x || row >= frame.model.x {
        return;
    }
    let own = row - frame.frozen.x;
    let start = bitcast<f32>(launch.a);
    var known = load_row(row);
    let g_opacity = row_sums[RECORD * row + LOGIT_AT];
    let scales = SPLAT * row + 3u;
    let g_scales = splats[scales] + splats[scales + 1u] + splats[scales + 2u];
    let by_factor = g_opacity / sigmoid(-known.logit) + g_scales;
    let m = start + mask_offsets[own];
    let g = (by_factor + bitcast<f32>(launch.c)) * sigmoid(m) * sigmoid(-m);
    let first = mask_moments[2u * own] * BETA1 + g * (1.0 - BETA1);
    let second = mask_moments[2u * own + 1u] * BETA2 + g * g * (1.0 - BETA2);
    let correction = bias[min((ages[own] & 0xffffu) + 1u, MATURE)];
    let step = first * correction.x * bitcast<f32>(launch.b) / (sqrt(second) * correction.y + EPSILON);
    mask_offsets[own] -= step;
    mask_moments[2u * own] = first;
    mask_moments[2u * own + 1u] = second;
    if start + mask_offsets[own] <= bitcast<f32>(launch.d) {
        known.logit = -LOGIT_MAX;
        store_row(row, known);
    }
}
