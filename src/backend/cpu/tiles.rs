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
//! Counting notes the tiles of a row as bits where its slots will stand, so that its ellipse is
//! evaluated once. Only of rows that reach farther than the bits do, it is evaluated again when
//! entries are emitted: by the same function on the same values, and Rust never contracts
//! floating-point expressions; so the two passes agree.

use std::ops::Range;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};

use rayon::prelude::*;

use super::project::{LOG2_255, Splat};
use super::simd::WIDTH;

/// Side of a tile `[px]`.
pub(super) const TILE: usize = WIDTH;
/// Bound for (chunks of rows) × (tiles) counters: 4 MiB of them.
const MOST_COUNTERS: usize = 1 << 20;
const MOST_CHUNKS: usize = 64;

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
    /// The row of each slot. Shape: `[cap]`.
    row_of_slot: Vec<u32>,
    /// First slot and number of slots of each row; meaningless for rows not visible. Between
    /// counting and emitting, a [`Footprint`] instead. Shape: `[budget]`.
    slots: Vec<[u32; 2]>,
    /// First entry of each tile of the band. Shape: `[tiles of the band + 1]`.
    starts: Vec<u32>,
    /// Entries per (chunk of rows, tile).
    counters: Vec<u32>,
}

impl TileLists {
    pub(super) fn new(budget: usize, cap: usize) -> Self {
        Self {
            entries: (0..cap).map(|_| AtomicU64::new(0)).collect(),
            row_of_slot: vec![0; cap],
            slots: vec![[0; 2]; budget],
            starts: Vec::new(),
            counters: Vec::new(),
        }
    }

    /// Bytes for a budget of rows, a cap of entries and an image of so many tiles.
    pub(super) fn bytes(budget: usize, cap: usize, tiles: usize) -> u64 {
        let per_row = size_of::<[u32; 2]>();
        let per_entry = size_of::<AtomicU64>() + size_of::<u32>();
        let counters = (tiles * MOST_CHUNKS).min(MOST_COUNTERS.max(tiles));
        let starts_and_counters = (tiles + 1 + counters) * size_of::<u32>();
        (budget * per_row + cap * per_entry + starts_and_counters) as u64
    }

    /// Most entries held at a time.
    pub(super) fn cap(&self) -> usize {
        self.entries.len()
    }

    /// Bands of the image: ranges of tiles whose lists fit the cap, and the number of entries.
    pub(super) fn bands(&mut self, visible: Visible<'_>, grid: &Grid) -> (Vec<Range<usize>>, u64) {
        let tiles = grid.tiles();
        self.count(visible, grid, 0..tiles);
        let cap = self.cap() as u64;
        let mut bands = Vec::with_capacity(1);
        let (mut start, mut held, mut total) = (0, 0, 0);
        for tile in 0..tiles {
            let counters = self.counters[tile..].iter().step_by(tiles);
            let here: u64 = counters.map(|&n| u64::from(n)).sum();
            if held + here > cap {
                bands.push(start..tile);
                (start, held) = (tile, 0);
            }
            held += here;
            total += here;
        }
        bands.push(start..tiles);
        (bands, total)
    }

    /// Fills the lists for one band. `counted` says that the counters already hold this band.
    pub(super) fn fill(
        &mut self,
        visible: Visible<'_>,
        grid: &Grid,
        band: Range<usize>,
        counted: bool,
    ) {
        if !counted {
            self.count(visible, grid, band.clone());
        }
        let tiles = band.len();
        let chunk = chunk_rows(visible.splats.len(), tiles);
        // Each chunk's slots lie side by side.
        let mut rest = &mut self.row_of_slot[..];
        let mut first = 0;
        let mut work = Vec::new();
        for (counters, slots) in self
            .counters
            .chunks_mut(tiles.max(1))
            .zip(self.slots[..visible.splats.len()].chunks_mut(chunk))
        {
            let length = counters.iter().map(|&n| n as usize).sum();
            let (mine, tail) = rest.split_at_mut(length);
            rest = tail;
            work.push((first, mine, slots));
            first += length;
        }
        // Counts become first places: all of a tile's chunks, then the next tile.
        self.starts.clear();
        self.starts.resize(tiles + 1, 0);
        let mut next = 0;
        for tile in 0..tiles {
            self.starts[tile] = next;
            for counter in self.counters[tile..].iter_mut().step_by(tiles) {
                next += std::mem::replace(counter, next);
            }
        }
        self.starts[tiles] = next;
        let entries = &self.entries;
        work.into_par_iter().zip(self.counters.par_chunks_mut(tiles.max(1))).enumerate().for_each(
            |(i, ((first, row_of_slot, slots), cursors))| {
                let mut filled = 0;
                let rows = i * chunk..i * chunk + slots.len();
                visible.each(rows.clone(), |row, splat| {
                    let before = filled;
                    let depth = u64::from(splat.depth.to_bits()) << 32;
                    let footprint = Footprint(slots[row - rows.start]);
                    footprint.for_each_tile(splat, grid, &band, |tile| {
                        let key = depth | (first + filled) as u64;
                        entries[cursors[tile] as usize].store(key, Relaxed);
                        cursors[tile] += 1;
                        row_of_slot[filled] = row as u32;
                        filled += 1;
                    });
                    slots[row - rows.start] = [(first + before) as u32, (filled - before) as u32];
                });
            },
        );
    }

