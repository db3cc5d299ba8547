// The tiles that a row's ellipse touches, in two words: the rectangle of these tiles, and the span of blocks of tiles in
// each line of blocks. There are at most 8 × 4 blocks, as small as possible, that start at the rectangle's first tile.
// Coordinates of tiles have 10 bits: images have at most 16,384 pixels on a side.

// log2 of the largest number of blocks, across and down.
const LOG2_ACROSS: u32 = 3u;
const LOG2_DOWN: u32 = 2u;

// The log2 of the side of a block, for a rectangle whose last tile is `most` tiles beyond the first.
fn log2_block(most: u32, log2_blocks: u32) -> u32 {
    return max(32u - countLeadingZeros(most), log2_blocks) - log2_blocks;
}

// The spans of two lines of blocks: first and last block, three bits each; no blocks if the first is beyond the last.
const NO_SPANS: u32 = 0x1c7u;

// Replaces the empty span of a line by another.
fn set_span(spans: ptr<function, vec2<u32>>, line: u32, span: u32) {
    let shift = 6u * (line & 1u);
    let changed = (span ^ 7u) << shift;
    if line < 2u {
        (*spans).x ^= changed;
    } else {
        (*spans).y ^= changed;
    }
}
