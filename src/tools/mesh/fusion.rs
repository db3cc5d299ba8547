//! Averages depth maps in voxels as truncated signed distances (Curless and Levoy, *A Volumetric Method for Building
//! Complex Models from Range Images*, 1996), in passes over as many blocks as fit into the memory.

use std::ops::Range;

use densify_core::camera::Camera;
use glam::{DVec3, Vec3};
use rayon::prelude::*;

use super::blocks::{Grid, KEY_BYTES, Key, SIDE, VOLUME, add, block, corner, key};
use super::frame::{Frame, Frames, Seen};
use super::nets::{self, BlockNet, SAMPLE_BYTES};
use super::{Limits, MeshError, TRUNCATION};

/// A voxel: the weighted mean of truncated signed distances, positive in front of the surface, and the sum of weights.
#[derive(Debug, Clone, Copy, Default, PartialEq, bytemuck::Zeroable, bytemuck::Pod)]
#[repr(C)]
pub(super) struct Voxel {
    /// In units of the truncation, `-1..=1`.
    pub(super) distance: f32,
    /// Σ cosθ/z²; 0 where no view has seen the voxel.
    pub(super) weight: f32,
}

/// The voxels of a block, x fastest.
pub(super) type Voxels = [Voxel; VOLUME];

const BLOCK_BYTES: u64 = size_of::<Voxels>() as u64;

/// Fuses all blocks and extracts the surface from them. Returns the part of each block, in order, and the number of
/// passes.
pub(super) fn fuse(
    frames: &mut Frames<'_>,
    grid: &Grid,
    keys: &[Key],
    limits: &Limits,
) -> Result<(Vec<BlockNet>, usize), MeshError> {
    let mut nets: Vec<BlockNet> = Vec::with_capacity(keys.len());
    let (mut passes, mut held) =
        (0, keys.len() as u64 * (KEY_BYTES + size_of::<BlockNet>() as u64));
    while nets.len() < keys.len() {
        let left = limits.memory.saturating_sub(held);
        // Blocks of this pass, and what their surface may take.
        let most = left / (BLOCK_BYTES + SAMPLE_BYTES);
        let Some((range, loaded)) = longest(keys, nets.len(), most) else {
            limits.check("a pass over one block", 8 * (BLOCK_BYTES + SAMPLE_BYTES), held)?;
            return Err(MeshError::Empty);
        };
        let mut voxels: Vec<Voxels> = bytemuck::zeroed_vec(loaded.len());
        frames.for_each(|frame| {
            integrate(frame, grid, &loaded, &mut voxels);
            Ok::<_, MeshError>(())
        })?;
        let extracted =
            keys[range].par_iter().map(|&key| nets::extract(grid, key, &loaded, &voxels));
        let extracted: Vec<BlockNet> = extracted.collect();
        held += extracted.iter().map(BlockNet::bytes).sum::<u64>();
        limits.check("the surface", held, 0)?;
        nets.extend(extracted);
        passes += 1;
    }
    Ok((nets, passes))
}

/// The blocks from `start` on whose surface can be extracted with at most `most` blocks in memory, and these blocks:
/// extraction needs the voxels beyond a block's upper sides.
fn longest(keys: &[Key], start: usize, most: u64) -> Option<(Range<usize>, Vec<Key>)> {
    let mut end = keys.len().min(start.saturating_add(usize::try_from(most).unwrap_or(usize::MAX)));
    while end > start {
        let loaded = with_neighbours(keys, start..end);
        if loaded.len() as u64 <= most {
            return Some((start..end, loaded));
        }
        // Shrinks in proportion, and always by at least one block.
        let share = most as f64 / loaded.len() as f64;
        end = start + (((end - start) as f64 * share) as usize).min(end - start - 1);
    }
    None
}

/// The blocks in a range and those beyond their upper sides, in order.
fn with_neighbours(keys: &[Key], range: Range<usize>) -> Vec<Key> {
    let mut all: Vec<Key> = keys[range.clone()].to_vec();
    for &own in &keys[range] {
        let beyond = (1..8).map(|i| key(add(block(own), corner(i))));
        all.extend(beyond.filter(|key| keys.binary_search(key).is_ok()));
    }
    all.sort_unstable();
    all.dedup();
    all
}

/// Adds a depth map to the voxels.
fn integrate(frame: &Frame, grid: &Grid, keys: &[Key], voxels: &mut [Voxels]) {
    let view = View::new(frame, grid);
    keys.par_iter().zip(voxels).for_each(|(&key, voxels)| view.add_to(key, voxels));
}

