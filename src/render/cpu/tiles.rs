//! Stage 2: splats to tile lists. Every visible row is entered into the list of each 16×16 tile that
//! its ellipse (where alpha >= 1/255) touches; each list is then sorted by depth, ties by row.
//!
//! Tiles are numbered row by row. Entries are counted per (chunk of rows, tile), and a prefix sum
//! gives each its place, so that threads write without asking each other. Rows are walked in memory
//! order: sorting all rows by depth first, and walking them in that order, costs a cache miss per
//! row and pass, which was ten times the work. The short lists are sorted where they are used.
//!
//! An entry also has a *slot*: its place when entries are ordered by row and then by tile. The
//! backward pass writes an entry's gradient into its slot, and a row finds all of its own side by
//! side. Slots ascend with rows, so (depth, slot) sorts as (depth, row) does.
//!
//! When all lists together would exceed the cap, the image is processed in bands: runs of
//! consecutive tiles whose lists fit. Tiles are independent, and each row's gradients are summed in
//! order of tile number, so bands change no bit of the result.
//!
//! The file is one piece because counting, placing and emitting share the counters and their cuts.
//!
//! Counting notes the tiles of a row as bits where its slots will stand. Only of rows that reach farther
//! than the bits do, the ellipse is evaluated again when entries are emitted: by the same function on the
//! same values, and Rust never contracts floating-point expressions; so the two passes agree.

use std::ops::Range;
use std::sync::atomic::{AtomicU32, AtomicU64, Ordering::Relaxed};

use rayon::prelude::*;

use super::footprint::Footprint;
use super::project::Splat;
use super::simd::WIDTH;
use super::threads::Threads;

/// Side of a tile `[px]`.
pub(super) const TILE: usize = WIDTH;
/// Bound for (chunks of rows) × (tiles) counters: 16 MiB of them.
const MOST_COUNTERS: usize = 1 << 22;
/// Four for each of 64 threads.
const MOST_CHUNKS: usize = 256;
const LEAST_ROWS_PER_CHUNK: usize = 128;
/// Most tasks that add up counters, and the fewest tiles of one.
const MOST_RUNS: usize = 64;
const LEAST_TILES_PER_RUN: usize = 64;

/// An image as a grid of tiles.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Grid {
    pub(super) width: usize,
    pub(super) height: usize,
    pub(super) columns: usize,
    pub(super) rows: usize,
}

impl Grid {
    pub(super) fn new(width: u32, height: u32) -> Self {
        let (width, height) = (width as usize, height as usize);
        Self { width, height, columns: width.div_ceil(TILE), rows: height.div_ceil(TILE) }
    }

    pub(super) fn tiles(&self) -> usize {
        self.columns * self.rows
    }
}

/// An entry of a tile's list.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Entry {
    pub(super) row: usize,
    pub(super) slot: usize,
}

impl Entry {
    #[inline(always)]
    pub(super) fn load(from: &AtomicU64) -> Self {
        let bits = from.load(Relaxed);
        Self { row: (bits >> 32) as usize, slot: bits as u32 as usize }
    }
}

/// The rows that are projected now, and which of them are on screen.
#[derive(Clone, Copy)]
pub(super) struct Visible<'a> {
    /// Shape: `[rows]`.
    pub(super) splats: &'a [Splat],
    /// Bit per lane of each block. Shape: `[blocks]`.
    pub(super) seen: &'a [u16],
}

impl Visible<'_> {
    /// The visible rows among `rows`, which start and end at blocks.
    fn each(self, rows: Range<usize>, mut f: impl FnMut(usize, &Splat)) {
        for block in rows.start / WIDTH..rows.end.div_ceil(WIDTH) {
            let mut todo = self.seen[block];
            while todo != 0 {
                let row = block * WIDTH + todo.trailing_zeros() as usize;
                todo &= todo - 1;
                f(row, &self.splats[row]);
            }
        }
    }
}

/// The tile lists of one band at a time. All buffers are allocated once.
#[derive(Debug)]
pub(super) struct TileLists {
    /// Tile after tile: (depth bits, slot) until the tile is sorted, then (row, slot). Shape: `[cap]`.
    entries: Vec<AtomicU64>,
    /// The row of each slot; once lists are sorted, its [position](Self::note_positions) where that
    /// is asked for. Shape: `[cap]`.
    row_of_slot: Vec<AtomicU32>,
    /// First slot and number of slots of each row; meaningless for rows not visible. Between
    /// counting and emitting, a [`Footprint`] instead. Shape: `[budget]`.
    slots: Vec<[u32; 2]>,
    /// First entry of each tile of the band. Shape: `[tiles of the band + 1]`.
    starts: Vec<u32>,
    /// Entries per (chunk of rows, tile). While entries are emitted: their places in the tile's list.
    /// Shape: `[chunks, tiles of the band]`, or more than these.
    counters: Vec<u32>,
    /// Entries per chunk of rows.
    lengths: Vec<u64>,
}

