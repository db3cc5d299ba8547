// The direction of a row from the camera.

// Unit vector from the camera to the mean; w: 1/distance. All are 0 if camera and mean coincide.
fn direction(mean: vec3<f32>) -> vec4<f32> {
    let v = mean - frame.centre.xyz;
    let norm2 = dot(v, v);
    // Below this the square loses precision; the direction is then undefined and its gradient 0.
    if norm2 > 1e-30 {
        let inv = 1.0 / sqrt(norm2);
        return vec4(v * inv, inv);
    }
    return vec4(0.0);
}
