//! Joins the vertices of all blocks into triangles: two for each edge of the grid that the surface crosses, between the
//! vertices of the four cells around it.

use glam::Vec3;
use rayon::prelude::*;

use super::blocks::{KEY_BYTES, Key, Place, SIDE, add, block, key};
use super::components;
use super::mesh::Mesh;
use super::nets::BlockNet;
use super::{Limits, MeshError};

/// Bytes per vertex while the mesh is assembled: position, two triangles, which exist twice while those of all blocks are
/// joined, component and its area, and colour.
const VERTEX_BYTES: u64 = 12 + 2 * 2 * 12 + 4 + 8 + 16 + 4;

/// Joins the vertices, and drops small components. Returns the mesh in voxels without colours, and the number and the
/// fraction of the area of the dropped components.
pub(super) fn assemble(
    nets: Vec<BlockNet>,
    keys: &[Key],
    min_component: f64,
    limits: &Limits,
) -> Result<(Mesh, (usize, f64)), MeshError> {
    let mut firsts = Vec::with_capacity(nets.len());
    let mut count = 0_u64;
    for net in &nets {
        firsts.push(count as u32);
        count += net.vertices.len() as u64;
    }
    let held = keys.len() as u64 * KEY_BYTES + nets.iter().map(BlockNet::bytes).sum::<u64>();
    limits.check("the mesh", count * VERTEX_BYTES, held)?;
    // Indices have 32 bits.
    limits.check("the mesh", if count > u64::from(u32::MAX) { u64::MAX } else { 0 }, held)?;
    let joined = Joined { nets: &nets, keys, firsts: &firsts };
    let triangles = {
        // Freed as soon as they are joined.
        let parts = (0..nets.len()).into_par_iter().map(|index| joined.triangles(index));
        parts.collect::<Vec<_>>().concat()
    };
    let vertices = nets.iter().flat_map(|net| net.vertices.iter());
    let positions = vertices.map(|vertex| vertex.position).collect();
    drop(nets);
    let mut mesh = Mesh::new(positions, triangles);
    let dropped = components::drop_small(&mut mesh, min_component);
    Ok((mesh, dropped))
}

/// The vertices of all blocks.
struct Joined<'a> {
    nets: &'a [BlockNet],
    keys: &'a [Key],
    /// Index of each block's first vertex.
    firsts: &'a [u32],
}

impl Joined<'_> {
    /// The triangles around the edges that start in the cells of a block.
    fn triangles(&self, index: usize) -> Vec<[u32; 3]> {
        let here = block(self.keys[index]).map(|at| at * SIDE as i32);
        let mut triangles = Vec::new();
        for (at, vertex) in self.nets[index].vertices.iter().enumerate() {
            let cell = vertex.cell();
            let within = [cell % SIDE, cell / SIDE % SIDE, cell / SIDE / SIDE];
            let cell = add(here, within.map(|at| at as i32));
            for axis in 0..3 {
                if !vertex.is_crossed(axis) {
                    continue;
                }
                let (u, v) = ((axis + 1) % 3, (axis + 2) % 3);
                let beside = |along_u: i32, along_v: i32| {
                    let mut cell = cell;
                    (cell[u], cell[v]) = (cell[u] - along_u, cell[v] - along_v);
                    self.vertex(cell)
                };
                let others = (beside(1, 1), beside(0, 1), beside(1, 0));
                // At the border of the seen space, not all four cells have a vertex.
                let (Some(a), Some(b), Some(d)) = others else { continue };
                let c = (index, at);
                // Counter-clockwise, seen from the end of the edge.
                let mut quad = [a, b, c, d];
                if !vertex.leads_out(axis) {
                    quad.reverse();
                }
                let place = |(block, at): (usize, usize)| {
                    Vec3::from(self.nets[block].vertices[at].position)
                };
                let length = |i: usize, j: usize| place(quad[i]).distance_squared(place(quad[j]));
                let is_first_shorter = length(0, 2) <= length(1, 3);
                let [a, b, c, d] = quad.map(|(block, at)| self.firsts[block] + at as u32);
                // The shorter diagonal gives the better triangles.
                triangles.extend(match is_first_shorter {
                    true => [[a, b, c], [a, c, d]],
                    false => [[b, c, d], [b, d, a]],
                });
            }
        }
        triangles.shrink_to_fit();
        triangles
    }

    /// The block and the index of the vertex in a cell of the grid.
    fn vertex(&self, cell: Place) -> Option<(usize, usize)> {
        if cell.iter().any(|&at| at < 0) {
            return None;
        }
        let block = cell.map(|at| at / SIDE as i32);
        let index = self.keys.binary_search(&key(block)).ok()?;
        let [x, y, z] = cell.map(|at| at as usize % SIDE);
        Some((index, self.nets[index].vertex_of(x + SIDE * (y + SIDE * z))?))
    }
}
