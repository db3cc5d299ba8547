//! Blocks of 8³ voxels, named by keys whose order is that of a space-filling curve (Morton 1966), so that consecutive
//! blocks are near each other.

use glam::DVec3;
use rayon::prelude::*;

use super::frame::{Frame, Frames};
use super::{Limits, MeshError, Region, TRUNCATION};

/// Voxels along a block's side.
pub(super) const SIDE: usize = 8;
/// Voxels of a block.
pub(super) const VOLUME: usize = SIDE * SIDE * SIDE;
/// Bits of a block's coordinate along an axis.
const BITS: u32 = 21;
/// Memory of a block's key, its first vertex, and the merging of keys `[bytes]`.
pub(super) const KEY_BYTES: u64 = 28;

/// A block's name: the bits of its three coordinates, interleaved.
pub(super) type Key = u64;
/// Whole coordinates along x, y and z.
pub(super) type Place = [i32; 3];

/// The sum of two places.
pub(super) fn add(a: Place, b: Place) -> Place {
    [0, 1, 2].map(|axis| a[axis] + b[axis])
}

/// Corner `i` of a unit cube, x fastest.
pub(super) fn corner(i: usize) -> Place {
    [i & 1, i >> 1 & 1, i >> 2].map(|bit| bit as i32)
}

/// The grid: voxel (0, 0, 0) lies at `low`, and each voxel stands for a point.
#[derive(Debug, Clone, Copy)]
pub(super) struct Grid {
    pub(super) low: DVec3,
    /// Length of a voxel `[scene units]`.
    pub(super) voxel: f64,
    /// Number of blocks along each axis.
    blocks: Place,
    /// Number of cells between voxels along each axis.
    cells: Place,
}

impl Grid {
    /// The grid of a region; `None` if it has too many blocks along an axis.
    pub(super) fn new(region: &Region, voxel: f64) -> Option<Self> {
        // Cells end inside the region, unless it is thinner than one of them.
        let cells = ((region.high - region.low) / voxel).floor().max(DVec3::ONE);
        let blocks = (cells / SIDE as f64).floor() + 1.0;
        let fits = blocks.is_finite() && blocks.max_element() < f64::from(1 << (BITS - 1));
        let [cells, blocks] =
            [cells, blocks].map(|counts| counts.to_array().map(|count| count as i32));
        (fits && voxel > 0.0).then_some(Self { low: region.low, voxel, blocks, cells })
    }

    /// Number of cells of a block that are inside the region, along each axis.
    pub(super) fn cells_of(&self, block: Place) -> [usize; 3] {
        [0, 1, 2].map(|axis| {
            (self.cells[axis] - block[axis] * SIDE as i32).clamp(0, SIDE as i32) as usize
        })
    }

    /// Adds the blocks with a voxel closer to a scene point than the truncation, along every axis.
    fn near(&self, point: DVec3, keys: &mut Vec<Key>) {
        let position = (point - self.low) / self.voxel;
        let reach = DVec3::splat(f64::from(TRUNCATION));
        let block = |p: DVec3| (p / SIDE as f64).floor().to_array().map(|at| at as i32);
        let (low, high) = (block(position - reach), block(position + reach));
        let along = |axis: usize| low[axis].max(0)..=high[axis].min(self.blocks[axis] - 1);
        for z in along(2) {
            for y in along(1) {
                for x in along(0) {
                    keys.push(key([x, y, z]));
                }
            }
        }
    }
}

/// Spreads the bits of a coordinate: two zeros after each.
fn spread(value: i32) -> u64 {
    let mut bits = value as u64 & ((1 << BITS) - 1);
    for (shift, mask) in [
        (32, 0x001f_0000_0000_ffff),
        (16, 0x001f_0000_ff00_00ff),
        (8, 0x100f_00f0_0f00_f00f),
        (4, 0x10c3_0c30_c30c_30c3),
        (2, 0x1249_2492_4924_9249),
    ] {
        bits = (bits | bits << shift) & mask;
    }
    bits
}

