// A row's parameters but its colour. Modules that include rows_f32.wgsl or rows_f16.wgsl declare
// `rows: array<RowPart>`.

struct Row {
    mean: vec3<f32>,
    log_scale: vec3<f32>,
    // w, x, y, z.
    quat: vec4<f32>,
    logit: f32,
}
