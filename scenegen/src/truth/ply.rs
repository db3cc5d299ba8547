//! Reads `mesh.ply` as this program writes it: three f64 corners per triangle, and which are thin.

use std::fs;
use std::path::Path;

use glam::DVec3;

use super::REMEDY;
use crate::error::Error;
use crate::write::mesh_header;

/// Longest header accepted `[bytes]`.
const HEADER: usize = 4096;
/// Bytes of a corner.
const CORNER: usize = 24;

/// Corners, three per triangle, and for each triangle whether it is thin (absent in files of
/// earlier versions: none is).
pub(super) fn read(path: &Path) -> Result<(Vec<DVec3>, Vec<bool>), Error> {
    let bytes = fs::read(path).map_err(Error::io(path))?;
    let bad = |element: &str, problem: &str| Error::malformed(path, element, problem, REMEDY);
    let start = String::from_utf8_lossy(&bytes[..bytes.len().min(HEADER)]);
    let faces = start.lines().find_map(|line| line.strip_prefix("element face ")?.parse().ok());
    let faces: u32 = faces.ok_or_else(|| bad("header", "it has no number of faces"))?;
    let is_this = |knows_thin: &bool| bytes.starts_with(mesh_header(faces, *knows_thin).as_bytes());
    let knows_thin = [true, false].into_iter().find(is_this);
    let knows_thin = knows_thin.ok_or_else(|| bad("header", "this program writes another"))?;
    let body = &bytes[mesh_header(faces, knows_thin).len()..];
    let face = if knows_thin { 14 } else { 13 };
    if body.len() as u64 != u64::from(faces) * (3 * CORNER + face) as u64 {
        let problem =
            format!("{faces} faces do not need the {} bytes after the header", body.len());
        return Err(bad("body", &problem));
    }
    let (positions, records) = body.split_at(3 * CORNER * faces as usize);
    let number = |bytes: &[u8]| f64::from_le_bytes(std::array::from_fn(|i| bytes[i]));
    let mut corners = Vec::with_capacity(3 * faces as usize);
    for (i, vertex) in positions.chunks_exact(CORNER).enumerate() {
        let place = DVec3::from_array([0, 8, 16].map(|at| number(&vertex[at..at + 8])));
        if !place.is_finite() {
            return Err(bad(&format!("vertex {i}"), &format!("{place} is not finite")));
        }
        corners.push(place);
    }
    let mut thin = Vec::with_capacity(faces as usize);
    for (i, record) in (0..faces).zip(records.chunks_exact(face)) {
        let own = [3 * i, 3 * i + 1, 3 * i + 2].map(u32::to_le_bytes);
        if record[0] != 3 || record[1..13] != *own.as_flattened() {
            return Err(bad(&format!("face {i}"), "its corners are not its own"));
        }
        thin.push(knows_thin && record[13] != 0);
    }
    Ok((corners, thin))
}
