// Stage 2: from splats to tile lists, as in src/render/cpu/tiles.rs. The rows on screen are sorted by depth,
// their entries emitted in that order, and the entries sorted by tile with a stable sort: each tile's
// list is then sorted by depth, and by row where depths are equal. project.wgsl has stored each row's
// footprint in integers, so counting entries and emitting them cannot disagree.
//
// Prefix sums and sorts are exact and have a fixed order: no result depends on timing. Lists hold rows; if gradients
// are accumulated in slots, they hold slots instead. An entry's slot is its index before the sort: the slots of a row
// are contiguous, in the order of its tiles.
//
// One file, because counting, emitting and sorting share the state and the counters.

@group(0) @binding(1) var<storage, read_write> state: State;
// Workgroup counts of indirect dispatches, three numbers each; see ARGS_*.
@group(0) @binding(2) var<storage, read_write> groups: array<u32>;
// See splat.wgsl and footprint.wgsl.
@group(0) @binding(3) var<storage, read> splats: array<f32>;
@group(0) @binding(4) var<storage, read> footprints: array<vec2<u32>>;
// Only read. Writable, because they may be ranges of the buffer that keys_out and values_out are in.
@group(0) @binding(5) var<storage, read_write> keys_in: array<u32>;
@group(0) @binding(6) var<storage, read_write> values_in: array<u32>;
@group(0) @binding(7) var<storage, read_write> keys_out: array<u32>;
@group(0) @binding(8) var<storage, read_write> values_out: array<u32>;
// Numbers to sum, then their prefix sums: within their block of 2,048, or, of a sort's digits, over all blocks.
@group(0) @binding(9) var<storage, read_write> sums: array<u32>;
// Prefix sums over the blocks, or, in a sort, the total of each digit.
@group(0) @binding(10) var<storage, read_write> block_sums: array<u32>;
// Rows on screen, front to back.
@group(0) @binding(11) var<storage, read> order: array<u32>;
@group(0) @binding(13) var<storage, read_write> tile_starts: array<u32>;
@group(0) @binding(14) var<storage, read_write> tile_counts: array<atomic<u32>>;

// Items per workgroup and per invocation in prefix sums.
const BLOCK: u32 = 2048u;
const EACH: u32 = 8u;
// Prefix sums saturate at this number, which is beyond any cap.
const MOST: u32 = 0x40000000u;

// Indices in `groups`. The entries of a band in blocks of the sort.
const ARGS_ENTRIES: u32 = 0u;
// The kernels that change rows: by row, then those of the bands of colour.
const ARGS_STEP: u32 = 3u;
const ARGS_BANDS: u32 = 6u;

// The entries to count (launch.a of scan_blocks and scan_sums). COUNTS_AGAIN: those of a band that the total already
// includes.
const COUNTS_ALL: u32 = 0u;
const COUNTS_BAND: u32 = 1u;
const COUNTS_AGAIN: u32 = 2u;

fn ceil_div(a: u32, b: u32) -> u32 {
    return (a + b - 1u) / b;
}

fn set_groups(at: u32, count: u32) {
    groups[at] = min(count, ACROSS);
    groups[at + 1u] = ceil_div(count, ACROSS);
    groups[at + 2u] = 1u;
}

// Decides if the step changes the model: not if it needs more bands than were encoded.
fn conclude_bands(fits: bool) {
    state.short = select(1u, 0u, fits);
    let rows = select(0u, frame.model.x, fits);
    set_groups(ARGS_STEP, ceil_div(rows, GROUP));
    for (var band = 0u; band < 4u; band++) {
        let pairs = (3u * (2u * band + 1u) + 1u) / 2u;
        set_groups(ARGS_BANDS + 3u * band, ceil_div(rows * pairs, GROUP));
    }
}

// --- Prefix sums --------------------------------------------------------------------------------

var<workgroup> partial: array<u32, 256>;

fn saturating(a: u32, b: u32) -> u32 {
    return min(a + b, MOST);
}

// The sum of the values of the preceding invocations; the total is then in partial[255].
fn sum_before(lane: u32, value: u32) -> u32 {
    partial[lane] = value;
    workgroupBarrier();
    for (var step = 1u; step < GROUP; step *= 2u) {
        var sum = partial[lane];
        if lane >= step {
            sum = saturating(sum, partial[lane - step]);
        }
        workgroupBarrier();
        partial[lane] = sum;
        workgroupBarrier();
    }
    var before = 0u;
    if lane > 0u {
        before = partial[lane - 1u];
    }
    return before;
}

