//! A triangle mesh with coloured vertices.

use densify_data::dataset::normalise::Normalisation;
use glam::{DVec3, Vec3};

use super::blocks::Grid;

/// A triangle mesh. A vertex is at `origin + scale · position`, in scene coordinates.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Mesh {
    /// Positions of the vertices. Shape: `[vertices]`.
    pub positions: Vec<[f32; 3]>,
    /// Colours, sRGB-encoded. Shape: `[vertices]`.
    pub colours: Vec<[u8; 3]>,
    /// Vertices of each triangle, counter-clockwise seen from outside. Shape: `[triangles]`.
    pub triangles: Vec<[u32; 3]>,
    /// Offset of the positions.
    pub origin: DVec3,
    /// Unit of the positions, > 0.
    pub scale: f64,
}

impl Mesh {
    /// A mesh without colours, in its own coordinates.
    pub(super) fn new(positions: Vec<[f32; 3]>, triangles: Vec<[u32; 3]>) -> Self {
        Self { positions, triangles, colours: Vec::new(), origin: DVec3::ZERO, scale: 1.0 }
    }

    /// Declares that the positions are voxels of a grid.
    pub(super) fn place(&mut self, grid: &Grid) {
        (self.origin, self.scale) = (grid.low, grid.voxel);
    }

    /// The same mesh in the coordinates of the dataset.
    #[must_use]
    pub fn in_world(self, normalisation: &Normalisation) -> Self {
        let origin = normalisation.world_from_scene(self.origin);
        Self { origin, scale: self.scale / normalisation.scale, ..self }
    }

    /// The position of a vertex in scene coordinates, or in those of the dataset after [`in_world`](Self::in_world).
    pub fn place_of(&self, vertex: usize) -> DVec3 {
        self.origin + Vec3::from(self.positions[vertex]).as_dvec3() * self.scale
    }

    /// All triangles by the positions of their corners.
    pub fn corners(&self) -> Vec<[DVec3; 3]> {
        let corners = |triangle: &[u32; 3]| triangle.map(|vertex| self.place_of(vertex as usize));
        self.triangles.iter().map(corners).collect()
    }
}
