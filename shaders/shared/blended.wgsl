// A splat's sums over the pixels of an auxiliary view, for observe.wgsl and observe_atomic.wgsl.

// Values (columns) per splat: sum of the pixel map, number of pixels, sum of blend weights, sum of distances from the
// mean [px], sum of blend weights in front of the surface, largest weight.
const COLUMNS: u32 = 6u;
// The value that is a maximum; the others are sums.
const MAXIMUM: u32 = 5u;

// What an invocation's pixels add to the sums; 0 outside the image.
struct MapPart {
    // The pixel map.
    value: vec4<f32>,
    // Depth below which a row is in front of the surface.
    front: vec4<f32>,
}

fn map_at(quad: Quad) -> MapPart {
    var here = MapPart(vec4(0.0), vec4(0.0));
    for (var p = 0u; p < 4u; p++) {
        if quad.inside[p] {
            here.value[p] = map[quad.place[p]];
            here.front[p] = map[frame.image.x * frame.image.y + quad.place[p]];
        }
    }
    return here;
}

// A splat's sums over an invocation's pixels.
fn splat_sums(
    splat: Splat,
    quad: Quad,
    map_here: MapPart,
    pixels: ptr<function, ForwardPixels>,
) -> array<f32, COLUMNS> {
    let w = blend(falloff(splat, quad).exponent, pixels);
    let x = quad.x - splat.a.x;
    let y = quad.y - splat.a.y;
    let one = select(vec4(0.0), vec4(1.0), w > vec4(0.0));
    let distance = total(one * sqrt(x * x + y * y));
    let in_front = select(vec4(0.0), w, vec4(splat.b.z) < map_here.front);
    return array(total(one * map_here.value), total(one), total(w), distance, total(in_front), largest(w));
}
