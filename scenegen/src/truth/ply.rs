//! Reads `mesh.ply` as written by this program: three f64 corners per triangle, and a flag for thin ones.

use std::fs;
use std::path::Path;

use glam::DVec3;

use super::REMEDY;
use crate::error::Error;
use crate::write::mesh_header;

/// Longest header accepted `[bytes]`.
const HEADER: usize = 4096;
/// Size of a corner `[bytes]`.
const CORNER: usize = 24;

/// Reads the corners, three per triangle, and the flags that mark thin triangles (files of earlier versions have
/// neither flags nor thin triangles).
pub(super) fn read(path: &Path) -> Result<(Vec<DVec3>, Vec<bool>), Error> {
    let bytes = fs::read(path).map_err(Error::io(path))?;
    let bad = |element: &str, problem: &str| Error::malformed(path, element, problem, REMEDY);
    let start = String::from_utf8_lossy(&bytes[..bytes.len().min(HEADER)]);
    let faces = start.lines().find_map(|line| line.strip_prefix("element face ")?.parse().ok());
    let faces: u32 = faces.ok_or_else(|| bad("header", "it has no number of faces"))?;
    let matches = |has_flags: &bool| bytes.starts_with(mesh_header(faces, *has_flags).as_bytes());
    let has_flags = [true, false].into_iter().find(matches);
    let has_flags =
        has_flags.ok_or_else(|| bad("header", "it is not the header that this program writes"))?;
    let body = &bytes[mesh_header(faces, has_flags).len()..];
    let face = if has_flags { 14 } else { 13 };
    if body.len() as u64 != u64::from(faces) * (3 * CORNER + face) as u64 {
        let problem = format!("its length of {} bytes does not fit {faces} faces", body.len());
        return Err(bad("body", &problem));
    }
    let (positions, records) = body.split_at(3 * CORNER * faces as usize);
    let number = |bytes: &[u8]| f64::from_le_bytes(std::array::from_fn(|i| bytes[i]));
    let mut corners = Vec::with_capacity(3 * faces as usize);
    for (i, vertex) in positions.chunks_exact(CORNER).enumerate() {
        let corner = DVec3::from_array([0, 8, 16].map(|at| number(&vertex[at..at + 8])));
        if !corner.is_finite() {
            return Err(bad(&format!("vertex {i}"), &format!("{corner} is not finite")));
        }
        corners.push(corner);
    }
    let mut thin = Vec::with_capacity(faces as usize);
    for (i, record) in (0..faces).zip(records.chunks_exact(face)) {
        let own = [3 * i, 3 * i + 1, 3 * i + 2].map(u32::to_le_bytes);
        if record[0] != 3 || record[1..13] != *own.as_flattened() {
            return Err(bad(&format!("face {i}"), "it does not use its own three vertices"));
        }
        thin.push(has_flags && record[13] != 0);
    }
    Ok((corners, thin))
}