/// A depth map in the coordinates of the grid.
pub(super) struct View<'a> {
    frame: &'a Frame,
    /// Camera coordinates of voxel (0, 0, 0) `[scene units]`.
    low: DVec3,
    /// Steps of one voxel along x, y and z in camera coordinates `[scene units]`.
    steps: [DVec3; 3],
    focal: [f32; 2],
    principal: [f32; 2],
    /// Radius of the sphere around a block's voxels `[scene units]`.
    radius: f64,
    /// `[scene units]`.
    truncation: f32,
}

impl<'a> View<'a> {
    pub(super) fn new(frame: &'a Frame, grid: &Grid) -> Self {
        let Camera { rotation, translation, fx, fy, cx, cy, .. } = frame.camera;
        Self {
            frame,
            low: rotation * grid.low + translation,
            steps: [0, 1, 2].map(|axis| rotation.col(axis) * grid.voxel),
            focal: [fx as f32, fy as f32],
            principal: [cx as f32, cy as f32],
            radius: 0.5 * (SIDE - 1) as f64 * 3f64.sqrt() * grid.voxel,
            truncation: TRUNCATION * grid.voxel as f32,
        }
    }

    /// Camera coordinates of a position `[voxels]`.
    fn place(&self, position: DVec3) -> DVec3 {
        let [x, y, z] = self.steps;
        self.low + x * position.x + y * position.y + z * position.z
    }

    /// Image position of a point in camera coordinates `[px]`, its signed distance from the surface seen there `[scene
    /// units]`, positive in front of it, and this surface; `None` where it is unknown.
    fn look(&self, place: Vec3) -> Option<([f32; 2], f32, Seen)> {
        if place.z <= 0.0 {
            return None;
        }
        let inverse = 1.0 / place.z;
        let u = self.focal[0] * place.x * inverse + self.principal[0];
        let v = self.focal[1] * place.y * inverse + self.principal[1];
        let seen = self.frame.surface_at(u, v, self.truncation)?;
        // Along the optical axis. Distances along the normal, for which θ is known, gave worse surfaces: normals of
        // rendered depth are uncertain where rays graze a surface.
        Some(([u, v], seen.depth - place.z, seen))
    }

    /// As [`look`](Self::look), from a position `[voxels]`.
    pub(super) fn look_at(&self, position: Vec3) -> Option<([f32; 2], f32, Seen)> {
        self.look(self.place(position.as_dvec3()).as_vec3())
    }

    /// True unless the sphere around a block is outside of the pyramid that the image shows.
    fn may_show(&self, centre: DVec3) -> bool {
        let Camera { width, height, fx, fy, cx, cy, .. } = self.frame.camera;
        let beside = |along: f64, focal: f64, principal: f64, size: u32| {
            let beyond = f64::from(size) - principal;
            let low = (focal * along + principal * centre.z) / focal.hypot(principal);
            let high = (beyond * centre.z - focal * along) / focal.hypot(beyond);
            low < -self.radius || high < -self.radius
        };
        centre.z > -self.radius
            && !beside(centre.x, fx, cx, width)
            && !beside(centre.y, fy, cy, height)
    }

    fn add_to(&self, key: Key, voxels: &mut Voxels) {
        let first = DVec3::from(block(key).map(|at| (at * SIDE as i32).into()));
        if !self.may_show(self.place(first + 0.5 * (SIDE - 1) as f64)) {
            return;
        }
        let origin = self.place(first).as_vec3();
        let [along_x, along_y, along_z] = self.steps.map(DVec3::as_vec3);
        for (row, voxels) in voxels.chunks_exact_mut(SIDE).enumerate() {
            let (y, z) = ((row % SIDE) as f32, (row / SIDE) as f32);
            let start = origin + along_y * y + along_z * z;
            for (x, voxel) in voxels.iter_mut().enumerate() {
                let Some((_, distance, seen)) = self.look(start + along_x * x as f32) else {
                    continue;
                };
                let distance = distance / self.truncation;
                if distance >= -1.0 {
                    let weight = seen.weight();
                    voxel.weight += weight;
                    let share = weight / voxel.weight;
                    voxel.distance += (distance.min(1.0) - voxel.distance) * share;
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_pass_loads_no_more_blocks_than_fit() {
        // A wall of 16 x 16 blocks.
        let mut keys: Vec<Key> = (0..256).map(|i| key([i % 16, i / 16, 0])).collect();
        keys.sort_unstable();
        assert_eq!(longest(&keys, 0, 256).map(|(range, _)| range), Some(0..256));
        for most in [4, 5, 30, 100] {
            let mut start = 0;
            while start < 256 {
                let (range, loaded) = longest(&keys, start, most).expect("a block fits");
                assert!(loaded.len() as u64 <= most && range.start == start && !range.is_empty());
                assert!(keys[range.clone()].iter().all(|key| loaded.contains(key)));
                start = range.end;
            }
        }
        // A block inside the wall has three neighbours beyond its upper sides.
        assert_eq!(longest(&keys, 0, 3), None);
    }
}
