// Stores rows in 16 bits; see rows_f16.wgsl.

// Stores a row; `random`: the random bits of each bounded number.
fn store_rounded(row: u32, x: Row, random: array<u32, 8>) {
    let at = ROW_WORDS * row;
    for (var k = 0u; k < 3u; k++) {
        rows[at + k] = bitcast<u32>(x.mean[k]);
    }
    let scale_x = code_of_fixed(x.log_scale.x, ROW_DIGITS, random[0]);
    let scale_y = code_of_fixed(x.log_scale.y, ROW_DIGITS, random[1]);
    let scale_z = code_of_fixed(x.log_scale.z, ROW_DIGITS, random[2]);
    let quat_w = code_of_fixed(x.quat.x, QUAT_DIGITS, random[3]);
    let quat_x = code_of_fixed(x.quat.y, QUAT_DIGITS, random[4]);
    let quat_y = code_of_fixed(x.quat.z, QUAT_DIGITS, random[5]);
    let quat_z = code_of_fixed(x.quat.w, QUAT_DIGITS, random[6]);
    let logit = code_of_fixed(x.logit, ROW_DIGITS, random[7]);
    rows[at + 3u] = scale_x | scale_y << 16u;
    rows[at + 4u] = scale_z | quat_w << 16u;
    rows[at + 5u] = quat_x | quat_y << 16u;
    rows[at + 6u] = quat_z | logit << 16u;
}

// Stores a row, rounded to nearest.
fn store_row(row: u32, x: Row) {
    let n = NEAREST;
    store_rounded(row, x, array<u32, 8>(n, n, n, n, n, n, n, n));
}
