// What both ways of differentiating a tile share (rasterize_bwd.wgsl, rasterize_bwd_atomic.wgsl): what
// they read, what happens at a pixel, and what the parameters need of it. src/backend/cpu/rasterize_bwd.rs
// tells why the sums are what they are.

@group(0) @binding(1) var<storage, read> state: State;
@group(0) @binding(2) var<storage, read> list: array<u32>;
@group(0) @binding(3) var<storage, read> row_of_slot: array<u32>;
@group(0) @binding(4) var<storage, read> tile_starts: array<u32>;
@group(0) @binding(5) var<storage, read> splats: array<vec4<f32>>;
@group(0) @binding(6) var<storage, read> finish: array<vec2<u32>>;
// dL/dpixel, plane after plane: red, green, blue, and alpha and depth where MORE is set.
@group(0) @binding(7) var<storage, read> gradient: array<f32>;

// Fields of a sum: 0: what training needs, 1: and the largest blend weight, 2: every field.
override DETAIL: u32 = 0u;
// Whether alpha and depth have gradients.
override MORE: bool = false;

// Splats at a time, and loaded at a time, at most.
const SPLATS: u32 = 4u;
const BATCH: u32 = 16u;
// Fields of the longest sum.
const FIELDS: u32 = 15u;

// Splats: mean within the tile, l1, shear | l3, log2 of the opacity, depth | colour.
var<workgroup> batch: array<vec4<f32>, 48>;
var<workgroup> last_stop: atomic<u32>;
var<workgroup> list_end: u32;

struct Upstream {
    rgb: vec3<f32>,
    alpha: f32,
    depth: f32,
}

// A pixel as it is behind the splat at hand: the light that is left there, and dL/d(what is seen).
struct Pixel {
    light: f32,
    behind: f32,
}

fn upstream(pixel: vec2<u32>) -> Upstream {
    var g = Upstream(vec3(0.0), 0.0, 0.0);
    if pixel.x < frame.image.x && pixel.y < frame.image.y {
        let size = frame.image.x * frame.image.y;
        let at = pixel.y * frame.image.x + pixel.x;
        g.rgb = vec3(gradient[at], gradient[size + at], gradient[2u * size + at]);
        if MORE {
            g.alpha = gradient[3u * size + at];
            g.depth = gradient[4u * size + at];
        }
    }
    return g;
}

fn fields() -> u32 {
    return select(select(9u, 10u, DETAIL == 1u), FIELDS, DETAIL == 2u);
}

// The field that is the largest of its values rather than their sum; none: NONE.
fn maximum() -> u32 {
    return select(select(NONE, 9u, DETAIL == 1u), 14u, DETAIL == 2u);
}

// Of how many splats, from the front, any pixel of the tile takes one; `stop`: of this invocation's.
fn taken_by_any(lane: u32, stop: u32) -> u32 {
    if lane == 0u {
        atomicStore(&last_stop, 0u);
    }
    workgroupBarrier();
    atomicMax(&last_stop, stop);
    workgroupBarrier();
    if lane == 0u {
        list_end = atomicLoad(&last_stop);
    }
    return workgroupUniformLoad(&list_end);
}

// Loads the splat of a row; `corner`: of the tile.
fn load(place: u32, row: u32, corner: vec2<u32>) {
    let a = splats[3u * row];
    batch[3u * place] = vec4(a.xy - vec2<f32>(corner), a.zw);
    batch[3u * place + 1u] = splats[3u * row + 1u];
    batch[3u * place + 2u] = splats[3u * row + 2u];
}

// q = α·dL/dα and w = α·T of a splat of the batch in a pixel, which is left as it is behind the next
// splat in front.
fn differentiated(
    i: u32,
    at: vec2<f32>,
    own: Upstream,
    pixel: ptr<function, Pixel>,
) -> vec2<f32> {
    var q = 0.0;
    var w = 0.0;
    let a = batch[3u * i];
    let b = batch[3u * i + 1u];
    let d = at - a.xy;
    let u = a.z * (d.x - a.w * d.y);
    let z = b.x * d.y;
    let e = b.y - u * u - z * z;
    if e >= -LOG2_REACH {
        let unclamped = exp2(e);
        let alpha = min(unclamped, ALPHA_MAX);
        (*pixel).light = (*pixel).light / (1.0 - alpha);
        w = alpha * (*pixel).light;
        var here = dot(batch[3u * i + 2u].xyz, own.rgb);
        if MORE {
            here += own.alpha + b.z * own.depth;
        }
        let ahead = here - (*pixel).behind;
        (*pixel).behind = (*pixel).behind + alpha * ahead;
        // No gradient where alpha is at its clamp.
        q = select(0.0, w * ahead, unclamped <= ALPHA_MAX);
    }
    return vec2(q, w);
}

// Adds to the sums of a splat of the batch what the parameters need of q and w of a pixel.
fn add_pixel(
    sums: ptr<function, array<f32, 15>>,
    i: u32,
    at: vec2<f32>,
    q: f32,
    w: f32,
    rgb: vec3<f32>,
    depth: f32,
) {
    let a = batch[3u * i];
    let l3 = batch[3u * i + 1u].x;
    let d = at - a.xy;
    let u = a.z * (d.x - a.w * d.y);
    let z = l3 * d.y;
    let qu = q * u;
    let qz = q * z;
    (*sums)[0] += q;
    (*sums)[1] += qu;
    (*sums)[2] += qz;
    (*sums)[3] += qu * u;
    (*sums)[4] += qu * z;
    (*sums)[5] += qz * z;
    (*sums)[6] += w * rgb.x;
    (*sums)[7] += w * rgb.y;
    (*sums)[8] += w * rgb.z;
    if DETAIL == 1u {
        (*sums)[9] = max((*sums)[9], w);
    }
    if DETAIL == 2u {
        (*sums)[9] += abs(qu);
        (*sums)[10] += abs(l3 * qz - a.z * a.w * qu);
        (*sums)[11] += w;
        (*sums)[12] += select(0.0, 1.0, w > 0.0);
        (*sums)[13] += w * depth;
        (*sums)[14] = max((*sums)[14], w);
    }
}