impl TileLists {
    pub(super) fn new(budget: usize, cap: usize) -> Self {
        Self {
            // Zeroed by the system, as needed: what no view fills is never resident.
            entries: bytemuck::zeroed_vec(cap),
            row_of_slot: bytemuck::zeroed_vec(cap),
            slots: vec![[0; 2]; budget],
            starts: Vec::new(),
            counters: Vec::new(),
            lengths: Vec::new(),
        }
    }

    /// Bytes for a budget of rows, a cap of entries and an image of so many tiles.
    pub(super) fn bytes(budget: usize, cap: usize, tiles: usize) -> u64 {
        let per_row = size_of::<[u32; 2]>();
        let per_entry = size_of::<AtomicU64>() + size_of::<AtomicU32>();
        let counters = (tiles * MOST_CHUNKS).min(MOST_COUNTERS.max(tiles));
        let starts_and_counters = (tiles + 1 + counters) * size_of::<u32>();
        (budget * per_row + cap * per_entry + starts_and_counters) as u64
    }

    /// Most entries held at a time.
    pub(super) fn cap(&self) -> usize {
        self.entries.len()
    }

    /// Bands of the image: ranges of tiles whose lists fit the cap, and the number of entries.
    pub(super) fn bands(
        &mut self,
        threads: &Threads,
        visible: Visible<'_>,
        grid: &Grid,
    ) -> (Vec<Range<usize>>, u64) {
        let tiles = grid.tiles();
        self.count(threads, visible, grid, 0..tiles);
        let (cap, entries) = (self.cap() as u64, self.lengths.iter().sum());
        if entries <= cap {
            return (std::iter::once(0..tiles).collect(), entries);
        }
        let mut of_tiles = vec![0_u64; tiles];
        let run = tiles_per_run(tiles);
        let counters = &self.counters[..self.lengths.len() * tiles];
        let tasks = of_tiles.par_chunks_mut(run).enumerate();
        threads.each("count tiles", tasks, |(i, sums)| {
            for counters in counters.chunks_exact(tiles) {
                for (sum, &n) in sums.iter_mut().zip(&counters[i * run..]) {
                    *sum += u64::from(n);
                }
            }
        });
        cut(of_tiles.into_iter(), cap)
    }

    /// Fills the lists for one band. `counted` says that the counters already hold this band.
    pub(super) fn fill(
        &mut self,
        threads: &Threads,
        visible: Visible<'_>,
        grid: &Grid,
        band: Range<usize>,
        counted: bool,
    ) {
        if !counted {
            self.count(threads, visible, grid, band.clone());
        }
        let tiles = band.len();
        self.find_places(threads, tiles);
        let chunk = chunk_rows(visible.splats.len(), tiles);
        // Each chunk's slots lie side by side.
        let mut rest = &mut self.row_of_slot[..];
        let mut first = 0;
        let mut work = Vec::new();
        let slots = self.slots[..visible.splats.len()].chunks_mut(chunk);
        for (&length, slots) in self.lengths.iter().zip(slots) {
            let (mine, tail) = rest.split_at_mut(length as usize);
            rest = tail;
            work.push((first, mine, slots));
            first += length as usize;
        }
        let (entries, starts) = (&self.entries, &self.starts);
        let counters = self.counters.par_chunks_mut(tiles.max(1));
        let tasks = work.into_par_iter().zip(counters).enumerate();
        threads.each("fill", tasks, |(i, ((first, row_of_slot, slots), places))| {
            let mut filled = 0;
            let rows = i * chunk..i * chunk + slots.len();
            visible.each(rows.clone(), |row, splat| {
                let before = filled;
                let depth = u64::from(splat.depth.to_bits()) << 32;
                let footprint = Footprint(slots[row - rows.start]);
                footprint.for_each_tile(splat, grid, &band, |tile| {
                    let key = depth | (first + filled) as u64;
                    entries[(starts[tile] + places[tile]) as usize].store(key, Relaxed);
                    places[tile] += 1;
                    *row_of_slot[filled].get_mut() = row as u32;
                    filled += 1;
                });
                slots[row - rows.start] = [(first + before) as u32, (filled - before) as u32];
            });
        });
    }

