// Splats that all invocations of a tile have at hand, in shared memory. Subgroups that work by themselves
// do it otherwise (subgroups.wgsl).

var<workgroup> batch: array<vec4<f32>, 3u * BATCH>;

// Puts a splat among those at hand.
fn hold(i: u32, splat: Splat) {
    batch[3u * i] = splat.a;
    batch[3u * i + 1u] = splat.b;
    batch[3u * i + 2u] = splat.colour;
}

// Splat i at hand.
fn held(i: u32) -> Splat {
    return Splat(batch[3u * i], batch[3u * i + 1u], batch[3u * i + 2u]);
}
