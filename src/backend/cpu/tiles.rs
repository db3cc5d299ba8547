//! Stage 2: splats to tile lists. Visible rows are ordered by depth; each is entered, in that order,
//! into the list of every 16×16 tile that its ellipse (where alpha >= 1/255) touches.
//!
//! The lists are a stable counting sort by tile: count, prefix sum, emit. Tiles are numbered row by
//! row. When all lists together would exceed the cap, the image is processed in bands: runs of
//! consecutive tiles whose lists fit. Tiles are independent and each row's gradients are summed in
//! order of tile number, so bands change no bit of the result.
//!
//! An entry is emitted by the same function that counted it, on the same values, and Rust never
//! contracts floating-point expressions; so the two passes agree.

use std::ops::Range;
use std::sync::atomic::{AtomicU32, AtomicU64, Ordering::Relaxed};

use rayon::prelude::*;

use super::project::{LOG2_255, Splat};
use super::simd::WIDTH;

/// Side of a tile [px].
pub(super) const TILE: usize = WIDTH;
/// Pixels per tile.
pub(super) const TILE_PIXELS: usize = TILE * TILE;
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
        Self {
            width,
            height,
            columns: width.div_ceil(TILE),
            rows: height.div_ceil(TILE),
        }
    }

    pub(super) fn tiles(&self) -> usize {
        self.columns * self.rows
    }
}

/// The tile lists of one band at a time. All buffers are allocated once.
#[derive(Debug)]
pub(super) struct TileLists {
    /// Visible rows by depth: (depth bits, row). Shape: [visible], of [budget].
    pub(super) order: Vec<u64>,
    pub(super) visible: usize,
    /// The row of each entry, tile after tile. Shape: [cap].
    entries: Vec<AtomicU32>,
    /// Where the entries of a row stand in `entries`, row after row in depth order. Shape: [cap].
    positions: Vec<u32>,
    /// Per row: its run in `positions`, first << 32 | length. Shape: [budget].
    runs: Vec<AtomicU64>,
    /// First entry of each tile of the band. Shape: [tiles of the band + 1].
    starts: Vec<u32>,
    /// Entries per (chunk of `order`, tile).
    counters: Vec<u32>,
}

impl TileLists {
    pub(super) fn new(budget: usize, cap: usize) -> Self {
        Self {
            order: vec![0; budget],
            visible: 0,
            entries: (0..cap).map(|_| AtomicU32::new(0)).collect(),
            positions: vec![0; cap],
            runs: (0..budget).map(|_| AtomicU64::new(0)).collect(),
            starts: Vec::new(),
            counters: Vec::new(),
        }
    }

    /// Bytes for a budget of rows, a cap of entries and an image of so many tiles.
    pub(super) fn bytes(budget: usize, cap: usize, tiles: usize) -> u64 {
        let per_row = size_of::<u64>() + size_of::<AtomicU64>();
        let per_entry = size_of::<AtomicU32>() + size_of::<u32>();
        let counters = (tiles * MOST_CHUNKS).min(MOST_COUNTERS.max(tiles));
        let starts_and_counters = (tiles + 1 + counters) * size_of::<u32>();
        (budget * per_row + cap * per_entry + starts_and_counters) as u64
    }

    /// Most entries held at a time.
    pub(super) fn cap(&self) -> usize {
        self.entries.len()
    }

    /// Sorts the first `visible` keys.
    pub(super) fn sort(&mut self, visible: usize) {
        self.visible = visible;
        self.order[..visible].par_sort_unstable();
    }

