// Stores rows as f32; see rows_f32.wgsl.

fn store_row(row: u32, x: Row) {
    rows[3u * row] = vec4(x.mean, x.log_scale.x);
    rows[3u * row + 1u] = vec4(x.log_scale.yz, x.quat.xy);
    rows[3u * row + 2u] = vec4(x.quat.zw, x.logit, 0.0);
}
