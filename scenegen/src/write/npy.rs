//! Writes depth as a NumPy array for nerfstudio, in its default unit: thousandths of a world unit.
//!
//! The 16-bit PNG that nerfstudio also reads has too little precision or range, except for scenes of a few
//! metres. Format: numpy.org/doc/stable/reference/generated/numpy.lib.format.html

use std::path::Path;

use super::write_file;
use crate::error::Error;

/// Writes depth `[world units / 1000]`, 0 where there is no surface. Shape: `[height, width]`.
pub(super) fn write_depth(
    path: &Path,
    (width, height): (u32, u32),
    depth: &[f32],
) -> Result<(), Error> {
    // Size of magic, version and length.
    const PREFIX: usize = 10;
    let header =
        format!("{{'descr': '<f4', 'fortran_order': False, 'shape': ({height}, {width}), }}");
    // The header is padded to a multiple of 64 bytes, including its line end.
    let padded = (PREFIX + header.len() + 1).next_multiple_of(64) - PREFIX;
    let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
    bytes.extend((padded as u16).to_le_bytes());
    bytes.extend(format!("{header:0$}\n", padded - 1).bytes());
    bytes.extend(depth.iter().flat_map(|depth| (1000.0 * depth).to_le_bytes()));
    write_file(path, &bytes)
}
