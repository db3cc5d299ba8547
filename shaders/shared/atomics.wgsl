// Sums over a tile's pixels that are added to those of rows at once, by atomics: a subgroup (subgroups.wgsl)
// adds up what it finds in its pixels, and adds that to the sums of the splat's row, one invocation per
// field. slots.wgsl replaces this file where sums must have a
// fixed order.

// Adds to the sums of the row of splat i at hand what the subgroup has found; `maximum`: the field that is
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
