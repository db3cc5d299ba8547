// The invocations of a subgroup share splats, without shared memory or barriers: each loads one splat
// and broadcasts it to the others. batch.wgsl replaces this file on devices without subgroups.

// The index of an invocation in its subgroup, and the size of the subgroup. Invocations are counted,
// since the size that drivers report may be too large.
struct Member {
    place: u32,
    members: u32,
}

// A rectangle of pixels: its first and last centres, relative to the tile's corner [px].
struct Block {
    low: vec2<f32>,
    high: vec2<f32>,
}

// The bounding rectangle of the subgroup's pixels. To be called while all invocations are active.
fn block_of(quad: Quad) -> Block {
    return Block(
        vec2(subgroupMin(quad.x.x), subgroupMin(quad.y.x)),
        vec2(subgroupMax(quad.x.w), subgroupMax(quad.y.w)),
    );
}

// True if a splat may reach a pixel of the block, judged by its ellipse's bounding box. The box is
// widened, so that rounding loses no splat, and a box with NaN counts as reaching the block.
fn may_reach(splat: Splat, block: Block) -> bool {
    let radius = sqrt(max(splat.b.y + LOG2_REACH, 0.0));
    let down = radius / splat.b.x;
    let across = radius * length(vec2(1.0 / splat.a.z, splat.a.w / splat.b.x));
    let half = 1.001 * vec2(across, down) + 0.01;
    return !(any(splat.a.xy + half < block.low) || any(splat.a.xy - half > block.high));
}

// The splat that this invocation has loaded, and its row.
var<private> own_splat: Splat;
var<private> own_row: u32;

// To be called before any invocation has ended.
fn member(lane: u32) -> Member {
    return Member(subgroupExclusiveAdd(1u), subgroupAdd(1u));
}

// A subgroup runs in step and need not wait.
fn wait_for_all() {
}

// True if an invocation must process more of the loaded splats: others may need the one that it has loaded.
fn is_needed(wants: bool) -> bool {
    return subgroupAny(wants);
}

// The largest value in the subgroup.
fn largest_of_all(m: Member, x: u32) -> u32 {
    return subgroupMax(x);
}

// Loads a row's splat to index `place`, which is this invocation's; `corner`: the tile's corner [px].
fn load_splat(place: u32, row: u32, corner: vec2<u32>) {
    own_row = row;
    own_splat = splat_of(row, corner);
}

// Loaded splat i.
fn loaded_splat(i: u32) -> Splat {
    return Splat(
        subgroupShuffle(own_splat.a, i),
        subgroupShuffle(own_splat.b, i),
        subgroupShuffle(own_splat.colour, i),
    );
}