// Prefix sums of the entries of each row, by blocks.
@compute @workgroup_size(256)
fn scan_blocks(
    @builtin(workgroup_id) id: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let block = group_of(id);
    let first = block * BLOCK + lane * EACH;
    var values = array<u32, 8>();
    var sum = 0u;
    for (var k = 0u; k < EACH; k++) {
        if first + k < state.visible {
            values[k] = sums[first + k];
        }
        sum = saturating(sum, values[k]);
    }
    var before = sum_before(lane, sum);
    for (var k = 0u; k < EACH; k++) {
        if first + k < state.visible {
            sums[first + k] = before;
        }
        before = saturating(before, values[k]);
    }
    if lane == 0u && first < state.visible {
        block_sums[block] = partial[255];
    }
}

// Prefix sums over blocks, and the results that depend on the total; a single group.
@compute @workgroup_size(256)
fn scan_sums(@builtin(local_invocation_index) lane: u32) {
    let blocks = ceil_div(state.visible, BLOCK);
    var carry = 0u;
    for (var start = 0u; start < blocks; start += BLOCK) {
        let first = start + lane * EACH;
        var values: array<u32, 8>;
        var sum = 0u;
        for (var k = 0u; k < EACH; k++) {
            var value = 0u;
            if first + k < blocks {
                value = block_sums[first + k];
            }
            values[k] = value;
            sum = saturating(sum, value);
        }
        var before = saturating(carry, sum_before(lane, sum));
        carry = saturating(carry, partial[255]);
        for (var k = 0u; k < EACH; k++) {
            if first + k < blocks {
                block_sums[first + k] = before;
            }
            before = saturating(before, values[k]);
        }
        workgroupBarrier();
    }
    if lane == 0u {
        conclude(carry);
    }
}

// Stores the results that depend on the total; launch.b: number of bands whose passes were encoded.
fn conclude(total: u32) {
    switch launch.a {
        case COUNTS_ALL: {
            state.total = total;
            if launch.b == 1u {
                // Passes were encoded for one band only. If the image needs more, the lists stay empty and
                // no kernel changes the model.
                let fits = total <= frame.model.z;
                conclude_bands(fits);
                state.cuts[0] = 0u;
                state.cuts[1] = frame.image.w;
                set_held(select(0u, total, fits), true);
            }
        }
        case COUNTS_BAND: { set_held(total, true); }
        case COUNTS_AGAIN: { set_held(total, false); }
        default: {}
    }
}

// Sets the number of entries of the current band, and adds it to the total if `is_new`.
fn set_held(held: u32, is_new: bool) {
    state.held = held;
    set_groups(ARGS_ENTRIES, ceil_div(held, SORTED));
    if is_new {
        let low = state.entries_low + held;
        state.entries_high += select(0u, 1u, low < held);
        state.entries_low = low;
    }
}

fn summed(i: u32) -> u32 {
    return saturating(sums[i], block_sums[i / BLOCK]);
}

// --- Rows ---------------------------------------------------------------------------------------

// A footprint, unpacked.
struct Footprint {
    // First and last tile.
    low: vec2<u32>,
    high: vec2<u32>,
    // log2 of a block's width and height.
    log2_block: vec2<u32>,
    // Two spans each.
    spans: vec2<u32>,
}

fn footprint_of(row: u32) -> Footprint {
    let words = footprints[row];
    let low = vec2(words.x, words.x >> 10u) & vec2(1023u);
    let high = vec2(words.y, words.y >> 10u) & vec2(1023u);
    let size = vec2(log2_block(high.x - low.x, LOG2_ACROSS), log2_block(high.y - low.y, LOG2_DOWN));
    return Footprint(low, high, size, words >> vec2(20u));
}

// The first and the last block of a line of tiles; none if the first is beyond the last.
fn span_of(f: Footprint, y: u32) -> vec2<u32> {
    let line = (y - f.low.y) >> f.log2_block.y;
    let span = select(f.spans.x, f.spans.y, line >= 2u) >> (6u * (line & 1u));
    return vec2(span, span >> 3u) & vec2(7u);
}

// A run of tiles in one line of a footprint: columns first..=last.
struct Run {
    first: u32,
    last: u32,
}

