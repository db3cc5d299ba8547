// The invocations of a tile share splats through shared memory. subgroups.wgsl replaces this file on
// devices with subgroups.

struct Member {
    place: u32,
    // As many as there are splats at hand at a time, at most.
    members: u32,
}

var<workgroup> batch: array<vec4<f32>, 3u * BATCH>;
var<workgroup> largest_found: atomic<u32>;
var<workgroup> largest_known: u32;

fn member(lane: u32) -> Member {
    return Member(lane, BATCH);
}

// Waits until all have come here.
fn meet() {
    workgroupBarrier();
}

// Whether an invocation must go on with the splats at hand, when it wants to or not.
fn is_needed(wants: bool) -> bool {
    return wants;
}

// The largest value of any of them; the splats at hand are no longer needed.
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

// Makes a row's splat the one at hand of a place; `corner`: of the tile.
fn hold(place: u32, row: u32, corner: vec2<u32>) {
    let splat = splat_of(row, corner);
    batch[3u * place] = splat.a;
    batch[3u * place + 1u] = splat.b;
    batch[3u * place + 2u] = splat.colour;
}

// Splat i at hand.
fn held(i: u32) -> Splat {
    return Splat(batch[3u * i], batch[3u * i + 1u], batch[3u * i + 2u]);
}
