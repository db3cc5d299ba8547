// Shared by the kernels that work tile by tile (rasterize, rasterize_bwd, observe and their atomic variants): their
// inputs, the pixels of an invocation, and the blending of a splat into these.
//
// One tile per group of 64 invocations. Each invocation has a square of four pixels, the components of a vec4: a
// splat is read once for all four, and their contributions to its sums are added in registers.

@group(0) @binding(1) var<storage, read_write> state: State;
@group(0) @binding(4) var<storage, read> tile_starts: array<u32>;
@group(0) @binding(5) var<storage, read> splats: array<f32>;

// Number of invocations of a tile.
const MEMBERS: u32 = 64u;

// Length of the longest record.
const FIELDS: u32 = 16u;

// True if depth may be in the loss.
override DEPTH_IN_LOSS: bool = false;

struct Splat {
    // Mean within the tile [px], l1, shear.
    a: vec4<f32>,
    // l3, log2 of the opacity, depth, inverse depth (if DEPTH_IN_LOSS is set).
    b: vec4<f32>,
    colour: vec4<f32>,
}

// The pixels of an invocation.
struct Quad {
    // First pixel of the tile in the image [px].
    corner: vec2<u32>,
    // Centres, relative to the tile's corner [px].
    x: vec4<f32>,
    y: vec4<f32>,
    // Indices in the image, for pixels inside the image.
    place: vec4<u32>,
    inside: vec4<bool>,
}

// True for a tile of the image that is in the current band, `launch.a`.
fn is_in_band(tile: u32) -> bool {
    return tile < frame.image.w && tile >= state.cuts[launch.a] && tile < state.cuts[launch.a + 1u];
}

// Records in `state` that a loop ended early: llvmpipe silently ends the loops of an invocation after
// 65,535 rounds in total. The results are then invalid, and the host reports it.
fn expect_end(completed: bool) {
    if !completed {
        state.broken_off = 1u;
    }
}

// Invocations with nearby indices have nearby pixels, so that invocations that run together rarely diverge.
fn quad_of(tile: u32, lane: u32) -> Quad {
    let corner = corner_of(tile);
    let x = ((lane & 1u) << 1u) | (lane & 4u) | ((lane >> 1u) & 8u);
    let y = (lane & 2u) | ((lane >> 1u) & 4u) | ((lane >> 2u) & 8u);
    let across = vec4(x) + vec4(0u, 1u, 0u, 1u);
    let down = vec4(y) + vec4(0u, 0u, 1u, 1u);
    let column = across + corner.x;
    let line = down + corner.y;
    return Quad(
        corner,
        vec4<f32>(across) + 0.5,
        vec4<f32>(down) + 0.5,
        line * frame.image.x + column,
        (column < vec4(frame.image.x)) & (line < vec4(frame.image.y)),
    );
}

// The splat of a row; `corner`: the tile's corner [px].
fn splat_of(row: u32, corner: vec2<u32>) -> Splat {
    let at = SPLAT * row;
    let mean = vec2(splats[at], splats[at + 1u]) - vec2<f32>(corner);
    let depth = splats[at + DEPTH];
    var inverse_depth = 0.0;
    if DEPTH_IN_LOSS {
        inverse_depth = 1.0 / depth;
    }
    return Splat(
        vec4(mean, splats[at + 2u], splats[at + 3u]),
        vec4(splats[at + 4u], splats[at + 5u], depth, inverse_depth),
        vec4(splats[at + 6u], splats[at + 7u], splats[at + 8u], 0.0),
    );
}

// A splat at the pixels: the pixels' whitened coordinates relative to the splat's mean, and log2 of its alpha there.
struct Falloff {
    u: vec4<f32>,
    z: vec4<f32>,
    exponent: vec4<f32>,
}

fn falloff(splat: Splat, quad: Quad) -> Falloff {
    let down = quad.y - splat.a.y;
    let u = splat.a.z * ((quad.x - splat.a.x) - splat.a.w * down);
    let z = splat.b.x * down;
    return Falloff(u, z, splat.b.y - u * u - z * z);
}

// The state of pixels from front to back: the transmittance, and whether they have not stopped yet.
struct ForwardPixels {
    light: vec4<f32>,
    unfinished: vec4<bool>,
}

// Blends a splat into the pixels and returns its weights; pixels that stop before it get 0.
fn blend(exponent: vec4<f32>, pixels: ptr<function, ForwardPixels>) -> vec4<f32> {
    let reached = (*pixels).unfinished & (exponent >= vec4(-LOG2_REACH));
    if !any(reached) {
        return vec4(0.0);
    }
    let light = (*pixels).light;
    let weight = min(exp2(exponent), vec4(ALPHA_MAX)) * light;
    let next = light - weight;
    let stops = reached & (next <= vec4(TRANSMITTANCE_MIN));
    let takes = reached & !stops;
    (*pixels).light = select(light, next, takes);
    (*pixels).unfinished = (*pixels).unfinished & !stops;
    return select(vec4(0.0), weight, takes);
}

// The sum of a value over the four pixels, always in the same order.
fn total(x: vec4<f32>) -> f32 {
    return (x.x + x.y) + (x.z + x.w);
}

fn largest(x: vec4<f32>) -> f32 {
    return max(max(x.x, x.y), max(x.z, x.w));
}
