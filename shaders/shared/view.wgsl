// Shared by all stages: the view and the settings of a step (a uniform buffer), scalars that stay on
// the device (a storage buffer), the parameters of a dispatch, and e^x.

struct Frame {
    // Rows of camera_from_world's rotation; w: its translation.
    rotation: array<vec4<f32>, 3>,
    // The camera's centre; w: near plane.
    centre: vec4<f32>,
    // Focal lengths, principal point [px].
    lens: vec4<f32>,
    // Smallest and largest x/z, y/z in J: (x, y, x, y).
    ratio: vec4<f32>,
    // The background's colour; w: depth from which gradient signals have full weight.
    background: vec4<f32>,
    // Width, height [px], number of tile columns, number of tiles.
    image: vec4<u32>,
    // Number of rows, current SH degree, cap on tile entries, maximum number of rows that are not frozen.
    model: vec4<u32>,
    // Step sizes: mean, log-scale, quaternion, opacity.
    rates: vec4<f32>,
    // Step sizes of band 0 and of bands 1-3; derivative of the opacity and of the scale term per row.
    more_rates: vec4<f32>,
    // The noise term: strength times step size, sharpness, opacity at which the noise is halved.
    noise: vec4<f32>,
    // The combination of errors into a score: exponent of a pixel's error, weight of edges, exponents of
    // the sum of weights and of a view's score.
    score: vec4<f32>,
    // Weights of |e| and of 1 − SSIM in the error of a pixel: for candidates, then for row scores.
    errors: vec4<f32>,
    // Seed, step, flags of the optimiser (see adam.wgsl), flags of the loss (see loss.wgsl).
    draw: vec4<u32>,
    // Number of frozen rows: they come first, never change, and have no entries in the arrays used only
    // for training. Then bits of f32 about given depth (depth_gradient.wgsl): the unit of its inverse and its
    // median [scene units], and the gradient of alpha as a multiple of that of depth.
    frozen: vec4<u32>,
    // Plane that accumulates each signal in this step; NONE if the signal is not requested.
    planes: array<vec4<u32>, 8>,
}

struct State {
    // Number of rows on screen.
    visible: u32,
    // Number of entries of the whole image, saturated at 2^30.
    total: u32,
    // Number of bands that the image needs.
    bands: u32,
    // 1: more bands are needed than were encoded; no kernel that changes rows is then dispatched.
    short: u32,
    // Number of entries of all bands, in 64 bits.
    entries_low: u32,
    entries_high: u32,
    // Number of entries of the current band.
    held: u32,
    // 1: a loop over a tile's splats has ended too early, in this step or an earlier one.
    broken_off: u32,
    // Means over pixels and channels.
    l1: f32,
    ssim: f32,
    // The depth term of the loss, without its weight.
    depth: f32,
    spare_f: f32,
    // Band b consists of the tiles cuts[b]..cuts[b + 1].
    cuts: array<u32>,
}

// Parameters that differ between dispatches of one kernel.
struct Launch {
    a: u32,
    b: u32,
    c: u32,
    d: u32,
}

@group(0) @binding(0) var<uniform> frame: Frame;
var<immediate> launch: Launch;

const NONE: u32 = 0xffffffffu;
const TILE: u32 = 16u;
const GROUP: u32 = 256u;

// Bits of frame.draw.w that concern depth (loss.wgsl has the others): the forward pass accumulates inverse depth; or,
// where depth is given, its distance from that; depth is given.
const INVERSE_DEPTH: u32 = 32u;
const DEPTH_DISTANCES: u32 = 64u;
const GIVEN_DEPTH: u32 = 128u;

// Blending: the largest alpha; the transmittance at which a pixel stops; the smallest alpha, and −log2
// of it. All but the first are settings.
const ALPHA_MAX: f32 = 0.99;
override TRANSMITTANCE_MIN: f32 = 1e-4;
override ALPHA_MIN: f32 = 1.0 / 255.0;
override LOG2_REACH: f32 = 7.9943534;

// Workgroups in the first of two dimensions, each of which has at most 65,535 of them. This is a
// constant because an indirect dispatch on DX12 does not provide the number.
const ACROSS: u32 = 32768u;

// The number of a workgroup; `id` is its workgroup_id.
fn group_of(id: vec3<u32>) -> u32 {
    return id.x + id.y * ACROSS;
}

// The number of an invocation in a kernel of groups of GROUP; `id` is its global_invocation_id.
fn index_of(id: vec3<u32>) -> u32 {
    return id.x + id.y * ACROSS * GROUP;
}

// Where a tile begins in the image [px].
fn corner_of(tile: u32) -> vec2<u32> {
    return vec2(tile % frame.image.z, tile / frame.image.z) * TILE;
}

// |x| <= most; false for NaN and infinity. Compares bits, since WGSL may assume that there is no NaN.
fn below(x: f32, most: f32) -> bool {
    return (bitcast<u32>(x) & 0x7fffffffu) <= bitcast<u32>(most);
}

const LARGEST: f32 = 3.4028234e38;

const LOG2_E: f32 = 1.44269504;

// e^x, x clamped to [-87, 88]; relative error below 2e-7; a device's own function may be less accurate.
fn exp_exact(wide: f32) -> f32 {
    let x = clamp(wide, -87.0, 88.0);
    let n = round(x * LOG2_E);
    // ln 2 in two parts (Cody and Waite): the first has few bits, so its product with n is exact.
    let f = fma(-n, 1.4286068e-6, fma(-n, 0.69314575, x));
    var p = fma(1.984127e-4, f, 1.3888889e-3);
    p = fma(p, f, 8.333334e-3);
    p = fma(p, f, 4.1666666e-2);
    p = fma(p, f, 1.6666667e-1);
    p = fma(p, f, 0.5);
    p = fma(p, f, 1.0);
    p = fma(p, f, 1.0);
    return bitcast<f32>(bitcast<u32>(p) + (bitcast<u32>(i32(n)) << 23u));
}

// The logistic function; use sigmoid(−x) for 1 − sigmoid(x), without cancellation.
fn sigmoid(x: f32) -> f32 {
    let e = exp_exact(-abs(x));
    return select(e, 1.0, x >= 0.0) / (1.0 + e);
}
