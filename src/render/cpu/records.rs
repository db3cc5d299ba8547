//! The memory of the gradient records that the backward pass writes, one per (row, tile) entry, and their summation.
//!
//! If every entry of the lists has a record, it is stored in the entry's [slot](super::tiles), so that the records of a
//! row are adjacent. However, records take three quarters of all memory per entry (40 of 52 bytes) and are needed only
//! until they are summed. If there are fewer records than entries, a band is processed in parts, each a run of tiles:
//! records are written in the order of the lists and added to the sums of their rows before the next part. A tile with
//! more entries than there are records is processed once for each piece of its list. A row's records are always added
//! in order of tile number, so that parts, like bands, cost time but do not change the result.

use std::ops::Range;
use std::sync::atomic::{AtomicU32, Ordering::Relaxed};

use rayon::prelude::*;

use super::simd::WIDTH;
use super::threads::Threads;
use super::tiles::{Entry, TileLists};
use super::{BLOCKS_PER_TASK, ROWS_PER_TASK};
use crate::signals::{BASE, Field, RecordLayout};

/// Entries of a band whose records are in memory at the same time.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Part {
    /// The tiles of these entries.
    pub(super) tiles: Range<usize>,
    /// The entries, counted from the first of the band; `None` for all entries, each in its slot.
    entries: Option<Range<usize>>,
}

/// The records of one tile.
#[derive(Debug, Clone, Copy)]
pub(super) struct TileRecords<'a> {
    /// Bits of the records. Shape: `[cap, stride]`.
    bits: &'a [AtomicU32],
    stride: usize,
    /// The index of the record of the list's first entry, which may be outside of the buffer; `None` if each record is
    /// in its entry's slot.
    first: Option<usize>,
}

impl<'a> TileRecords<'a> {
    /// The record of the entry at index `at` of the tile's list, if it belongs to this part.
    #[inline(always)]
    pub(super) fn record(&self, entry: Entry, at: usize) -> Option<&'a [AtomicU32]> {
        let record = match self.first {
            None => entry.slot,
            Some(first) => first.wrapping_add(at),
        };
        let start = record.checked_mul(self.stride)?;
        self.bits.get(start..start.checked_add(self.stride)?)
    }
}

/// The sums of the rows' records.
pub(super) struct Sums<'a> {
    /// Shape: `[rows, stride]`, or more rows.
    pub(super) sums: &'a mut [f32],
    pub(super) stride: usize,
    /// True if the sums start at 0.
    pub(super) fresh: bool,
    /// One bit per row, set if the row has records. Shape: `[blocks of sixteen rows]`.
    pub(super) visible: &'a [u16],
}

/// Divides a band of `tiles` tiles into parts of at most `cap` records, in order.
pub(super) fn parts(threads: &Threads, lists: &TileLists, tiles: usize, cap: usize) -> Vec<Part> {
    let parts = divide(lists.firsts(tiles), cap);
    if parts.len() > 1 {
        lists.store_positions(threads, tiles);
    }
    parts
}

/// Divides tiles into parts; `firsts` has the number of entries before each tile, and the number of all entries.
fn divide(firsts: &[u32], cap: usize) -> Vec<Part> {
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
        // These entries become several parts only if they belong to a single tile and exceed `cap`.
        while !entries.is_empty() {
            let piece = entries.start..entries.end.min(entries.start + cap);
            entries.start = piece.end;
            parts.push(Part { tiles: start..end, entries: Some(piece) });
        }
        start = end;
    }
    parts
}

impl Part {
    /// The records of a tile of the band.
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

    /// Calls `add` with the sum of each visible row and its records, a few at a time, in order of tile number.
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

/// Writes the values that the layout has.
#[inline(always)]
pub(super) fn write(
    to: Option<&[AtomicU32]>,
    all: &[f32; RecordLayout::MOST],
    layout: RecordLayout,
) {
    let Some((base, extras)) = to.and_then(|to| to.split_at_checked(BASE)) else { return };
    for (to, x) in base.iter().zip(all) {
        to.store(x.to_bits(), Relaxed);
    }
    for (to, &number) in extras.iter().zip(layout.extras()) {
        to.store(all[usize::from(number)].to_bits(), Relaxed);
    }
}

/// Adds up the records of one row, which are adjacent, in order. `sums` has the shape of a record.
pub(super) fn gather(sums: &mut [f32], layout: RecordLayout, records: &[AtomicU32]) {
    let maximum = layout.has(Field::WeightMax);
    match sums.len() {
        9 => gather_all::<9>(sums, maximum, records),
        10 => gather_all::<10>(sums, maximum, records),
        11 => gather_all::<11>(sums, maximum, records),
        12 => gather_all::<12>(sums, maximum, records),
        13 => gather_all::<13>(sums, maximum, records),
        14 => gather_all::<14>(sums, maximum, records),
        15 => gather_all::<15>(sums, maximum, records),
        _ => gather_all::<{ RecordLayout::MOST }>(sums, maximum, records),
    }
}

/// Adds records of `STRIDE` values to `sums`; the last value may be a maximum.
#[inline(always)]
pub(super) fn gather_all<const STRIDE: usize>(
    sums: &mut [f32],
    maximum: bool,
    records: &[AtomicU32],
) {
    let mut total: [f32; STRIDE] = std::array::from_fn(|i| sums[i]);
    for record in records.as_chunks::<STRIDE>().0 {
        for i in 0..STRIDE {
            let x = f32::from_bits(record[i].load(Relaxed));
            let is_maximum = maximum && i == STRIDE - 1;
            total[i] = if is_maximum { total[i].max(x) } else { total[i] + x };
        }
    }
    sums.copy_from_slice(&total);
}

const _: () = assert!(BASE == 9 && RecordLayout::MOST == 16, "`gather` lists every length");