// The tiles of a line that are in the footprint and among the band's tiles low..high; none if first > last. `before` is
// the line's first tile.
fn run_of(f: Footprint, y: u32, before: u32, low: u32, high: u32) -> Run {
    let span = span_of(f, y);
    if span.x > span.y {
        return Run(1u, 0u);
    }
    var first = f.low.x + (span.x << f.log2_block.x);
    var last = min(f.low.x + ((span.y + 1u) << f.log2_block.x) - 1u, f.high.x);
    if before + last < low || before + first >= high {
        return Run(1u, 0u);
    }
    if before + first < low {
        first = low - before;
    }
    if before + last >= high {
        last = high - 1u - before;
    }
    return Run(first, last);
}

// The range of the band's tiles; launch.a: the band, or NONE for the whole image.
fn band() -> vec2<u32> {
    if launch.a == NONE {
        return vec2(0u, frame.image.w);
    }
    return vec2(state.cuts[launch.a], state.cuts[launch.a + 1u]);
}

// Counts the entries of each row, front to back.
@compute @workgroup_size(256)
fn count_entries(@builtin(global_invocation_id) id: vec3<u32>) {
    let i = index_of(id);
    if i >= state.visible {
        return;
    }
    let f = footprint_of(order[i]);
    let tiles = band();
    var count = 0u;
    for (var y = f.low.y; y <= f.high.y; y++) {
        let run = run_of(f, y, y * frame.image.z, tiles.x, tiles.y);
        if run.first <= run.last {
            count += run.last - run.first + 1u;
        }
    }
    sums[i] = min(count, MOST);
}

// Writes the entries, row by row: the tile and row of each.
@compute @workgroup_size(256)
fn emit_entries(@builtin(global_invocation_id) id: vec3<u32>) {
    let i = index_of(id);
    // The lists stay empty if the entries do not fit.
    if i >= state.visible || state.held == 0u {
        if i < state.visible {
            store_slots(order[i], 0u, 0u);
        }
        return;
    }
    let row = order[i];
    let f = footprint_of(row);
    let tiles = band();
    let first_slot = summed(i);
    var slot = first_slot;
    for (var y = f.low.y; y <= f.high.y; y++) {
        let before = y * frame.image.z;
        let run = run_of(f, y, before, tiles.x, tiles.y);
        for (var x = run.first; x <= run.last; x++) {
            keys_out[slot] = before + x;
            values_out[slot] = row;
            slot++;
        }
    }
    store_slots(row, first_slot, slot - first_slot);
}

// --- Bands --------------------------------------------------------------------------------------

// Counts the entries of each tile of the whole image.
@compute @workgroup_size(256)
fn count_tiles(@builtin(global_invocation_id) id: vec3<u32>) {
    let i = index_of(id);
    if i >= state.visible {
        return;
    }
    let f = footprint_of(order[i]);
    for (var y = f.low.y; y <= f.high.y; y++) {
        let before = y * frame.image.z;
        let run = run_of(f, y, before, 0u, frame.image.w);
        for (var x = run.first; x <= run.last; x++) {
            atomicAdd(&tile_counts[before + x], 1u);
        }
    }
}

// Divides the tiles into bands whose lists fit the cap; launch.b: number of bands whose passes were
// encoded. The list of a single tile always fits, since the cap is at least the budget.
@compute @workgroup_size(1)
fn cut_bands() {
    let cap = frame.model.z;
    var held = 0u;
    var band = 0u;
    state.cuts[0] = 0u;
    for (var tile = 0u; tile < frame.image.w; tile++) {
        let here = atomicLoad(&tile_counts[tile]);
        if held + here > cap {
            band++;
            held = 0u;
            if band < launch.b {
                state.cuts[band] = tile;
            }
        }
        held += here;
    }
    state.bands = band + 1u;
    let fits = band < launch.b;
    conclude_bands(fits);
    for (var k = 0u; k <= launch.b; k++) {
        if !fits {
            state.cuts[k] = 0u;
        } else if k > band {
            state.cuts[k] = frame.image.w;
        }
    }
}

// --- Stable sort, eight bits at a time; launch.a: shift, launch.b: the items (see FIRST_OF_ROWS), launch.c: 1 if the
// values are the indices ------------------------------------------------------------------------------------

// The items to sort: all rows, whose keys are the bits of their depths, so that those not on screen are left out; the
// rows on screen; the entries.
const FIRST_OF_ROWS: u32 = 0u;
const ROWS: u32 = 1u;
const ENTRIES: u32 = 2u;

