//! Stage 2: from splats to tile lists. Every visible row is entered into the list of each 16×16 tile that
//! its ellipse covers; each list is then sorted by depth, ties by row.
//!
//! Tiles are numbered row by row. Entries are counted per (chunk of rows, tile), and a prefix sum
//! gives each entry its position, so that threads write without synchronisation. Rows are processed in memory
//! order: sorting all rows by depth first and processing them in that order costs a cache miss per
//! row and pass, and took ten times as long. The lists are short, and are sorted by the tasks that use them.
//!
//! An entry also has a *slot*: its position in the order by row and then by tile. The
//! backward pass writes an entry's gradient into its slot, so that the gradients of a row are adjacent.
//! Slots ascend with rows, so that (depth, slot) sorts like (depth, row).
//!
//! When all lists together would exceed the cap, the image is processed in bands: runs of
//! consecutive tiles whose lists fit. Tiles are independent, and each row's gradients are summed in
//! order of tile number, so that bands do not change the result.
//!
//! Counting, placing and emitting are in one file because they share the counters and the division into chunks.
//!
//! Counting stores the tiles of a row as bits in the memory of its slots. Ellipses too large for these bits are
//! evaluated again when entries are emitted, by the same function on the same values; as Rust never contracts
//! floating-point expressions, the two passes agree.

use std::ops::Range;
use std::sync::atomic::{AtomicU32, AtomicU64, Ordering::Relaxed};

use rayon::prelude::*;

use super::footprint::Footprint;
use super::project::Splat;
use super::simd::WIDTH;
use super::threads::Threads;

/// Side of a tile `[px]`.
pub(super) const TILE: usize = crate::TILE as usize;
const _: () = assert!(TILE == WIDTH, "a tile is as wide as a vector");
/// Maximum number of counters, one per (chunk of rows, tile): 16 MiB.
const MAX_COUNTERS: usize = 1 << 22;
/// Maximum number of chunks of rows: four for each of 64 threads.
const MAX_CHUNKS: usize = 256;
/// Minimum number of rows per chunk.
const MIN_ROWS_PER_CHUNK: usize = 128;
/// Maximum number of tasks that add up counters.
const MAX_RUNS: usize = 64;
/// Minimum number of tiles per task that adds up counters.
const MIN_TILES_PER_RUN: usize = 64;

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

/// The projected rows, and the mask of those on screen.
#[derive(Clone, Copy)]
pub(super) struct Visible<'a> {
    /// Shape: `[rows]`.
    pub(super) splats: &'a [Splat],
    /// One bit per row, set if it is on screen. Shape: `[blocks of sixteen rows]`.
    pub(super) seen: &'a [u16],
}

impl Visible<'_> {
    /// Calls `f` with the visible rows among `rows`, which must start at a block.
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
    /// The row of each slot; after sorting, if needed, the [position](Self::store_positions) of the slot's entry.
    /// Shape: `[cap]`.
    row_of_slot: Vec<AtomicU32>,
    /// First slot and number of slots of each visible row. Between counting and emitting, a [`Footprint`] instead.
    /// Shape: `[budget]`.
    slots: Vec<[u32; 2]>,
    /// First entry of each tile of the band. Shape: `[tiles of the band + 1]`.
    starts: Vec<u32>,
    /// Number of entries per (chunk of rows, tile). While entries are emitted, the position of the chunk's next entry
    /// in the tile's list instead. Shape: `[chunks, tiles of the band]`, or more.
    counters: Vec<u32>,
    /// Number of entries per chunk of rows.
    lengths: Vec<u64>,
}

impl TileLists {
    pub(super) fn new(budget: usize, cap: usize) -> Self {
        Self {
            // Zeroed lazily by the system: memory that no view fills never becomes resident.
            entries: bytemuck::zeroed_vec(cap),
            row_of_slot: bytemuck::zeroed_vec(cap),
            slots: vec![[0; 2]; budget],
            starts: Vec::new(),
            counters: Vec::new(),
            lengths: Vec::new(),
        }
    }

    /// Bytes for a budget of rows, a cap of entries and an image of `tiles` tiles.
    pub(super) fn bytes(budget: usize, cap: usize, tiles: usize) -> u64 {
        let per_row = size_of::<[u32; 2]>();
        let per_entry = size_of::<AtomicU64>() + size_of::<AtomicU32>();
        let counters = (tiles * MAX_CHUNKS).min(MAX_COUNTERS.max(tiles));
        let starts_and_counters = (tiles + 1 + counters) * size_of::<u32>();
        (budget * per_row + cap * per_entry + starts_and_counters) as u64
    }

    /// Maximum number of entries in memory at a time.
    pub(super) fn cap(&self) -> usize {
        self.entries.len()
    }