    /// Bands of the image: ranges of tiles whose lists fit the cap, and the number of entries.
    pub(super) fn bands(&mut self, splats: &[Splat], grid: &Grid) -> (Vec<Range<usize>>, u64) {
        let tiles = grid.tiles();
        self.count(splats, grid, 0..tiles);
        let cap = self.entries.len() as u64;
        let mut bands = Vec::with_capacity(1);
        let (mut start, mut held, mut total) = (0, 0, 0);
        for tile in 0..tiles {
            let here: u64 = self.counters[tile..]
                .iter()
                .step_by(tiles)
                .map(|&n| u64::from(n))
                .sum();
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
        splats: &[Splat],
        grid: &Grid,
        band: Range<usize>,
        counted: bool,
    ) {
        if !counted {
            self.count(splats, grid, band.clone());
        }
        let tiles = band.len();
        let chunk = self.chunk_rows(tiles);
        // Counts become first positions: all of a tile's chunks, then the next tile.
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
        // Each chunk's runs lie side by side in `positions`; their lengths are known per row.
        let order = &self.order[..self.visible];
        let runs = &self.runs;
        let mut rest = &mut self.positions[..];
        let mut first = 0_u64;
        let mut work = Vec::with_capacity(order.len().div_ceil(chunk));
        for (rows, cursors) in order
            .chunks(chunk)
            .zip(self.counters.chunks_mut(tiles.max(1)))
        {
            let length = rows
                .iter()
                .map(|&key| run_of(runs, key).load(Relaxed))
                .sum::<u64>();
            let (mine, tail) = rest.split_at_mut(length as usize);
            rest = tail;
            work.push((rows, cursors, mine, first));
            first += length;
        }
        let entries = &self.entries;
        work.into_par_iter()
            .for_each(|(rows, cursors, positions, first)| {
                let mut filled = 0;
                for &key in rows {
                    let row = key as u32;
                    let before = filled;
                    for_each_tile(&splats[row as usize], grid, &band, |tile| {
                        let position = cursors[tile];
                        cursors[tile] += 1;
                        entries[position as usize].store(row, Relaxed);
                        positions[filled] = position;
                        filled += 1;
                    });
                    let run = (first + before as u64) << 32 | (filled - before) as u64;
                    run_of(runs, key).store(run, Relaxed);
                }
            });
    }

    /// Counts entries per (chunk, tile of the band), and leaves each row's count in its run.
    fn count(&mut self, splats: &[Splat], grid: &Grid, band: Range<usize>) {
        let tiles = band.len();
        let chunk = self.chunk_rows(tiles);
        let order = &self.order[..self.visible];
        let chunks = order.len().div_ceil(chunk);
        self.counters.clear();
        self.counters.resize(chunks.max(1) * tiles, 0);
        let runs = &self.runs;
        order
            .par_chunks(chunk)
            .zip(self.counters.par_chunks_mut(tiles.max(1)))
            .for_each(|(rows, counters)| {
                for &key in rows {
                    let mut count = 0;
                    for_each_tile(&splats[key as u32 as usize], grid, &band, |tile| {
                        counters[tile] += 1;
                        count += 1;
                    });
                    run_of(runs, key).store(count, Relaxed);
                }
            });
    }

    /// Rows per chunk: independent of the number of threads.
    fn chunk_rows(&self, tiles: usize) -> usize {
        let chunks = (MOST_COUNTERS / tiles.max(1)).clamp(1, MOST_CHUNKS);
        self.visible.div_ceil(chunks).max(512)
    }

    /// The rows entered into tile `tile` of the band, front to back.
    pub(super) fn of_tile(&self, tile: usize) -> &[AtomicU32] {
        &self.entries[self.range_of_tile(tile)]
    }

    /// The entries of tile `tile` of the band.
    pub(super) fn range_of_tile(&self, tile: usize) -> Range<usize> {
        self.starts[tile] as usize..self.starts[tile + 1] as usize
    }

    /// Where the entries of `row` stand, in order of tile number. Only for visible rows.
    pub(super) fn entries_of_row(&self, row: usize) -> &[u32] {
        let run = self.runs[row].load(Relaxed);
        let first = (run >> 32) as usize;
        &self.positions[first..first + (run as u32) as usize]
    }
}

fn run_of(runs: &[AtomicU64], key: u64) -> &AtomicU64 {
    &runs[key as u32 as usize]
}

/// Slack for the bounds of an ellipse [px]: their rounding errors, f32's at 16,384 px, are far less
/// relative to the ellipse's size, and a pixel missed at the bound has an alpha of 1/255.
const SLACK: f32 = 0.02;

/// Calls `f` with the number, relative to the band, of every tile of the band that the splat's
/// ellipse touches, in ascending order.
#[inline]
fn for_each_tile(splat: &Splat, grid: &Grid, band: &Range<usize>, mut f: impl FnMut(usize)) {
    let [mx, my] = splat.mean;
    let (hw, hh) = (
        splat.half_width * 1.0001 + SLACK,
        splat.half_height * 1.0001 + SLACK,
    );
    // Index of the tile whose pixel centres are the first at or after (last at or before) a bound.
    // `as` saturates, and makes NaN 0.
    let tile_of = |x: f32, most: usize| ((x * (1.0 / TILE as f32)).max(0.0) as usize).min(most - 1);
    let (x0, x1) = (
        tile_of(mx - hw - 0.5, grid.columns),
        tile_of(mx + hw - 0.5, grid.columns),
    );
    let (y0, y1) = (
        tile_of(my - hh - 0.5, grid.rows),
        tile_of(my + hh - 0.5, grid.rows),
    );
    let (first_row, last_row) = (band.start / grid.columns, band.end.div_ceil(grid.columns));
    if x0 == x1 || y0 == y1 {
        for ty in y0.max(first_row)..(y1 + 1).min(last_row) {
            for tx in x0..=x1 {
                let tile = ty * grid.columns + tx;
                if band.contains(&tile) {
                    f(tile - band.start);
                }
            }
        }
        return;
    }
    // In folded units the ellipse is u² + z² <= reach, u = l1·(dx − shear·dy), z = l3·dy. Its
    // rightmost point is at dy = peak, its leftmost at dy = −peak.
    let (l1, shear, l3) = (splat.l1, splat.shear, splat.l3);
    let reach = splat.log2_opacity + LOG2_255;
    let peak = shear * l1 * reach.sqrt() / (l3 * (l3 * l3 + shear * shear * l1 * l1).sqrt());
    for ty in y0.max(first_row)..(y1 + 1).min(last_row) {
        let top = ((ty * TILE) as f32 + 0.5 - my).max(-hh);
        let bottom = ((ty * TILE + TILE) as f32 - 0.5 - my).min(hh);
        let half = |dy: f32| (reach - (l3 * dy) * (l3 * dy)).max(0.0).sqrt() / l1;
        let right_at = peak.max(top).min(bottom);
        let left_at = (-peak).max(top).min(bottom);
        let right = (shear * right_at + half(right_at)).min(hw);
        let left = (shear * left_at - half(left_at)).max(-hw);
        let (right, left) = (
            right + 1e-4 * right.abs() + SLACK,
            left - 1e-4 * left.abs() - SLACK,
        );
        let from = tile_of(mx + left - 0.5, grid.columns).max(x0);
        let to = tile_of(mx + right - 0.5, grid.columns).min(x1);
        for tx in from..=to {
            let tile = ty * grid.columns + tx;
            if band.contains(&tile) {
                f(tile - band.start);
            }
        }
    }
}
