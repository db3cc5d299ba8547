//! Writes meshes: binary PLY, binary glTF, and OBJ. All keep the coordinates and the unit of the dataset.

mod glb;
mod obj;
mod ply;

use std::io::{self, Write};
use std::path::Path;

use densify_core::files::{FileError, write_atomically};

use super::Mesh;

/// A file format of meshes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum MeshFormat {
    /// Binary PLY.
    Ply,
    /// Binary glTF 2.0.
    Glb,
    /// Wavefront OBJ with vertex colours.
    Obj,
}

impl MeshFormat {
    /// The format with the extension of a file; `None` if there is none.
    pub fn of_file(path: &Path) -> Option<Self> {
        let extension = path.extension()?.to_str()?.to_ascii_lowercase();
        Some(match extension.as_str() {
            "ply" => Self::Ply,
            "glb" => Self::Glb,
            "obj" => Self::Obj,
            _ => return None,
        })
    }

    /// Writes a mesh that is in the coordinates of the dataset.
    ///
    /// # Errors
    /// When the file cannot be written, or is a GLB of over 4 GiB. No incomplete file remains.
    pub fn write(self, mesh: &Mesh, path: &Path) -> Result<(), FileError> {
        write_atomically(path, |out| match self {
            Self::Ply => ply::write(mesh, out),
            Self::Glb => glb::write(mesh, out),
            Self::Obj => obj::write(mesh, out),
        })
    }
}

/// True if coordinates in f32 are coarser than a hundredth of a voxel.
fn needs_doubles(mesh: &Mesh) -> bool {
    let farthest = (0..mesh.positions.len()).map(|i| mesh.place_of(i).abs().max_element());
    farthest.fold(0.0, f64::max) * f64::from(f32::EPSILON) > 0.01 * mesh.scale
}

/// Writes numbers in little endian.
fn write_words<const N: usize>(
    out: &mut dyn Write,
    words: impl IntoIterator<Item = [u8; N]>,
) -> io::Result<()> {
    words.into_iter().try_for_each(|word| out.write_all(&word))
}
