// Adam's moments of the rows that are not frozen, as f32, by pairs of a row's numbers. moments_both8.wgsl replaces this
// file if a moment is stored in a byte.

@group(0) @binding(3) var<storage, read_write> first: array<f32>;
@group(0) @binding(4) var<storage, read_write> second: array<f32>;

// The moments of a row's numbers 2j and 2j + 1. `width`: numbers per row.
fn load_moments(own: u32, width: u32, j: u32) -> Moments {
    let at = own * width + 2u * j;
    if 2u * j + 1u == width {
        return Moments(vec2(first[at], 0.0), vec2(second[at], 0.0));
    }
    return Moments(vec2(first[at], first[at + 1u]), vec2(second[at], second[at + 1u]));
}

// `row`, `plane`: the row, and the index of number 2j among the parameters of a row, for random rounding.
fn store_moments(own: u32, width: u32, j: u32, row: u32, plane: u32, moments: Moments) {
    let at = own * width + 2u * j;
    first[at] = moments.first.x;
    second[at] = moments.second.x;
    if 2u * j + 1u < width {
        first[at + 1u] = moments.first.y;
        second[at + 1u] = moments.second.y;
    }
}
