// Finds rows with a number that is not finite; see src/render/audit.rs. Numbers are read as bits,
// because WGSL may assume that there is no NaN. One row per invocation.

// Per row: 0, or 1 + the index of its first number that is not finite.
@group(0) @binding(1) var<storage, read_write> marks: array<u32>;
@group(0) @binding(2) var<storage, read> numbers: array<u32>;

// Codes of second moments that are not finite, in the bytes of a word that hold second moments.
const NOT_FINITE_LOW: u32 = 0x0000ff00u;
const NOT_FINITE_HIGH: u32 = 0xff000000u;
const NOT_FINITE: u32 = 0x7f800000u;

// launch.a: number of rows; launch.b: numbers per row; launch.c: index of the first of them among the parameters
// of a row; launch.d: the first row that has numbers in this buffer.
@compute @workgroup_size(256)
fn audit(@builtin(global_invocation_id) id: vec3<u32>) {
    let own = index_of(id);
    let row = own + launch.d;
    if row >= launch.a || marks[row] != 0u {
        return;
    }
    for (var k = 0u; k < launch.b; k++) {
        if (numbers[own * launch.b + k] & NOT_FINITE) == NOT_FINITE {
            marks[row] = launch.c + k + 1u;
            return;
        }
    }
}

// The same for moments in bytes; launch.b: words per row, with the moments of two numbers each (see
// shared/moments_both8.wgsl).
@compute @workgroup_size(256)
fn audit_bytes(@builtin(global_invocation_id) id: vec3<u32>) {
    let own = index_of(id);
    let row = own + launch.d;
    if row >= launch.a || marks[row] != 0u {
        return;
    }
    for (var j = 0u; j < launch.b; j++) {
        let word = numbers[own * launch.b + j];
        let is_first = (word & NOT_FINITE_LOW) == NOT_FINITE_LOW;
        if is_first || (word & NOT_FINITE_HIGH) == NOT_FINITE_HIGH {
            marks[row] = launch.c + 2u * j + select(2u, 1u, is_first);
            return;
        }
    }
}

// The same for parameters in 16 bits, two in a word. launch.b: words per row; in the geometry, seven, three numbers
// of f32 come first and the others are in fixed point.
@compute @workgroup_size(256)
fn audit_halves(@builtin(global_invocation_id) id: vec3<u32>) {
    let own = index_of(id);
    let row = own + launch.d;
    if row >= launch.a || marks[row] != 0u {
        return;
    }
    let is_geometry = launch.b == 7u;
    let wide = select(0u, 3u, is_geometry);
    for (var j = 0u; j < launch.b; j++) {
        let word = numbers[own * launch.b + j];
        if j < wide {
            if (word & NOT_FINITE) == NOT_FINITE {
                marks[row] = launch.c + j + 1u;
                return;
            }
            continue;
        }
        for (var p = 0u; p < 2u; p++) {
            let code = (word >> (16u * p)) & 0xffffu;
            let is_finite = select((code & 0x7c00u) != 0x7c00u, code != 0x8000u, is_geometry);
            if !is_finite {
                marks[row] = launch.c + wide + 2u * (j - wide) + p + 1u;
                return;
            }
        }
    }
}
