// A splat's sums over the pixels of an auxiliary view, for observe.wgsl and observe_atomic.wgsl.

// Values (columns) per splat: sum of the pixel map, number of pixels, sum of blend weights, sum of distances from the
// mean [px], largest weight.
const COLUMNS: u32 = 5u;
// The value that is a maximum; the others are sums.
const MAXIMUM: u32 = 4u;

// The pixel map at an invocation's pixels; 0 outside the image.
fn map_at(quad: Quad) -> vec4<f32> {
    var here = vec4(0.0);
    for (var p = 0u; p < 4u; p++) {
        if quad.inside[p] {
            here[p] = map[quad.place[p]];
        }
    }
    return here;
}

// A splat's sums over an invocation's pixels.
fn splat_sums(
    splat: Splat,
    quad: Quad,
    map_here: vec4<f32>,
    pixels: ptr<function, ForwardPixels>,
) -> array<f32, COLUMNS> {
    let w = blend(falloff(splat, quad).exponent, pixels);
    let x = quad.x - splat.a.x;
    let y = quad.y - splat.a.y;
    let one = select(vec4(0.0), vec4(1.0), w > vec4(0.0));
    let distance = total(one * sqrt(x * x + y * y));
    return array(total(one * map_here), total(one), total(w), distance, largest(w));
}
