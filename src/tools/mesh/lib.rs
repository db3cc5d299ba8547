//! Fuses the surface that a model of Gaussian splats shows into a triangle mesh.
//!
//! 1. Each view gives a depth map with colours (`frame.rs`); a [`DepthSource`] renders them.
//! 2. The seen points give the scene's size, and with it the length of a voxel (`extent.rs`).
//! 3. Blocks of 8³ voxels near a seen point are found (`blocks.rs`), and depth maps are averaged in them as truncated
//!    signed distances (Curless and Levoy 1996; `fusion.rs`).
//! 4. Surface nets (Gibson 1998) turn the zero crossing into triangles (`nets.rs`, `assembly.rs`), small components are
//!    dropped (`components.rs`), and vertices get the mean colour of the views that see them (`colours.rs`).
//!
//! Blocks are processed in the order of a space-filling curve. If they do not fit into the memory, they are fused in
//! several passes over consecutive blocks; the mesh is the same to the last byte, and at any number of threads.

mod assembly;
mod blocks;
mod colours;
mod components;
mod extent;
mod frame;
mod fusion;
mod mesh;
mod model;
mod nets;
mod score;
mod write;

use densify_core::camera::Camera;
use densify_core::memory::Bytes;
use densify_run::Observer;
use densify_run::failure::Failure;

pub use densify_train::metrics::geometry::MeshErrors;
pub use extent::Region;
pub use frame::DepthFrame;
pub use mesh::Mesh;
pub use model::ModelSource;
pub use score::score;
pub use write::MeshFormat;

use blocks::Grid;
use frame::Frames;

/// The source of depth maps, one per view.
pub trait DepthSource {
    /// Number of views.
    fn count(&self) -> usize;

    /// The camera of a view, in scene coordinates.
    fn camera(&self, view: usize) -> Camera;

    /// The depth map of a view. Each call returns the same one.
    ///
    /// # Errors
    /// When the view cannot be rendered.
    fn frame(&mut self, view: usize) -> Result<DepthFrame, Failure>;
}

/// Options of [`fuse`].
#[derive(Debug, Clone, Copy)]
pub struct FuseOptions {
    /// Length of a voxel `[scene units]`, > 0; `None`: [`VOXELS`] per diagonal of the scene or region.
    pub voxel: Option<f64>,
    /// The part of space to fuse; `None`: around the seen points.
    pub region: Option<Region>,
    /// Connected parts with less than this fraction of the mesh's area are dropped, in `0..=1`.
    pub min_component: f64,
    /// Memory for depth maps, voxels and the mesh `[bytes]`.
    pub memory: u64,
    /// Scene units per unit of the dataset, in which lengths are told.
    pub unit: f64,
}

/// Default number of voxels along the diagonal of the scene or region.
pub const VOXELS: f64 = 256.0;

/// The distance from the surface at which signed distances are truncated `[voxels]`: half a block.
const TRUNCATION: f32 = 4.0;

/// A fused mesh, and how it came about.
#[derive(Debug, Clone, PartialEq)]
pub struct Fused {
    /// The mesh.
    pub mesh: Mesh,
    /// Length of a voxel `[scene units]`.
    pub voxel: f64,
    /// Diagonal of the box around the scene's seen points, or of the given region `[scene units]`.
    pub diagonal: f64,
    /// Number of blocks of 8³ voxels.
    pub blocks: usize,
    /// Number of passes over consecutive blocks.
    pub passes: usize,
    /// Number of components that were dropped, and their fraction of the area.
    pub dropped: (usize, f64),
}

