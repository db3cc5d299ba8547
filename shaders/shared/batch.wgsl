// The invocations of a tile share splats through shared memory. subgroups.wgsl replaces this file on
// devices with subgroups.

struct Member {
    place: u32,
    // Number of splats loaded at a time.
    members: u32,
}

var<workgroup> batch: array<vec4<f32>, 3u * BATCH>;
var<workgroup> largest_found: atomic<u32>;
var<workgroup> largest_known: u32;

fn member(lane: u32) -> Member {
    return Member(lane, BATCH);
}

// Waits for all invocations of the group.
fn wait_for_all() {
    workgroupBarrier();
}

// True if an invocation must process more of the loaded splats; `wants`: true if its own pixels need them.
fn is_needed(wants: bool) -> bool {
    return wants;
}

// The largest value in the group; overwrites the loaded splats.
fn largest_of_all(m: Member, x: u32) -> u32 {
    if m.place == 0u {
        atomicStore(&largest_found, 0u);
    }
    workgroupBarrier();
    atomicMax(&largest_found, x);
    workgroupBarrier();
    if m.place == 0u {
        largest_known = atomicLoad(&largest_found);
    }
    return workgroupUniformLoad(&largest_known);
}

// Loads a row's splat to index `place`; `corner`: the tile's corner [px].
fn load_splat(place: u32, row: u32, corner: vec2<u32>) {
    let splat = splat_of(row, corner);
    batch[3u * place] = splat.a;
    batch[3u * place + 1u] = splat.b;
    batch[3u * place + 2u] = splat.colour;
}

// Loaded splat i.
fn loaded_splat(i: u32) -> Splat {
    return Splat(batch[3u * i], batch[3u * i + 1u], batch[3u * i + 2u]);
}
