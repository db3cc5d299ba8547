//! Surface nets (Gibson, *Constrained Elastic Surface Nets*, 1998): a vertex in each cell of eight voxels through which
//! the surface passes, at the mean of the crossings of the cell's edges.

use glam::Vec3;

use super::blocks::{Grid, Key, SIDE, add, block, corner, key};
use super::fusion::{Voxel, Voxels};

/// Samples along a block's side with one layer of the next block, which both share.
const LAYERS: usize = SIDE + 1;
/// The twelve edges of a cell, as pairs of corners; corner i is at (i & 1, i >> 1 & 1, i >> 2).
const EDGES: [(usize, usize); 12] = [
    (0, 1),
    (2, 3),
    (4, 5),
    (6, 7),
    (0, 2),
    (1, 3),
    (4, 6),
    (5, 7),
    (0, 4),
    (1, 5),
    (2, 6),
    (3, 7),
];
/// What the surface in a block may take while it is extracted: a vertex in each third cell `[bytes]`.
pub(super) const SAMPLE_BYTES: u64 = 170 * size_of::<Vertex>() as u64;

/// A vertex of the net.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Vertex {
    /// Position `[voxels]`.
    pub(super) position: [f32; 3],
    /// The cell's index in its block, x fastest, in bits 0–8; which edges at its lowest corner the surface crosses, x
    /// first, in bits 9–11; and whether these lead out of the solid, in bits 12–14.
    cell: u16,
}

/// The vertices in a block, in the order of their cells.
#[derive(Debug, Clone, Default, PartialEq)]
pub(super) struct BlockNet {
    pub(super) vertices: Box<[Vertex]>,
}

impl Vertex {
    /// The cell's index in its block.
    pub(super) fn cell(&self) -> usize {
        usize::from(self.cell & 0x1ff)
    }

    /// True if the surface crosses the edge along this axis at the cell's lowest corner.
    pub(super) fn is_crossed(&self, axis: usize) -> bool {
        self.cell >> (9 + axis) & 1 == 1
    }

    /// True if that edge leads out of the solid.
    pub(super) fn leads_out(&self, axis: usize) -> bool {
        self.cell >> (12 + axis) & 1 == 1
    }
}

impl BlockNet {
    pub(super) fn bytes(&self) -> u64 {
        size_of_val::<[Vertex]>(&self.vertices) as u64
    }

    /// Index of the vertex in a cell, if it has one.
    pub(super) fn vertex_of(&self, cell: usize) -> Option<usize> {
        self.vertices.binary_search_by_key(&cell, Vertex::cell).ok()
    }
}

/// Extracts the vertices of a block inside the grid's region. `keys` has it and the blocks beyond its upper sides, as far as they exist.
pub(super) fn extract(grid: &Grid, own: Key, keys: &[Key], voxels: &[Voxels]) -> BlockNet {
    let here = block(own);
    let blocks: [Option<&Voxels>; 8] = std::array::from_fn(|i| {
        let next = key(add(here, corner(i)));
        keys.binary_search(&next).ok().map(|at| &voxels[at])
    });
    let mut samples = [[[Voxel::default(); LAYERS]; LAYERS]; LAYERS];
    for (z, layer) in samples.iter_mut().enumerate() {
        for (y, row) in layer.iter_mut().enumerate() {
            for (x, sample) in row.iter_mut().enumerate() {
                let from = blocks[x / SIDE + 2 * (y / SIDE) + 4 * (z / SIDE)];
                let at = x % SIDE + SIDE * (y % SIDE + SIDE * (z % SIDE));
                *sample = from.map_or(Voxel::default(), |voxels| voxels[at]);
            }
        }
    }
    let [width, height, depth] = grid.cells_of(here);
    let first = Vec3::from(here.map(|at| (at * SIDE as i32) as f32));
    let mut vertices = Vec::new();
    for z in 0..depth {
        for y in 0..height {
            for x in 0..width {
                let corners: [Voxel; 8] =
                    std::array::from_fn(|i| samples[z + (i >> 2)][y + (i >> 1 & 1)][x + (i & 1)]);
                let Some((within, edges)) = net_vertex(&corners) else { continue };
                let at = first + Vec3::new(x as f32, y as f32, z as f32) + within;
                let cell = (x + SIDE * (y + SIDE * z)) as u16 | edges << 9;
                vertices.push(Vertex { position: at.to_array(), cell });
            }
        }
    }
    BlockNet { vertices: vertices.into() }
}

/// The position of a cell's vertex relative to its lowest corner `[voxels]`, and the bits of the edges at that corner.
/// `None` if the surface does not pass through the cell, or a corner was not seen.
fn net_vertex(corners: &[Voxel; 8]) -> Option<(Vec3, u16)> {
    let solid = |i: usize| corners[i].distance < 0.0;
    let count = (0..8).filter(|&i| solid(i)).count();
    if count == 0 || count == 8 || corners.iter().any(|corner| corner.weight <= 0.0) {
        return None;
    }
    let corner = |i: usize| Vec3::from(corner(i).map(|at| at as f32));
    let (mut sum, mut crossings) = (Vec3::ZERO, 0.0_f32);
    for (a, b) in EDGES {
        if solid(a) != solid(b) {
            let (from, to) = (corners[a].distance, corners[b].distance);
            sum += corner(a) + (corner(b) - corner(a)) * (from / (from - to));
            crossings += 1.0;
        }
    }
    let mut edges = 0;
    for axis in 0..3 {
        if solid(0) != solid(1 << axis) {
            edges |= 1 << axis | u16::from(solid(0)) << (3 + axis);
        }
    }
    Some((sum / crossings, edges))
}