/// An error in fusing a mesh.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum MeshError {
    /// A view cannot be rendered.
    #[error("{0}")]
    Source(#[from] Failure),
    /// No view shows a surface.
    #[error(
        "no view shows a surface: no pixel has a depth (alpha below 0.5 everywhere, or nothing inside the box)"
    )]
    Nothing,
    /// The grid or the mesh does not fit into the memory, even in passes.
    #[error(
        "the memory is too small for voxels of {voxel} (1/{} of the {span}'s diagonal): {part} takes {}, and {} is left",
        (diagonal / voxel).round(), Bytes(*needed), Bytes(*left)
    )]
    Memory {
        /// What does not fit.
        part: &'static str,
        /// Memory that it takes `[bytes]`.
        needed: u64,
        /// Memory that is left for it `[bytes]`.
        left: u64,
        /// Length of a voxel `[units of the dataset]`.
        voxel: f64,
        /// Diagonal of the scene or of the given region `[units of the dataset]`.
        diagonal: f64,
        /// "scene" or "box": has the diagonal.
        span: &'static str,
    },
    /// The grid has too many voxels along an axis.
    #[error("voxels of {voxel} are too small for a {span} with a diagonal of {diagonal}")]
    TooFine {
        /// Length of a voxel `[units of the dataset]`.
        voxel: f64,
        /// Diagonal of the scene or of the given region `[units of the dataset]`.
        diagonal: f64,
        /// "scene" or "box": has the diagonal.
        span: &'static str,
    },
    /// Nothing is left of the surface.
    #[error("no surface was found: the views contradict each other")]
    Empty,
}

impl MeshError {
    /// The remedy, as the end of a message for the command line.
    pub fn remedy(&self) -> &'static str {
        match self {
            Self::Source(_) => "",
            Self::Nothing => "; check that the model belongs to the dataset, and the box",
            Self::Memory { .. } => "; give more --memory, a larger --voxel, or a --box",
            Self::TooFine { .. } | Self::Empty => "; give a larger --voxel",
        }
    }
}

/// Fuses the depth maps of a source.
///
/// # Errors
/// See [`MeshError`].
pub fn fuse(
    source: &mut dyn DepthSource,
    options: &FuseOptions,
    observer: &dyn Observer,
) -> Result<Fused, MeshError> {
    // A quarter of the memory keeps depth maps, so that they are rendered only once if they fit.
    let mut frames = Frames::new(source, options.memory / 4);
    let memory = options.memory - options.memory / 4;
    let extent = extent::survey(&mut frames, options.region)?;
    let diagonal = extent.diagonal;
    let voxel = options.voxel.unwrap_or(diagonal / VOXELS);
    let (told, told_diagonal) = (voxel / options.unit, diagonal / options.unit);
    let span = if options.region.is_some() { "box" } else { "scene" };
    let limits = Limits { memory, voxel: told, diagonal: told_diagonal, span };
    let too_fine = MeshError::TooFine { voxel: told, diagonal: told_diagonal, span };
    let grid = Grid::new(&extent.region, voxel).ok_or(too_fine)?;
    let keys = blocks::collect(&mut frames, &grid, &limits)?;
    observer.say(format_args!(
        "grid     {} blocks of 8³ voxels of {told:.4} (1/{:.0} of the {span}'s diagonal)",
        densify_core::numbers::grouped(keys.len()),
        diagonal / voxel
    ));
    let (nets, passes) = fusion::fuse(&mut frames, &grid, &keys, &limits)?;
    let (mut mesh, dropped) = assembly::assemble(nets, &keys, options.min_component, &limits)?;
    if mesh.triangles.is_empty() {
        return Err(MeshError::Empty);
    }
    colours::paint(&mut frames, &grid, &mut mesh)?;
    mesh.place(&grid);
    Ok(Fused { mesh, voxel, diagonal, blocks: keys.len(), passes, dropped })
}

/// The memory for fusion, and what its errors tell.
#[derive(Debug, Clone, Copy)]
struct Limits {
    /// Memory for voxels and the mesh `[bytes]`.
    memory: u64,
    /// Length of a voxel `[units of the dataset]`.
    voxel: f64,
    /// Diagonal of the scene or of the given region `[units of the dataset]`.
    diagonal: f64,
    /// "scene" or "box": has the diagonal.
    span: &'static str,
}

impl Limits {
    /// Fails unless `part` fits beside what is `held` already.
    fn check(&self, part: &'static str, needed: u64, held: u64) -> Result<(), MeshError> {
        let left = self.memory.saturating_sub(held);
        let Self { voxel, diagonal, span, .. } = *self;
        if needed > left {
            return Err(MeshError::Memory { part, needed, left, voxel, diagonal, span });
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests;
