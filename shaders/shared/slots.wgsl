// Sums over a tile's pixels, written to one record per entry, in its slot. Each invocation stores the
// sums over its four pixels in shared memory; these are added in the same order on every
// device. Four splats share two barriers. atomics.wgsl replaces this file if gradients are added by
// atomics.

// Number of splats summed per round, and maximum number of splats loaded at a time.
const SPLATS: u32 = 4u;
const BATCH: u32 = 8u;

// Half of the invocations. Compilers unroll a loop of this many rounds. They must, because the number of
// rounds is limited (see expect_end), and a tile of 3,000 splats would exceed the limit.
const ROUND: u32 = 32u;
// Distance from the parts of one sum to those of the next: one more than there are parts, so that
// invocations that add different sums read different memory banks.
const PITCH: u32 = 65u;

// Element n·PITCH + lane: the part of sum n from invocation `lane`.
var<workgroup> parts: array<f32, 3900>;
// Slots of the loaded splats.
var<workgroup> slots: array<u32, BATCH>;

// Loads the `count` splats that start at `from_entry` in the list; to be called by all invocations.
fn load_batch(from_entry: u32, count: u32, lane: u32, corner: vec2<u32>) {
    wait_for_all();
    if lane < count {
        let slot = list[from_entry + lane];
        slots[lane] = slot;
        load_splat(lane, row_of_slot[slot], corner);
    }
    wait_for_all();
}

// Stores an invocation's part of sum n.
fn store_part(n: u32, lane: u32, x: f32) {
    parts[n * PITCH + lane] = x;
}

// ROUND parts, added in order to `given`; or, for a maximum, the largest of these parts and `given`.
fn reduced(given: f32, first: u32, is_maximum: bool) -> f32 {
    var sum = given;
    for (var i = 0u; i < ROUND; i++) {
        let x = parts[first + i];
        sum = select(sum + x, max(sum, x), is_maximum);
    }
    return sum;
}

// The sum of all parts of sum n, or the largest of them.
fn summed(n: u32, is_maximum: bool) -> f32 {
    let half = reduced(0.0, n * PITCH, is_maximum);
    return reduced(half, n * PITCH + ROUND, is_maximum);
}