    /// From the counters of so many tiles, where each list starts, and in their stead where in each list
    /// the entries of each chunk do: after those of the chunks before. Walked in the order of memory; down
    /// the chunks of one tile, each number would be a cache miss.
    fn find_places(&mut self, threads: &Threads, tiles: usize) {
        let run = tiles_per_run(tiles);
        let mut runs: Vec<Vec<&mut [u32]>> = Vec::new();
        let chunks = self.lengths.len();
        runs.resize_with(tiles.div_ceil(run), || Vec::with_capacity(chunks));
        for counters in self.counters.chunks_exact_mut(tiles.max(1)).take(chunks) {
            for (runs, counters) in runs.iter_mut().zip(counters.chunks_mut(run)) {
                runs.push(counters);
            }
        }
        self.starts.resize(tiles + 1, 0);
        let (starts, end) = self.starts.split_at_mut(tiles);
        let tasks = runs.into_par_iter().zip(starts.par_chunks_mut(run));
        let mut lengths: Vec<u32> = threads.collect("places", tasks, |(chunks, starts)| {
            starts.fill(0);
            for counters in chunks {
                for (n, start) in counters.iter_mut().zip(&mut *starts) {
                    *start += std::mem::replace(n, *start);
                }
            }
            starts.iter().sum()
        });
        end[0] = 0;
        for length in &mut lengths {
            end[0] += std::mem::replace(length, end[0]);
        }
        let tasks = starts.par_chunks_mut(run).zip(lengths);
        threads.each("starts", tasks, |(starts, mut next)| {
            for start in starts {
                next += std::mem::replace(start, next);
            }
        });
    }

    /// Fills and sorts the lists of a band again, after other bands were in their place.
    pub(super) fn refill(
        &mut self,
        threads: &Threads,
        visible: Visible<'_>,
        grid: &Grid,
        band: &Range<usize>,
    ) {
        self.fill(threads, visible, grid, band.clone(), false);
        threads.each_with("sort", 0..band.len(), Vec::new, |scratch, i| self.sort(i, scratch));
    }

    /// Counts entries per (chunk, tile of the band).
    fn count(&mut self, threads: &Threads, visible: Visible<'_>, grid: &Grid, band: Range<usize>) {
        let tiles = band.len();
        let rows = visible.splats.len();
        let chunk = chunk_rows(rows, tiles);
        let needed = rows.div_ceil(chunk) * tiles;
        if self.counters.len() < needed {
            self.counters.resize(needed, 0);
        }
        let counters = self.counters.par_chunks_mut(tiles.max(1));
        let tasks = counters.zip(self.slots[..rows].par_chunks_mut(chunk)).enumerate();
        self.lengths = threads.collect("count", tasks, |(i, (counters, slots))| {
            let (first, mut length) = (i * chunk, 0);
            counters.fill(0);
            visible.each(first..first + slots.len(), |row, splat| {
                let footprint = Footprint::new(splat, grid, &band, |tile| {
                    counters[tile] += 1;
                    length += 1;
                });
                slots[row - first] = footprint.0;
            });
            length
        });
    }

    /// Brings the list of tile `tile` of the band into its final order, front to back. Positive
    /// floats compare as their bits do.
    pub(super) fn sort(&self, tile: usize, scratch: &mut Vec<u64>) {
        let list = self.of_tile(tile);
        scratch.clear();
        scratch.extend(list.iter().map(|entry| entry.load(Relaxed)));
        scratch.sort_unstable();
        for (entry, &key) in list.iter().zip(&scratch[..]) {
            let slot = key as u32;
            let row = self.row_of_slot[slot as usize].load(Relaxed);
            entry.store(u64::from(row) << 32 | u64::from(slot), Relaxed);
        }
    }

    /// The entries of tile `tile` of the band.
    pub(super) fn of_tile(&self, tile: usize) -> &[AtomicU64] {
        &self.entries[self.starts[tile] as usize..self.starts[tile + 1] as usize]
    }

    /// Entries of the band, tile after tile, before tile `tile`.
    pub(super) fn first_of(&self, tile: usize) -> usize {
        self.starts[tile] as usize
    }

    /// The same before each of so many tiles, and all entries.
    pub(super) fn firsts(&self, tiles: usize) -> &[u32] {
        &self.starts[..=tiles]
    }

    /// Notes of each slot which entry of the band it belongs to. After sorting, which needs the
    /// place.
    pub(super) fn note_positions(&self, threads: &Threads, tiles: usize) {
        threads.each("positions", 0..tiles, |tile| {
            let first = self.first_of(tile);
            for (i, entry) in self.of_tile(tile).iter().enumerate() {
                self.row_of_slot[Entry::load(entry).slot].store((first + i) as u32, Relaxed);
            }
        });
    }

