// The invocations of a subgroup share splats, without shared memory or barriers: each holds one splat
// and passes it to the others. batch.wgsl replaces this file on devices without subgroups.

// An invocation among those of its subgroup, which may be of any size. They are counted, as sizes that
// drivers tell may be more than there are.
struct Member {
    place: u32,
    members: u32,
}

// A rectangle of pixels: its first and last centres, from the corner of the tile [px].
struct Block {
    low: vec2<f32>,
    high: vec2<f32>,
}

// The pixels of the subgroup. To be called while all of them are there.
fn block_of(quad: Quad) -> Block {
    return Block(
        vec2(subgroupMin(quad.x.x), subgroupMin(quad.y.x)),
        vec2(subgroupMax(quad.x.w), subgroupMax(quad.y.w)),
    );
}

// Whether a splat may reach into a block, by the box around its ellipse, which is widened so that none is
// lost to rounding. Nor is one whose box has no numbers: nothing compares with them.
fn may_reach(splat: Splat, block: Block) -> bool {
    let radius = sqrt(max(splat.b.y + LOG2_REACH, 0.0));
    let down = radius / splat.b.x;
    let across = radius * length(vec2(1.0 / splat.a.z, splat.a.w / splat.b.x));
    let half = 1.001 * vec2(across, down) + 0.01;
    return !(any(splat.a.xy + half < block.low) || any(splat.a.xy - half > block.high));
}

// The splat of this invocation, and its row.
var<private> own_splat: Splat;
var<private> own_row: u32;

// To be called before any of them has ended.
fn member(lane: u32) -> Member {
    return Member(subgroupExclusiveAdd(1u), subgroupAdd(1u));
}

// They go in step.
fn meet() {
}

// Whether an invocation must go on with the splats at hand, when it wants to or not: others need its own.
fn is_needed(wants: bool) -> bool {
    return subgroupAny(wants);
}

// The largest that any of them has.
fn largest_of_all(m: Member, x: u32) -> u32 {
    return subgroupMax(x);
}

// Makes a row's splat the one at hand of a place, which is this invocation's; `corner`: of the tile.
fn hold(place: u32, row: u32, corner: vec2<u32>) {
    own_row = row;
    own_splat = splat_of(row, corner);
}

// Splat i at hand.
fn held(i: u32) -> Splat {
    return Splat(
        subgroupShuffle(own_splat.a, i),
        subgroupShuffle(own_splat.b, i),
        subgroupShuffle(own_splat.colour, i),
    );
}
