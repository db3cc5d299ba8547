// Sums over a tile's pixels, added with atomics to each row's sums: a subgroup (subgroups.wgsl) sums over
// its pixels, then adds the result to the sums of the splat's row, one invocation per field.
// slots.wgsl replaces this file if terms must be added in a fixed order.

// Adds the subgroup's contribution to the sums of loaded splat i's row; `maximum`: the field that holds
// the largest of its values, all >= 0, instead of their sum; NONE if there is no such field.
fn add_to_row(m: Member, i: u32, found: array<f32, FIELDS>, stride: u32, maximum: u32) {
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
        // NaN differs from 0, and is added.
        if mine < stride && sum != 0.0 {
            if mine == maximum {
                raise(first + mine, sum);
            } else {
                add(first + mine, sum);
            }
        }
    }
}