// Invocations and items of a group, and the base of the digits.
const SORTERS: u32 = 128u;
const SORTED: u32 = 1024u;
const DIGITS: u32 = 256u;
// In place of an item: there is none.
const ABSENT: u32 = 0xffffffffu;

var<workgroup> histogram: array<atomic<u32>, DIGITS>;

fn items() -> u32 {
    switch launch.b {
        case FIRST_OF_ROWS: { return frame.model.x; }
        case ROWS: { return state.visible; }
        default: { return state.held; }
    }
}

// The digit of item i; ABSENT if there is no such item.
fn digit_of(i: u32, count: u32) -> u32 {
    if i >= count {
        return ABSENT;
    }
    if launch.b != FIRST_OF_ROWS {
        return (keys_in[i] >> launch.a) % DIGITS;
    }
    let depth = splats[SPLAT * i + DEPTH];
    // The bits of positive numbers sort like the numbers.
    return select(ABSENT, (bitcast<u32>(depth) >> launch.a) % DIGITS, depth > 0.0);
}

// Counts each digit's items in each block.
@compute @workgroup_size(128)
fn count_digits(
    @builtin(workgroup_id) id: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let block = group_of(id);
    let count = items();
    for (var d = lane; d < DIGITS; d += SORTERS) {
        atomicStore(&histogram[d], 0u);
    }
    workgroupBarrier();
    for (var k = 0u; k < EACH; k++) {
        let digit = digit_of(block * SORTED + k * SORTERS + lane, count);
        if digit != ABSENT {
            atomicAdd(&histogram[digit], 1u);
        }
    }
    workgroupBarrier();
    let blocks = ceil_div(count, SORTED);
    for (var d = lane; d < DIGITS && block < blocks; d += SORTERS) {
        sums[d * blocks + block] = atomicLoad(&histogram[d]);
    }
}

// Invocations per digit in scan_digits; a group has eight digits.
const SCANNERS: u32 = 32u;

// Prefix sums of a digit's counts over the blocks, and its total. An invocation has a run of neighbouring blocks.
@compute @workgroup_size(256)
fn scan_digits(
    @builtin(workgroup_id) id: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let blocks = ceil_div(items(), SORTED);
    let digit = id.x * (GROUP / SCANNERS) + lane / SCANNERS;
    let scanner = lane % SCANNERS;
    let each = ceil_div(blocks, SCANNERS);
    let first = digit * blocks + min(scanner * each, blocks);
    let end = digit * blocks + min((scanner + 1u) * each, blocks);
    var sum = 0u;
    for (var i = first; i < end; i++) {
        sum += sums[i];
    }
    partial[lane] = sum;
    workgroupBarrier();
    for (var step = 1u; step < SCANNERS; step *= 2u) {
        var until = partial[lane];
        if scanner >= step {
            until += partial[lane - step];
        }
        workgroupBarrier();
        partial[lane] = until;
        workgroupBarrier();
    }
    var before = partial[lane] - sum;
    for (var i = first; i < end; i++) {
        let count = sums[i];
        sums[i] = before;
        before += count;
    }
    if scanner == SCANNERS - 1u {
        block_sums[digit] = before;
    }
}

// Each invocation's counts of the values d and d + 8 of half a digit, in the halves of one word.
var<workgroup> counters: array<u32, SORTED>;
// The items of the block: digits and indices in the block.
var<workgroup> packed: array<u32, SORTED>;
var<workgroup> before_lanes: array<u32, SORTERS>;
// Start of each digit's items within the block, and in the result.
var<workgroup> digit_starts: array<u32, DIGITS>;
var<workgroup> starts: array<u32, DIGITS>;

// The sum of the values of this invocation and of the preceding ones, without carries between the halves of words; the
// total is then in the last of before_lanes.
fn sum_until(lane: u32, value: u32) -> u32 {
    before_lanes[lane] = value;
    workgroupBarrier();
    for (var step = 1u; step < SORTERS; step *= 2u) {
        var sum = before_lanes[lane];
        if lane >= step {
            sum += before_lanes[lane - step];
        }
        workgroupBarrier();
        before_lanes[lane] = sum;
        workgroupBarrier();
    }
    return before_lanes[lane];
}

