// Sums over a tile's pixels that are added to those of rows at once, by atomics. slots.wgsl is the other
// way.
//
// Each subgroup of a tile works by itself, without shared memory or a barrier: it holds as many splats as
// it has invocations, one each, which they hand to one another; adds up what they find in their pixels;
// and adds that to the sums of the splat's row, one invocation per field. Subgroups may be of any size.

// An invocation among those of its subgroup, which are counted: sizes that drivers tell may be more than
// there are.
struct Member {
    place: u32,
    members: u32,
}

// To be called where none has left.
fn member() -> Member {
    return Member(subgroupExclusiveAdd(1u), subgroupAdd(1u));
}

// The splat of this invocation, and its row.
var<private> own_splat: Splat;
var<private> own_row: u32;

fn hold(row: u32, corner: vec2<u32>) {
    own_row = row;
    own_splat = splat_of(row, corner);
}

// The splat that the subgroup's ith holds.
fn held(i: u32) -> Splat {
    return Splat(
        subgroupShuffle(own_splat.a, i),
        subgroupShuffle(own_splat.b, i),
        subgroupShuffle(own_splat.colour, i),
    );
}

// Adds to the sums of the row of the ith's splat what the subgroup has found; `maximum`: the field that is
// the largest of its values, which are >= 0; none: NONE.
fn deliver(m: Member, i: u32, found: array<f32, FIELDS>, stride: u32, maximum: u32) {
    var sums = found;
    for (var f = 0u; f < stride; f++) {
        if f == maximum {
            sums[f] = subgroupMax(sums[f]);
        } else {
            sums[f] = subgroupAdd(sums[f]);
        }
    }
    let first = subgroupShuffle(own_row, i) * stride;
    for (var base = 0u; base < stride; base += m.members) {
        let mine = base + m.place;
        var sum = 0.0;
        for (var f = 0u; f < stride; f++) {
            sum = select(sum, sums[f], f == mine);
        }
        // NaN is none of 0.
        if mine < stride && sum != 0.0 {
            if mine == maximum {
                raise(first + mine, sum);
            } else {
                add(first + mine, sum);
            }
        }
    }
}