    /// Divides the image into bands, ranges of tiles whose lists fit the cap. Also returns the number of entries.
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
        divide(of_tiles.into_iter(), cap)
    }

    /// Fills the lists of one band. With `counted`, the counters already hold this band.
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
        // The slots of a chunk are adjacent.
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

    /// Computes from the counters of `tiles` tiles where each list starts, and replaces the counters by the positions
    /// in the list at which the entries of each chunk start. Counters are read in memory order: if all chunks of one
    /// tile were read before the next tile, each read would be a cache miss.
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

    /// Fills and sorts the lists of a band again after other bands have used the memory.
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

    /// Sorts the list of tile `tile` of the band front to back. Positive floats compare like their bits.
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

    /// The number of entries of the band before tile `tile`.
    pub(super) fn first_of(&self, tile: usize) -> usize {
        self.starts[tile] as usize
    }

    /// The number of entries before each of `tiles` tiles, and the number of all entries.
    pub(super) fn firsts(&self, tiles: usize) -> &[u32] {
        &self.starts[..=tiles]
    }

    /// Stores for each slot the position of its entry in the band. Call it only after sorting, which uses the same
    /// memory.
    pub(super) fn store_positions(&self, threads: &Threads, tiles: usize) {
        threads.each("positions", 0..tiles, |tile| {
            let first = self.first_of(tile);
            for (i, entry) in self.of_tile(tile).iter().enumerate() {
                self.row_of_slot[Entry::load(entry).slot].store((first + i) as u32, Relaxed);
            }
        });
    }

    /// The stored position of a slot's entry.
    pub(super) fn position_of(&self, slot: usize) -> usize {
        self.row_of_slot[slot].load(Relaxed) as usize
    }

    /// The slots of a visible row in the band, in order of tile number.
    pub(super) fn slots_of_row(&self, row: usize) -> Range<usize> {
        let [first, count] = self.slots[row];
        first as usize..(first + count) as usize
    }
}

/// Divides tiles with the given numbers of entries into bands of at most `cap` entries, which a single tile never
/// exceeds. Also returns the number of all entries.
fn divide(entries: impl Iterator<Item = u64>, cap: u64) -> (Vec<Range<usize>>, u64) {
    let mut bands = Vec::with_capacity(1);
    let (mut start, mut end, mut in_band, mut total) = (0, 0, 0, 0);
    for in_tile in entries {
        if in_band + in_tile > cap {
            bands.push(start..end);
            (start, in_band) = (end, 0);
        }
        in_band += in_tile;
        total += in_tile;
        end += 1;
    }
    bands.push(start..end);
    (bands, total)
}

/// Rows per chunk, in whole blocks; independent of the number of threads.
fn chunk_rows(rows: usize, tiles: usize) -> usize {
    let chunks = (MAX_COUNTERS / tiles.max(1)).clamp(1, MAX_CHUNKS);
    rows.div_ceil(chunks).max(MIN_ROWS_PER_CHUNK).next_multiple_of(WIDTH)
}

/// Number of tiles whose counters one task adds up.
fn tiles_per_run(tiles: usize) -> usize {
    tiles.div_ceil(MAX_RUNS).max(MIN_TILES_PER_RUN)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Full-HD images, each covered completely by every Gaussian; the numbers of entries exceed 31 and 32 bits.
    #[test]
    fn bands_are_cut_without_overflow() {
        const TILES: u64 = 120 * 68;
        for rows in [263_172_u64, 526_344, u64::from(u32::MAX)] {
            let entries = || std::iter::repeat_n(rows, TILES as usize);
            for cap in [rows, 16 * rows, u64::from(u32::MAX)] {
                let (bands, total) = divide(entries(), cap);
                assert_eq!(total, rows * TILES);
                let most = bands.iter().map(|band| band.len() as u64 * rows).max();
                assert!(most.is_some_and(|most| most <= cap), "{rows} rows, cap {cap}");
                let tiles: usize = bands.iter().map(Range::len).sum();
                let adjacent = bands.windows(2).all(|pair| pair[0].end == pair[1].start);
                assert!(adjacent && bands[0].start == 0 && tiles as u64 == TILES);
                // No more bands than are needed.
                let per_band = cap / rows;
                assert_eq!(bands.len() as u64, TILES.div_ceil(per_band));
            }
        }
        let (bands, total) = divide(std::iter::empty(), 5);
        assert!(bands.len() == 1 && bands[0].is_empty() && total == 0);
    }

    #[test]
    fn chunks_of_any_number_of_rows_stay_within_the_limits() {
        for rows in [0, 1, 127, 128, 1 << 31, (1_usize << 32) - 1, 1 << 40] {
            for tiles in [0, 1, 8160, 1 << 20] {
                let chunk = chunk_rows(rows, tiles);
                assert!(chunk.is_multiple_of(WIDTH) && chunk >= MIN_ROWS_PER_CHUNK);
                let chunks = rows.div_ceil(chunk);
                assert!(chunks <= MAX_CHUNKS && chunks * tiles <= MAX_COUNTERS.max(tiles));
            }
        }
    }

    /// Numbers of tiles for less than one task, for whole tasks, and with a remainder.
    #[test]
    fn places_are_prefix_sums_over_tiles_and_chunks() {
        const RUN: usize = MIN_TILES_PER_RUN;
        let threads = Threads::new(Some(2)).expect("threads");
        for tiles in [1, RUN - 1, RUN, 2 * RUN, 2 * RUN + 7, MAX_RUNS * RUN + 1] {
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
