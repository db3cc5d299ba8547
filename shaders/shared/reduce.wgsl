// The sum over a group. A module defines `Summand`, and ADDERS, its number of invocations, a power of two.

var<workgroup> reduced: array<Summand, ADDERS>;

// The sum of `reduced`; valid in the first invocation.
fn reduced_sum(lane: u32) -> Summand {
    workgroupBarrier();
    for (var half = ADDERS / 2u; half > 0u; half /= 2u) {
        if lane < half {
            reduced[lane] += reduced[lane + half];
        }
        workgroupBarrier();
    }
    return reduced[0];
}
