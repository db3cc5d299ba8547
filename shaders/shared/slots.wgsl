// Sums over a tile's pixels, written to one record per entry in its slot. What each invocation finds in
// its four pixels is stored in shared memory and added in a fixed order, the same on every device; four
// splats share two barriers. atomics.wgsl replaces this file where gradients are added by atomics.

// Splats at a time, and loaded at a time, at most.
const SPLATS: u32 = 4u;
const BATCH: u32 = 8u;

// Half of the invocations. So many rounds of a loop compilers unroll, and it matters: rounds are counted
// (expect_end), and a tile of 3,000 splats would have too many otherwise.
const ROUND: u32 = 32u;
// Numbers from one sum's parts to the next one's: one more than there are, so that those that add up
// different sums read different banks.
const PITCH: u32 = 65u;

// Part n·PITCH + lane: of sum n, found by an invocation.
var<workgroup> parts: array<f32, 3900>;
// Of the splats at hand.
var<workgroup> slots: array<u32, BATCH>;

// Makes the next `count` splats, from one in the list on, those at hand; to be called by all.
fn take_batch(from_entry: u32, count: u32, lane: u32, corner: vec2<u32>) {
    meet();
    if lane < count {
        let slot = list[from_entry + lane];
        slots[lane] = slot;
        hold(lane, row_of_slot[slot], corner);
    }
    meet();
}

// What an invocation has found for sum n.
fn put_part(n: u32, lane: u32, x: f32) {
    parts[n * PITCH + lane] = x;
}

// ROUND parts in order, added to what is given, or the largest of all.
fn reduced(given: f32, first: u32, is_maximum: bool) -> f32 {
    var sum = given;
    for (var i = 0u; i < ROUND; i++) {
        let x = parts[first + i];
        sum = select(sum + x, max(sum, x), is_maximum);
    }
    return sum;
}

// Sum n of all parts, or their maximum.
fn summed(n: u32, is_maximum: bool) -> f32 {
    let half = reduced(0.0, n * PITCH, is_maximum);
    return reduced(half, n * PITCH + ROUND, is_maximum);
}
