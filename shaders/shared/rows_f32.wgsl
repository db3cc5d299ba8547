// Rows as f32: three vectors each, whose last number is padding. rows_f16.wgsl replaces this file if parameters are
// stored in 16 bits.

alias RowPart = vec4<f32>;

fn load_row(row: u32) -> Row {
    let a = rows[3u * row];
    let b = rows[3u * row + 1u];
    let c = rows[3u * row + 2u];
    return Row(a.xyz, vec3(a.w, b.x, b.y), vec4(b.z, b.w, c.x, c.y), c.z);
}
