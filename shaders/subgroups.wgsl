// Sums over a tile's pixels that are added to those of rows at once, by atomics: first within a
// subgroup, then over the subgroups of the tile, then one atomic for each field of each splat. Subgroups
// may be of any size, and are numbered here: how drivers number them is not relied upon.
//
// Barriers: three for up to sixteen splats, fewer where subgroups are small and their parts many.

// What each subgroup has found: of splat k, subgroup s, field f at (k·subgroups + s)·stride + f.
var<workgroup> parts: array<f32, PARTS>;
// Of the splats at hand.
var<workgroup> rows: array<u32, BATCH>;
var<workgroup> numbered: atomic<u32>;
var<workgroup> subgroups: u32;

// Splats at a time, at most.
const BATCH: u32 = 16u;
// Room for the longest sum, of fifteen fields, from as many subgroups as there are invocations; where
// subgroups are of 32, for that of 32 splats.
const PARTS: u32 = 960u;
// Parts that are added in one round of a loop, which compilers unroll; slots.wgsl says why.
const ROUND: u32 = 8u;

// An invocation among the others of its tile.
struct Member {
    // Whether it is the one that speaks for its subgroup.
    is_first: bool,
    // The number of its subgroup, and how many there are.
    subgroup: u32,
    subgroups: u32,
}

fn member(lane: u32) -> Member {
    if lane == 0u {
        atomicStore(&numbered, 0u);
    }
    workgroupBarrier();
    let is_first = subgroupExclusiveAdd(1u) == 0u;
    var number = 0u;
    if is_first {
        number = atomicAdd(&numbered, 1u);
    }
    number = subgroupBroadcastFirst(number);
    workgroupBarrier();
    if lane == 0u {
        subgroups = atomicLoad(&numbered);
    }
    return Member(is_first, number, workgroupUniformLoad(&subgroups));
}

// Splats at a time for which there is room, of so many fields each.
fn room(m: Member, stride: u32) -> u32 {
    return clamp(PARTS / (m.subgroups * stride), 1u, BATCH);
}

// Adds the parts of `count` splats to the sums of their rows: one invocation per field of each. The
// field `maximum` is the largest of its values; they are >= 0.
fn deliver(m: Member, lane: u32, count: u32, stride: u32, maximum: u32) {
    for (var n = lane; n < count * stride; n += MEMBERS) {
        let k = n / stride;
        let f = n % stride;
        let is_maximum = f == maximum;
        var sum = 0.0;
        for (var base = 0u; base < m.subgroups; base += ROUND) {
            for (var i = 0u; i < ROUND; i++) {
                let s = base + i;
                if s < m.subgroups {
                    let x = parts[(k * m.subgroups + s) * stride + f];
                    sum = select(sum + x, max(sum, x), is_maximum);
                }
            }
        }
        // NaN is none of 0.
        if sum != 0.0 {
            let at = rows[k] * stride + f;
            if is_maximum {
                raise(at, sum);
            } else {
                add(at, sum);
            }
        }
    }
}