/// Undoes [`spread`].
fn gather(key: u64) -> i32 {
    let mut bits = key & 0x1249_2492_4924_9249;
    for (shift, mask) in [
        (2, 0x10c3_0c30_c30c_30c3),
        (4, 0x100f_00f0_0f00_f00f),
        (8, 0x001f_0000_ff00_00ff),
        (16, 0x001f_0000_0000_ffff),
        (32, 0x001f_ffff),
    ] {
        bits = (bits | bits >> shift) & mask;
    }
    bits as i32
}

/// The key of the block at these coordinates, >= 0.
pub(super) fn key([x, y, z]: Place) -> Key {
    spread(x) | spread(y) << 1 | spread(z) << 2
}

/// The coordinates of a block.
pub(super) fn block(key: Key) -> Place {
    [gather(key), gather(key >> 1), gather(key >> 2)]
}

/// The blocks near the points that the views show, in order.
pub(super) fn collect(
    frames: &mut Frames<'_>,
    grid: &Grid,
    limits: &Limits,
) -> Result<Vec<Key>, MeshError> {
    let mut keys: Vec<Key> = Vec::new();
    frames.for_each(|frame: &Frame| {
        let width = frame.map.width;
        let rows = (0..frame.map.height).into_par_iter();
        let per_row = rows.map(|y| {
            let mut found = Vec::new();
            for x in 0..width {
                if frame.cosine[y * width + x] <= 0.0 {
                    continue;
                }
                // Pixels are left out where they are much denser than voxels.
                let z = f64::from(frame.map.depth[y * width + x]);
                let density = grid.voxel * frame.camera.fx.min(frame.camera.fy) / z;
                let step = if density >= 2.0 { 1 << (density.log2() as u32).min(6) } else { 1 };
                if x % step == 0 && y % step == 0 {
                    grid.near(frame.seen_in_scene(x, y).unwrap_or(DVec3::MAX), &mut found);
                }
            }
            found.sort_unstable();
            found.dedup();
            found
        });
        let mut found: Vec<Key> = per_row.collect::<Vec<_>>().concat();
        found.sort_unstable();
        found.dedup();
        keys = merge(&keys, &found);
        limits.check("the list of blocks", keys.len() as u64 * KEY_BYTES, 0)
    })?;
    if keys.is_empty() { Err(MeshError::Nothing) } else { Ok(keys) }
}

/// The union of two lists without duplicates, in order.
fn merge(a: &[Key], b: &[Key]) -> Vec<Key> {
    let mut merged = Vec::with_capacity(a.len() + b.len());
    let (mut i, mut j) = (0, 0);
    while i < a.len() || j < b.len() {
        let next = a.get(i).copied().unwrap_or(Key::MAX).min(b.get(j).copied().unwrap_or(Key::MAX));
        i += usize::from(a.get(i) == Some(&next));
        j += usize::from(b.get(j) == Some(&next));
        merged.push(next);
    }
    merged
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn keys_hold_coordinates_and_keep_neighbours_together() {
        for place in [[0, 0, 0], [1, 2, 3], [1_048_575, 0, 77], [12_345, 678_901, 1_048_575]] {
            assert_eq!(block(key(place)), place);
        }
        // The eight blocks of an aligned cube are consecutive.
        let cube = (0..8).map(|i| key(add([6, 4, 2], corner(i))));
        let mut cube: Vec<Key> = cube.collect();
        cube.sort_unstable();
        assert_eq!(cube[7] - cube[0], 7);
    }

    #[test]
    fn lists_are_merged_in_order_without_duplicates() {
        assert_eq!(merge(&[1, 3, 9], &[0, 3, 4, 10]), [0, 1, 3, 4, 9, 10]);
        assert_eq!(merge(&[], &[2, 5]), [2, 5]);
    }
}
