//! Where the backward pass writes its gradient records, one per (row, tile) entry, and how they are summed.
//!
//! Where there is room for a record of every entry that the lists hold, an entry's record lies in its
//! slot, and a row finds its records side by side. Records are three quarters of the
//! memory of an entry, though, and are only needed to be summed. With room for fewer, a band is taken in parts:
//! runs of tiles, whose records lie in the order of the lists, and of which each row takes its own
//! before the next part. A tile with more entries than there is room for is done again for each piece
//! of its list. A row's records are added in order of tile number in any case, so that parts, as bands,
//! cost time and change no bit.

use std::ops::Range;
use std::sync::atomic::AtomicU32;

use rayon::prelude::*;

use super::simd::WIDTH;
use super::threads::Threads;
use super::tiles::{Entry, TileLists};
use super::{BLOCKS_PER_TASK, ROWS_PER_TASK};

/// Entries of a band whose records are held together.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Part {
    /// Tiles of the band that hold them.
    pub(super) tiles: Range<usize>,
    /// The entries, counted from the first of the band; `None`: all of them, each in its slot.
    entries: Option<Range<usize>>,
}

/// Where the records of one tile go.
#[derive(Debug, Clone, Copy)]
pub(super) struct TileRecords<'a> {
    /// Bits of the records. Shape: `[cap, stride]`.
    bits: &'a [AtomicU32],
    stride: usize,
    /// The record of the list's first entry; it and others may lie outside. `None`: by slot.
    first: Option<usize>,
}

impl<'a> TileRecords<'a> {
    /// The record of the entry at place `at` of the tile's list, if it is held in this part.
    #[inline(always)]
    pub(super) fn of(&self, entry: Entry, at: usize) -> Option<&'a [AtomicU32]> {
        let record = match self.first {
            None => entry.slot,
            Some(first) => first.wrapping_add(at),
        };
        let start = record.checked_mul(self.stride)?;
        self.bits.get(start..start.checked_add(self.stride)?)
    }
}

/// Where records are summed.
pub(super) struct Sums<'a> {
    /// Shape: `[rows, stride]`, or more rows.
    pub(super) sums: &'a mut [f32],
    pub(super) stride: usize,
    /// Whether the sums start anew.
    pub(super) fresh: bool,
    /// Bit per lane of each block: who has records. Shape: `[blocks]`.
    pub(super) visible: &'a [u16],
}

/// The parts of a band of so many tiles, for at most `cap` records at a time, in order.
pub(super) fn parts(threads: &Threads, lists: &TileLists, tiles: usize, cap: usize) -> Vec<Part> {
    let parts = cut(lists.firsts(tiles), cap);
    if parts.len() > 1 {
        lists.note_positions(threads, tiles);
    }
    parts
}

/// `firsts` has the number of entries before each tile, and of all.
fn cut(firsts: &[u32], cap: usize) -> Vec<Part> {
    let cap = cap.max(1);
    let tiles = firsts.len() - 1;
    if firsts[tiles] as usize <= cap {
        return vec![Part { tiles: 0..tiles, entries: None }];
    }
    let mut parts = Vec::new();
    let mut start = 0;
    while start < tiles {
        let from = firsts[start] as usize;
        let fit = firsts[start + 1..].partition_point(|&first| first as usize - from <= cap);
        let end = start + fit.max(1);
        let mut entries = from..firsts[end] as usize;
        // More than one only of a tile that is too much by itself.
        while !entries.is_empty() {
            let some = entries.start..entries.end.min(entries.start + cap);
            entries.start = some.end;
            parts.push(Part { tiles: start..end, entries: Some(some) });
        }
        start = end;
    }
    parts
}

impl Part {
    /// Where the records of a tile of the band go.
    pub(super) fn records<'a>(
        &self,
        lists: &TileLists,
        tile: usize,
        bits: &'a [AtomicU32],
        stride: usize,
    ) -> TileRecords<'a> {
        let first = |held: &Range<usize>| lists.first_of(tile).wrapping_sub(held.start);
        TileRecords { bits, stride, first: self.entries.as_ref().map(first) }
    }

    /// Shows each visible row its sum and its records, some at a time, in order of tile number.
    pub(super) fn gather(
        &self,
        threads: &Threads,
        lists: &TileLists,
        bits: &[AtomicU32],
        to: Sums<'_>,
        add: impl Fn(&mut [f32], &[AtomicU32]) + Send + Sync,
    ) {
        let Sums { sums, stride, fresh, visible } = to;
        let sums = sums.par_chunks_mut(ROWS_PER_TASK * stride);
        let tasks = sums.zip(visible.par_chunks(BLOCKS_PER_TASK)).enumerate();
        threads.each("gather", tasks, |(task, (sums, visible))| {
            let first = task * BLOCKS_PER_TASK;
            let blocks = sums.chunks_mut(stride * WIDTH).zip(visible);
            for (block, (sums, &seen)) in (first..).zip(blocks) {
                for (lane, sum) in sums.chunks_exact_mut(stride).enumerate() {
                    if fresh {
                        sum.fill(0.0);
                    }
                    if seen >> lane & 1 == 0 {
                        continue;
                    }
                    let slots = lists.slots_of_row(block * WIDTH + lane);
                    let Some(held) = &self.entries else {
                        add(sum, &bits[slots.start * stride..slots.end * stride]);
                        continue;
                    };
                    for slot in slots {
                        let position = lists.position_of(slot);
                        if held.contains(&position) {
                            let record = position - held.start;
                            add(sum, &bits[record * stride..(record + 1) * stride]);
                        }
                    }
                }
            }
        });
    }
}
