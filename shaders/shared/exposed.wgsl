// The exposure of the current photograph: three rows of a matrix, each followed by its channel's offset; then the
// background of the photograph.
@group(0) @binding(2) var<storage, read> exposure: array<vec4<f32>>;

fn exposed_colour(rendered: vec3<f32>) -> vec3<f32> {
    let colour = vec4(rendered, 1.0);
    return vec3(dot(exposure[0], colour), dot(exposure[1], colour), dot(exposure[2], colour));
}