// Sorts the items of the block by four bits, stably, without the absent ones; an invocation has eight neighbouring items.
// Returns the number of items, which are then in `packed`.
fn sort_by_half(lane: u32, shift: u32, own: ptr<function, array<u32, 8>>) -> u32 {
    for (var k = 0u; k < 8u; k++) {
        counters[k * SORTERS + lane] = 0u;
    }
    for (var k = 0u; k < EACH; k++) {
        if (*own)[k] != ABSENT {
            let half = ((*own)[k] >> shift) & 15u;
            counters[(half & 7u) * SORTERS + lane] += 1u << (16u * (half >> 3u));
        }
    }
    workgroupBarrier();
    // Prefix sums over values, then invocations; the upper halves continue from the total of the lower.
    var sum = 0u;
    for (var k = 0u; k < 8u; k++) {
        sum += counters[lane * 8u + k];
    }
    var running = sum_until(lane, sum) - sum;
    let all = before_lanes[SORTERS - 1u];
    running += all << 16u;
    for (var k = 0u; k < 8u; k++) {
        let value = counters[lane * 8u + k];
        counters[lane * 8u + k] = running;
        running += value;
    }
    workgroupBarrier();
    for (var k = 0u; k < EACH; k++) {
        if (*own)[k] != ABSENT {
            let half = ((*own)[k] >> shift) & 15u;
            let word = (half & 7u) * SORTERS + lane;
            let upper = 16u * (half >> 3u);
            packed[(counters[word] >> upper) & 0xffffu] = (*own)[k];
            counters[word] += 1u << upper;
        }
    }
    workgroupBarrier();
    return (all & 0xffffu) + (all >> 16u);
}

// Moves each item of a block to its place: first the block is sorted, so that items with the same digit are neighbours.
@compute @workgroup_size(128)
fn scatter(
    @builtin(workgroup_id) id: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let block = group_of(id);
    let first = block * SORTED;
    let count = items();
    let blocks = ceil_div(count, SORTED);
    // Rows are dispatched as if all were on screen.
    if block > 0u && block >= blocks {
        return;
    }
    // Starts of the digits in the result.
    let of_pair = vec2(block_sums[2u * lane], block_sums[2u * lane + 1u]);
    let until = sum_until(lane, of_pair.x + of_pair.y);
    starts[2u * lane] = until - of_pair.x - of_pair.y;
    starts[2u * lane + 1u] = until - of_pair.y;
    if launch.b == FIRST_OF_ROWS && block == 0u && lane == 0u {
        state.visible = before_lanes[SORTERS - 1u];
        state.entries_low = 0u;
        state.entries_high = 0u;
        state.bands = 1u;
    }
    workgroupBarrier();
    var own: array<u32, 8>;
    for (var k = 0u; k < EACH; k++) {
        let i = lane * EACH + k;
        let digit = digit_of(first + i, count);
        own[k] = select(digit << 16u | i, ABSENT, digit == ABSENT);
    }
    let held = sort_by_half(lane, 16u, &own);
    for (var k = 0u; k < EACH; k++) {
        let i = lane * EACH + k;
        own[k] = ABSENT;
        if i < held {
            own[k] = packed[i];
        }
    }
    workgroupBarrier();
    _ = sort_by_half(lane, 20u, &own);
    for (var i = lane; i < held; i += SORTERS) {
        let digit = packed[i] >> 16u;
        if i == 0u || packed[max(i, 1u) - 1u] >> 16u != digit {
            digit_starts[digit] = i;
        }
    }
    workgroupBarrier();
    for (var i = lane; i < held; i += SORTERS) {
        let digit = packed[i] >> 16u;
        let from_item = first + (packed[i] & 0xffffu);
        let to = starts[digit] + sums[digit * blocks + block] + i - digit_starts[digit];
        if launch.b == FIRST_OF_ROWS {
            keys_out[to] = bitcast<u32>(splats[SPLAT * from_item + DEPTH]);
        } else {
            keys_out[to] = keys_in[from_item];
        }
        if launch.c == 1u {
            values_out[to] = from_item;
        } else {
            values_out[to] = values_in[from_item];
        }
    }
}

// The first entry of each tile, by binary search in the sorted keys; one more for the end.
@compute @workgroup_size(256)
fn find_tiles(@builtin(global_invocation_id) id: vec3<u32>) {
    let tile = index_of(id);
    if tile > frame.image.w {
        return;
    }
    var low = 0u;
    var high = state.held;
    while low < high {
        let middle = (low + high) / 2u;
        if keys_in[middle] < tile {
            low = middle + 1u;
        } else {
            high = middle;
        }
    }
    tile_starts[tile] = low;
}
