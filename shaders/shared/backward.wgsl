// The backward pass of one splat over a tile's pixels, for rasterize_bwd.wgsl and rasterize_bwd_atomic.wgsl.
// src/render/cpu/rasterize_bwd.rs derives the sums.

@group(0) @binding(6) var<storage, read> finish: array<vec2<u32>>;
// Planes of dL/dpixel: red, green, blue, and, if MORE is set, alpha and depth. If MORE is not set, a plane of
// the pixels' errors follows, provided that records have a sum of errors.
@group(0) @binding(7) var<storage, read> pixel_gradient: array<f32>;

// True if alpha and depth have gradients.
override MORE: bool = false;

// dL/dpixel of an invocation's pixels; 0 outside the image.
struct Upstream {
    red: vec4<f32>,
    green: vec4<f32>,
    blue: vec4<f32>,
    alpha: vec4<f32>,
    error: vec4<f32>,
    // The channel of depth: centre, and factors of the distance from it and of its square.
    centre: vec4<f32>,
    depth: vec4<f32>,
    square: vec4<f32>,
}

// The state of the pixels behind the current splat: the transmittance there, the product of dL/dpixel with the colour
// seen there, and the index in the list at which the pixels stopped.
struct BackwardPixels {
    light: vec4<f32>,
    seen: vec4<f32>,
    stop: vec4<u32>,
}

fn plane(n: u32, quad: Quad) -> vec4<f32> {
    let first = n * frame.image.x * frame.image.y;
    var g = vec4(0.0);
    for (var p = 0u; p < 4u; p++) {
        if quad.inside[p] {
            g[p] = pixel_gradient[first + quad.place[p]];
        }
    }
    return g;
}

fn upstream(quad: Quad) -> Upstream {
    let zero = vec4(0.0);
    var g = Upstream(plane(0u, quad), plane(1u, quad), plane(2u, quad), zero, zero, zero, zero, zero);
    if MORE {
        g.alpha = plane(3u, quad);
        g.depth = plane(4u, quad);
        return g;
    }
    if ERROR_AT > 0u {
        g.error = plane(3u, quad);
    }
    if DEPTH_AT > 0u && (frame.draw.w & INVERSE_DEPTH) != 0u {
        // See depth_gradient.wgsl.
        for (var p = 0u; p < 4u; p++) {
            if quad.inside[p] {
                let at = frame.image.x * frame.image.y + quad.place[p];
                let channel = bitcast<vec2<f32>>(finish[at]);
                let is_square = channel.x < 0.0;
                g.centre[p] = abs(channel.x);
                g.depth[p] = select(channel.y, 0.0, is_square);
                g.square[p] = select(0.0, channel.y, is_square);
            }
        }
        g.alpha = bitcast<f32>(frame.frozen.w) * g.depth;
    }
    return g;
}

// The state of the pixels behind all splats of a list.
fn behind_all(quad: Quad, own: Upstream, length: u32) -> BackwardPixels {
    let b = frame.background;
    let seen = own.red * b.x + own.green * b.y + own.blue * b.z;
    var pixels = BackwardPixels(vec4(1.0), seen, vec4(0u));
    for (var p = 0u; p < 4u; p++) {
        if quad.inside[p] {
            let finished = finish[quad.place[p]];
            pixels.light[p] = bitcast<f32>(finished.x);
            pixels.stop[p] = min(finished.y, length);
        }
    }
    return pixels;
}

// The field of a record that is a maximum instead of a sum; NONE if there is no such field.
fn maximum() -> u32 {
    return select(NONE, WEIGHT_MAX_AT, WEIGHT_MAX_AT > 0u);
}

// The number of splats, from the front, that are needed until all pixels have stopped.
fn splats_needed(pixels: BackwardPixels) -> u32 {
    return max(max(pixels.stop.x, pixels.stop.y), max(pixels.stop.z, pixels.stop.w));
}

// Computes the sums over the pixels from which the gradients of splat n of the list follow, with q = α·dL/dα
// and w = α·T; updates the state for the next splat in front. Returns false if the splat is blended into
// none of the pixels.
fn backpropagate(
    splat: Splat,
    n: u32,
    quad: Quad,
    own: Upstream,
    pixels: ptr<function, BackwardPixels>,
    sums: ptr<function, array<f32, FIELDS>>,
) -> bool {
    let at = falloff(splat, quad);
    let takes = (vec4(n) < (*pixels).stop) & (at.exponent >= vec4(-LOG2_REACH));
    if !any(takes) {
        return false;
    }
    let unclamped = exp2(at.exponent);
    let alpha = select(vec4(0.0), min(unclamped, vec4(ALPHA_MAX)), takes);
    (*pixels).light = (*pixels).light / (1.0 - alpha);
    let w = alpha * (*pixels).light;
    let rgb = splat.colour;
    var here = rgb.x * own.red + rgb.y * own.green + rgb.z * own.blue;
    // The derivative of the channel of depth, per pixel.
    var by_depth = vec4(0.0);
    if DEPTH_AT > 0u {
        let x = select(splat.b.w, splat.b.z, MORE) - own.centre;
        let takes_distance = (frame.draw.w & DEPTH_DISTANCES) != 0u;
        let slope = select(own.depth, -own.depth, (x < vec4(0.0)) & vec4(takes_distance));
        let chord = slope + own.square * x;
        here += own.alpha + x * chord;
        by_depth = chord + own.square * x;
    }
    let ahead = here - (*pixels).seen;
    (*pixels).seen = select((*pixels).seen, (*pixels).seen + alpha * ahead, takes);
    // No gradient where alpha is at its clamp.
    let q = select(vec4(0.0), w * ahead, takes & (unclamped <= vec4(ALPHA_MAX)));

    let qu = q * at.u;
    let qz = q * at.z;
    (*sums)[0] = total(q);
    (*sums)[1] = total(qu);
    (*sums)[2] = total(qz);
    (*sums)[3] = total(qu * at.u);
    (*sums)[4] = total(qu * at.z);
    (*sums)[5] = total(qz * at.z);
    (*sums)[6] = total(w * own.red);
    (*sums)[7] = total(w * own.green);
    (*sums)[8] = total(w * own.blue);
    if ABS_X_AT > 0u {
        (*sums)[ABS_X_AT] = total(abs(qu));
    }
    if ABS_Y_AT > 0u {
        let a = splat.a;
        let l3 = splat.b.x;
        (*sums)[ABS_Y_AT] = total(abs(l3 * qz - a.z * a.w * qu));
    }
    if WEIGHT_SUM_AT > 0u {
        (*sums)[WEIGHT_SUM_AT] = total(w);
    }
    if PIXEL_COUNT_AT > 0u {
        (*sums)[PIXEL_COUNT_AT] = total(select(vec4(0.0), vec4(1.0), w > vec4(0.0)));
    }
    if DEPTH_AT > 0u {
        // d(1/z)/dz = −1/z².
        (*sums)[DEPTH_AT] = total(w * by_depth) * select(-splat.b.w * splat.b.w, 1.0, MORE);
    }
    if ERROR_AT > 0u {
        (*sums)[ERROR_AT] = total(w * own.error);
    }
    if WEIGHT_MAX_AT > 0u {
        (*sums)[WEIGHT_MAX_AT] = largest(w);
    }
    return true;
}
