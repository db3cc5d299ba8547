// Rows of seven words: the mean as f32, then pairs of bounded numbers in fixed point. rows_f32.wgsl replaces this file
// if parameters are f32.

alias RowPart = u32;

// Words per row; fractional bits of log-scales and logits, and of quaternions.
const ROW_WORDS: u32 = 7u;
const ROW_DIGITS: u32 = 11u;
const QUAT_DIGITS: u32 = 14u;

fn load_row(row: u32) -> Row {
    let at = ROW_WORDS * row;
    let a = rows[at + 3u];
    let b = rows[at + 4u];
    let c = rows[at + 5u];
    let d = rows[at + 6u];
    let quat = vec4(
        fixed_of(b >> 16u, QUAT_DIGITS),
        fixed_of(c, QUAT_DIGITS),
        fixed_of(c >> 16u, QUAT_DIGITS),
        fixed_of(d, QUAT_DIGITS),
    );
    return Row(
        vec3(bitcast<f32>(rows[at]), bitcast<f32>(rows[at + 1u]), bitcast<f32>(rows[at + 2u])),
        vec3(fixed_of(a, ROW_DIGITS), fixed_of(a >> 16u, ROW_DIGITS), fixed_of(b, ROW_DIGITS)),
        quat,
        fixed_of(d >> 16u, ROW_DIGITS),
    );
}