    /// Fills and sorts the lists of a band again, after other bands were in their place.
    pub(super) fn refill(&mut self, visible: Visible<'_>, grid: &Grid, band: &Range<usize>) {
        self.fill(visible, grid, band.clone(), false);
        (0..band.len()).into_par_iter().for_each_init(Vec::new, |scratch, i| self.sort(i, scratch));
    }

    /// Counts entries per (chunk, tile of the band).
    fn count(&mut self, visible: Visible<'_>, grid: &Grid, band: Range<usize>) {
        let tiles = band.len();
        let rows = visible.splats.len();
        let chunk = chunk_rows(rows, tiles);
        self.counters.clear();
        self.counters.resize(rows.div_ceil(chunk).max(1) * tiles, 0);
        let counters = self.counters.par_chunks_mut(tiles.max(1));
        let work = counters.zip(self.slots[..rows].par_chunks_mut(chunk)).enumerate();
        work.for_each(|(i, (counters, slots))| {
            let first = i * chunk;
            visible.each(first..first + slots.len(), |row, splat| {
                let footprint = Footprint::new(splat, grid, &band, |tile| counters[tile] += 1);
                slots[row - first] = footprint.0;
            });
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
            let row = self.row_of_slot[slot as usize];
            entry.store(u64::from(row) << 32 | u64::from(slot), Relaxed);
        }
    }

    /// The entries of tile `tile` of the band.
    pub(super) fn of_tile(&self, tile: usize) -> &[AtomicU64] {
        &self.entries[self.starts[tile] as usize..self.starts[tile + 1] as usize]
    }

    /// The slots of `row` in the band, in order of tile number. Only for visible rows.
    pub(super) fn slots_of_row(&self, row: usize) -> Range<usize> {
        let [first, count] = self.slots[row];
        first as usize..(first + count) as usize
    }
}

/// Rows per chunk, whole blocks: independent of the number of threads.
fn chunk_rows(rows: usize, tiles: usize) -> usize {
    let chunks = (MOST_COUNTERS / tiles.max(1)).clamp(1, MOST_CHUNKS);
    rows.div_ceil(chunks).max(512).next_multiple_of(WIDTH)
}

/// Slack for the bounds of an ellipse [px]: their rounding errors, f32's at 16,384 px, are far less
/// relative to the ellipse's size, and a pixel missed at the bound has an alpha of 1/255.
const SLACK: f32 = 0.02;

/// The tiles of a band that a row touches, as a number of the first and a bit for each of those to
/// its right and below, [`REACH_X`] × [`REACH_Y`] of them; or [`FAR`](Self::FAR).
#[derive(Clone, Copy, PartialEq, Eq)]
struct Footprint([u32; 2]);

const REACH_X: usize = 8;
const REACH_Y: usize = 4;

impl Footprint {
    /// The row reaches farther than the bits do: its ellipse must be evaluated again.
    const FAR: Self = Self([u32::MAX, 0]);

    /// Calls `f` with the number, relative to the band, of every tile of the band that the splat's
    /// ellipse touches, in ascending order.
    #[inline]
    fn new(splat: &Splat, grid: &Grid, band: &Range<usize>, mut f: impl FnMut(usize)) -> Self {
        let reach = Reach::new(splat, grid, band);
        let fits = reach.x1 - reach.x0 < REACH_X && reach.y1 - reach.y0 <= REACH_Y;
        let corner = reach.y0 * grid.columns + reach.x0;
        let mut bits = 0_u32;
        reach.for_each_tile(splat, grid, band, |tx, ty| {
            if fits {
                bits |= 1 << ((ty - reach.y0) * REACH_X + tx - reach.x0);
            }
            f(ty * grid.columns + tx - band.start);
        });
        if fits { Self([corner as u32, bits]) } else { Self::FAR }
    }