    /// What was noted of a slot.
    pub(super) fn position_of(&self, slot: usize) -> usize {
        self.row_of_slot[slot].load(Relaxed) as usize
    }

    /// The slots of `row` in the band, in order of tile number. Only for visible rows.
    pub(super) fn slots_of_row(&self, row: usize) -> Range<usize> {
        let [first, count] = self.slots[row];
        first as usize..(first + count) as usize
    }
}

/// Runs of consecutive tiles with these numbers of entries, of which each run has at most `cap` (a tile
/// alone never has more), and all entries.
fn cut(entries: impl Iterator<Item = u64>, cap: u64) -> (Vec<Range<usize>>, u64) {
    let mut bands = Vec::with_capacity(1);
    let (mut start, mut end, mut held, mut total) = (0, 0, 0, 0);
    for here in entries {
        if held + here > cap {
            bands.push(start..end);
            (start, held) = (end, 0);
        }
        held += here;
        total += here;
        end += 1;
    }
    bands.push(start..end);
    (bands, total)
}

/// Rows per chunk, whole blocks: independent of the number of threads.
fn chunk_rows(rows: usize, tiles: usize) -> usize {
    let chunks = (MOST_COUNTERS / tiles.max(1)).clamp(1, MOST_CHUNKS);
    rows.div_ceil(chunks).max(LEAST_ROWS_PER_CHUNK).next_multiple_of(WIDTH)
}

/// Tiles whose counters are added up by one task.
fn tiles_per_run(tiles: usize) -> usize {
    tiles.div_ceil(MOST_RUNS).max(LEAST_TILES_PER_RUN)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Full-HD images that rows fill: the first numbers of them whose entries pass 31 bits, and 32.
    #[test]
    fn bands_are_cut_without_overflow() {
        const TILES: u64 = 120 * 68;
        for rows in [263_172_u64, 526_344, u64::from(u32::MAX)] {
            let entries = || std::iter::repeat_n(rows, TILES as usize);
            for cap in [rows, 16 * rows, u64::from(u32::MAX)] {
                let (bands, total) = cut(entries(), cap);
                assert_eq!(total, rows * TILES);
                let most = bands.iter().map(|band| band.len() as u64 * rows).max();
                assert!(most.is_some_and(|most| most <= cap), "{rows} rows, cap {cap}");
                let tiles: usize = bands.iter().map(Range::len).sum();
                let whole = bands.windows(2).all(|pair| pair[0].end == pair[1].start);
                assert!(whole && bands[0].start == 0 && tiles as u64 == TILES);
                // No more than are needed.
                let per_band = cap / rows;
                assert_eq!(bands.len() as u64, TILES.div_ceil(per_band));
            }
        }
        let (none, total) = cut(std::iter::empty(), 5);
        assert!(none.len() == 1 && none[0].is_empty() && total == 0);
    }

    #[test]
    fn chunks_cover_any_number_of_rows() {
        for rows in [0, 1, 127, 128, 1 << 31, (1_usize << 32) - 1, 1 << 40] {
            for tiles in [0, 1, 8160, 1 << 20] {
                let chunk = chunk_rows(rows, tiles);
                assert!(chunk.is_multiple_of(WIDTH) && chunk >= LEAST_ROWS_PER_CHUNK);
                let chunks = rows.div_ceil(chunk);
                assert!(chunks <= MOST_CHUNKS && chunks * tiles <= MOST_COUNTERS.max(tiles));
            }
        }
    }

    /// Of fewer tiles than a run has, of whole runs, and of more.
    #[test]
    fn places_are_sums_of_all_that_comes_before() {
        const RUN: usize = LEAST_TILES_PER_RUN;
        let threads = Threads::new(Some(2)).expect("threads");
        for tiles in [1, RUN - 1, RUN, 2 * RUN, 2 * RUN + 7, MOST_RUNS * RUN + 1] {
            let chunks = 5;
            let counters: Vec<u32> = (0..chunks * tiles).map(|i| (i * 7 % 11) as u32).collect();
            let mut lists = TileLists::new(1, 1);
            lists.counters.clone_from(&counters);
            lists.lengths = vec![0; chunks];
            lists.find_places(&threads, tiles);
            let mut next = 0;
            for tile in 0..tiles {
                for chunk in 0..chunks {
                    let place = lists.starts[tile] + lists.counters[chunk * tiles + tile];
                    assert_eq!(place, next, "tile {tile} of {tiles}, chunk {chunk}");
                    next += counters[chunk * tiles + tile];
                }
            }
            assert_eq!(lists.starts[tiles], next);
        }
    }
}
