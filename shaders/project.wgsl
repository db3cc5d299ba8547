// Stage 1: projects rows to splats, one row per invocation, as in src/render/cpu/project.rs.

// Three vectors per row: projected mean, l1, shear | l3, log2 of the opacity, depth, unused | colour, unused.
@group(0) @binding(6) var<storage, read_write> splats: array<vec4<f32>>;
// The tiles that the row's ellipse touches: columns x0 | x1 << 16, lines y0 | y1 << 16, a bit for each
// of 8 × 4 blocks of tiles starting at (x0, y0), and the log2 of a block's width | that of its height << 16.
@group(0) @binding(7) var<storage, read_write> footprints: array<vec4<u32>>;
// Bits of the depth; NONE for rows that are not on screen.
@group(0) @binding(8) var<storage, read_write> depths: array<u32>;

// Slack for the bounds of an ellipse [px]; see src/render/cpu/footprint.rs.
const SLACK: f32 = 0.02;

// True if the splat's extent contains the centre of any pixel; pixel centres range from 1/2 to size − 1/2.
fn reaches(centre: f32, half: f32, size: u32) -> bool {
    return centre + half >= 0.5 && centre - half <= f32(size) - 0.5;
}

fn tile_of(x: f32, count: u32) -> u32 {
    return u32(clamp(x * (1.0 / 16.0), 0.0, f32(count - 1u)));
}

@compute @workgroup_size(256)
fn project(@builtin(global_invocation_id) id: vec3<u32>) {
    let i = index_of(id);
    if i >= frame.model.x {
        return;
    }
    depths[i] = NONE;
    let row = load_row(i);
    var sound = below(row.logit, LARGEST);
    for (var k = 0u; k < 3u; k++) {
        sound = sound && below(row.log_scale[k], LARGEST) && below(row.mean[k], LARGEST);
    }
    for (var k = 0u; k < 4u; k++) {
        sound = sound && below(row.quat[k], LARGEST);
    }
    if !sound {
        return;
    }
    var log2_opacity = log2_sigmoid(row.logit);
    // Decrease of the exponent from the centre to where alpha is ALPHA_MIN; <= 0 if even the centre is fainter.
    var reach = log2_opacity + LOG2_REACH;
    if reach <= 0.0 {
        return;
    }
    let g = geometry(row);
    if !(g.p.z > frame.centre.w) {
        return;
    }
    if LOWERS_OPACITY {
        // If a determinant overflows, this may be wrong; the check of g.det further down rejects such rows.
        log2_opacity += log2_rho(g);
        reach = log2_opacity + LOG2_REACH;
        if reach <= 0.0 {
            return;
        }
    }
    let factor = conic(g);
    let radius = sqrt(reach) * (1.0 / EXPONENT_SCALE);
    let half_width = radius * sqrt(g.cov.x);
    let half_height = radius * sqrt(g.cov.z);
    let u = g.ratio.x * frame.lens.x + frame.lens.z;
    let v = g.ratio.y * frame.lens.y + frame.lens.w;
    // The determinant of a row about 4e9 px wide overflows f32; its conic factors are then not finite.
    sound = below(g.det, LARGEST) && below(half_width, LARGEST) && below(half_height, LARGEST)
        && below(u, LARGEST) && below(v, LARGEST) && below(factor.x, LARGEST)
        && below(factor.y, LARGEST);
    if !(sound && reaches(u, half_width, frame.image.x) && reaches(v, half_height, frame.image.y)) {
        return;
    }
    let degree = frame.model.y;
    let towards = direction(row.mean);
    var y = basis(degree, towards.xyz);
    let raw = raw_colour(i, degree, &y);
    if !(below(raw.x, COLOUR_MAX) && below(raw.y, COLOUR_MAX) && below(raw.z, COLOUR_MAX)) {
        return;
    }
    let l1 = factor.x * EXPONENT_SCALE;
    let l3 = factor.z * EXPONENT_SCALE;
    splats[3u * i] = vec4(u, v, l1, factor.y);
    splats[3u * i + 1u] = vec4(l3, log2_opacity, g.p.z, g.inv_z);
    splats[3u * i + 2u] = vec4(max(raw, vec3(0.0)), 0.0);
    depths[i] = bitcast<u32>(g.p.z);

    // Tiles: in each line of blocks, from the ellipse's leftmost to its rightmost point in that line.
    let hw = half_width * 1.0001 + SLACK;
    let hh = half_height * 1.0001 + SLACK;
    let columns = frame.image.z;
    let lines = frame.image.w / columns;
    let x0 = tile_of(u - hw - 0.5, columns);
    let x1 = tile_of(u + hw - 0.5, columns);
    let y0 = tile_of(v - hh - 0.5, lines);
    let y1 = tile_of(v + hh - 0.5, lines);
    let narrow = x0 == x1 || y0 == y1;
    var log2_width = 0u;
    while ((x1 - x0) >> log2_width) >= 8u {
        log2_width++;
    }
    var log2_height = 0u;
    while ((y1 - y0) >> log2_height) >= 4u {
        log2_height++;
    }
    // With the scaled conic the ellipse is (l1·(dx − shear·dy))² + (l3·dy)² <= reach. Its rightmost point is
    // at dy = peak, its leftmost at dy = −peak.
    let peak = g.cov.y / g.cov.x * half_width;
    var bits = 0u;
    for (var line = 0u; line <= (y1 - y0) >> log2_height; line++) {
        var first = x0;
        var last = x1;
        if !narrow {
            let upper = y0 + (line << log2_height);
            let lower = min(upper + (1u << log2_height) - 1u, y1);
            let top = max(f32(upper * TILE) + 0.5 - v, -hh);
            let bottom = min(f32(lower * TILE + TILE) - 0.5 - v, hh);
            let right_at = min(max(peak, top), bottom);
            let left_at = min(max(-peak, top), bottom);
            let right_half = sqrt(max(reach - (l3 * right_at) * (l3 * right_at), 0.0)) / l1;
            let left_half = sqrt(max(reach - (l3 * left_at) * (l3 * left_at), 0.0)) / l1;
            let right = min(factor.y * right_at + right_half, hw);
            let left = max(factor.y * left_at - left_half, -hw);
            first = max(tile_of(u + left - 1e-4 * abs(left) - SLACK - 0.5, columns), x0);
            last = min(tile_of(u + right + 1e-4 * abs(right) + SLACK - 0.5, columns), x1);
        }
        if first <= last {
            let from_bit = (first - x0) >> log2_width;
            let to_bit = (last - x0) >> log2_width;
            bits |= ((2u << to_bit) - (1u << from_bit)) << (8u * line);
        }
    }
    footprints[i] = vec4(x0 | x1 << 16u, y0 | y1 << 16u, bits, log2_width | log2_height << 16u);
}