    /// Does the same again.
    #[inline]
    fn for_each_tile(
        self,
        splat: &Splat,
        grid: &Grid,
        band: &Range<usize>,
        mut f: impl FnMut(usize),
    ) {
        if self == Self::FAR {
            Self::new(splat, grid, band, f);
            return;
        }
        let Self([corner, mut bits]) = self;
        while bits != 0 {
            let bit = bits.trailing_zeros() as usize;
            bits &= bits - 1;
            f(corner as usize + bit / REACH_X * grid.columns + bit % REACH_X - band.start);
        }
    }
}

/// The rectangle of tiles around a splat's ellipse: columns `x0..=x1`, and rows `y0..y1` of those
/// that the band has.
struct Reach {
    x0: usize,
    x1: usize,
    y0: usize,
    y1: usize,
    /// Whether the rectangle is one tile wide or high, and so without corners to cut.
    narrow: bool,
}

impl Reach {
    #[inline]
    fn new(splat: &Splat, grid: &Grid, band: &Range<usize>) -> Self {
        let [mx, my] = splat.mean;
        let [hw, hh] = half_sides(splat);
        let (x0, x1) = (tile_of(mx - hw - 0.5, grid.columns), tile_of(mx + hw - 0.5, grid.columns));
        let (y0, y1) = (tile_of(my - hh - 0.5, grid.rows), tile_of(my + hh - 0.5, grid.rows));
        let (first_row, last_row) = (band.start / grid.columns, band.end.div_ceil(grid.columns));
        let narrow = x0 == x1 || y0 == y1;
        let y0 = y0.max(first_row);
        Self { x0, x1, y0, y1: (y1 + 1).min(last_row).max(y0), narrow }
    }

    /// Calls `f` with column and row of every tile of the band that the ellipse touches, row by row.
    #[inline]
    fn for_each_tile(
        &self,
        splat: &Splat,
        grid: &Grid,
        band: &Range<usize>,
        mut f: impl FnMut(usize, usize),
    ) {
        let Self { x0, x1, y0, y1, narrow } = *self;
        // In folded units the ellipse is u² + z² <= reach, u = l1·(dx − shear·dy), z = l3·dy. Its
        // rightmost point is at dy = peak, its leftmost at dy = −peak.
        let Splat { mean: [mx, my], shear, l3, inv_l1, peak, .. } = *splat;
        let [hw, hh] = half_sides(splat);
        let reach = splat.log2_opacity + LOG2_255;
        for ty in y0..y1 {
            let (mut from, mut to) = (x0, x1);
            if !narrow {
                let top = ((ty * TILE) as f32 + 0.5 - my).max(-hh);
                let bottom = ((ty * TILE + TILE) as f32 - 0.5 - my).min(hh);
                let half = |dy: f32| (reach - (l3 * dy) * (l3 * dy)).max(0.0).sqrt() * inv_l1;
                let right_at = peak.max(top).min(bottom);
                let left_at = (-peak).max(top).min(bottom);
                let right = (shear * right_at + half(right_at)).min(hw);
                let left = (shear * left_at - half(left_at)).max(-hw);
                let (right, left) =
                    (right + 1e-4 * right.abs() + SLACK, left - 1e-4 * left.abs() - SLACK);
                from = tile_of(mx + left - 0.5, grid.columns).max(x0);
                to = tile_of(mx + right - 0.5, grid.columns).min(x1);
            }
            for tx in from..=to {
                if band.contains(&(ty * grid.columns + tx)) {
                    f(tx, ty);
                }
            }
        }
    }
}

/// Half the sides of the rectangle around a splat's ellipse [px], with slack.
#[inline(always)]
fn half_sides(splat: &Splat) -> [f32; 2] {
    [splat.half_width * 1.0001 + SLACK, splat.half_height * 1.0001 + SLACK]
}

/// Index of the tile whose pixel centres are the first at or after (last at or before) a bound.
/// `as` saturates, and makes NaN 0.
#[inline(always)]
fn tile_of(x: f32, most: usize) -> usize {
    ((x * (1.0 / TILE as f32)).max(0.0) as usize).min(most - 1)
}
