//! Reads `mesh.ply` as this program writes it: three f64 corners per triangle, and which are thin.

use std::fs;
use std::path::Path;

use glam::DVec3;

use super::REMEDY;
use crate::error::Error;

/// Longest header accepted `[bytes]`.
const HEADER: usize = 4096;

/// Corners, three per triangle, and for each triangle whether it is thin (absent in files of
/// earlier versions: none is).
pub(super) fn read(path: &Path) -> Result<(Vec<DVec3>, Vec<bool>), Error> {
    let bytes = fs::read(path).map_err(Error::io(path))?;
    let bad = |element: &str, problem: String| Error::malformed(path, element, problem, REMEDY);
    let start = &bytes[..bytes.len().min(HEADER)];
    const END: &[u8] = b"end_header\n";
    let end = start.windows(END.len()).position(|at| at == END);
    let end = end.ok_or_else(|| bad("header", "it has no end".into()))?;
    let header = String::from_utf8_lossy(&start[..end]);
    let mut lines = header.lines();
    let mut next = || lines.next().unwrap_or_default().to_owned();
    let mut expect = |wanted: &str| -> Result<usize, Error> {
        let line = next();
        match line.strip_prefix(wanted) {
            Some("") => Ok(0),
            Some(rest) if wanted.ends_with(' ') => {
                rest.parse().map_err(|_| bad("header", format!("{line:?} has no count")))
            }
            _ => Err(bad("header", format!("{line:?} stands where {wanted:?} should"))),
        }
    };
    expect("ply")?;
    expect("format binary_little_endian 1.0")?;
    let vertices = expect("element vertex ")?;
    for axis in ["x", "y", "z"] {
        expect(&format!("property double {axis}"))?;
    }
    let faces = expect("element face ")?;
    expect("property list uchar uint vertex_indices")?;
    let knows_thin = match lines.next() {
        None => false,
        Some("property uchar thin") => true,
        Some(other) => return Err(bad("header", format!("{other:?} is not expected"))),
    };
    let body = &bytes[end + END.len()..];
    let face = if knows_thin { 14 } else { 13 };
    let needed = faces.checked_mul(face).zip(vertices.checked_mul(24));
    let needed = needed.and_then(|(f, v)| f.checked_add(v));
    if needed != Some(body.len()) {
        let problem = format!(
            "{} bytes follow the header; {vertices} vertices and {faces} faces need another number",
            body.len()
        );
        return Err(bad("body", problem));
    }
    if faces.checked_mul(3) != Some(vertices) || u32::try_from(vertices).is_err() {
        let problem =
            format!("{faces} triangles with corners of their own do not have {vertices} vertices");
        return Err(bad("body", problem));
    }
    let (positions, indices) = body.split_at(24 * vertices);
    let number = |bytes: &[u8]| f64::from_le_bytes(std::array::from_fn(|i| bytes[i]));
    let mut corners = Vec::with_capacity(vertices);
    for (i, vertex) in positions.chunks_exact(24).enumerate() {
        let place = DVec3::from_array([0, 8, 16].map(|at| number(&vertex[at..at + 8])));
        if !place.is_finite() {
            return Err(bad(&format!("vertex {i}"), format!("{place} is not finite")));
        }
        corners.push(place);
    }
    let mut thin = Vec::with_capacity(faces);
    for (i, record) in indices.chunks_exact(face).enumerate() {
        let index = |c: usize| {
            u32::from_le_bytes(std::array::from_fn(|byte| record[1 + 4 * c + byte])) as usize
        };
        if record[0] != 3 || (0..3).any(|c| index(c) != 3 * i + c) {
            let problem = "its corners are not its own".to_owned();
            return Err(bad(&format!("face {i}"), problem));
        }
        thin.push(knows_thin && record[13] != 0);
    }
    Ok((corners, thin))
}
