//! Reads `.splat`: 32 bytes per Gaussian and no header.
//!
//! Position and standard deviations in f32, then a byte each for red, green, blue, opacity and the quaternion
//! (w, x, y, z) as 128 + 128·q.

use std::io::Read;
use std::path::Path;

use crate::error::LoadError;
use crate::models::quantise::{log_of_scale, quantised_logit};
use crate::models::rows::{Row, Rows, SplatFile};
use crate::models::unpack;
use densify_core::gaussians::rgb_to_dc;

/// Size of a Gaussian `[bytes]`.
const ROW: usize = 32;
/// Largest plausible coordinate or standard deviation; larger ones show that a file has another format.
const MAX_PLAUSIBLE: f32 = 1e9;

/// True if the first bytes and the length of a file could be those of this format.
pub(super) fn is_plausible(start: &[u8], length: u64) -> bool {
    let rows = start.as_chunks::<ROW>().0;
    let plausible = |row: &[u8; ROW]| {
        let [x, y, z, scales @ ..] = floats(row);
        // Neither zeros nor the header of another format contain a unit quaternion here.
        let length = quaternion(row).map(|v| v * v).iter().sum::<f32>();
        (0.5..1.5).contains(&length)
            && [x, y, z].iter().all(|v| v.abs() < MAX_PLAUSIBLE)
            && scales.iter().all(|v| (0.0..MAX_PLAUSIBLE).contains(v))
    };
    length.is_multiple_of(ROW as u64) && !rows.is_empty() && rows.iter().all(plausible)
}

/// Reads a file in pieces.
///
/// # Errors
/// When it is unreadable, or more than 1 % of its Gaussians are not finite.
pub(super) fn read(path: &Path, mut input: impl Read) -> Result<SplatFile, LoadError> {
    let mut rows = Rows::new(0);
    let mut bytes = Vec::new();
    loop {
        bytes.clear();
        let read = (&mut input).take((ROW << 12) as u64).read_to_end(&mut bytes);
        read.map_err(|source| unpack::read_error(path, "rows", source))?;
        for row in bytes.as_chunks::<ROW>().0 {
            let [x, y, z, s0, s1, s2] = floats(row);
            let colour = [row[24], row[25], row[26]].map(|v| rgb_to_dc(f32::from(v) / 255.0));
            rows.push(Row {
                mean: [x, y, z],
                log_scale: [s0, s1, s2].map(log_of_scale),
                quat: quaternion(row),
                opacity_logit: quantised_logit(f32::from(row[27]) / 255.0),
                sh: &colour,
            });
        }
        if bytes.is_empty() {
            return rows.finish(path);
        }
    }
}

/// The quaternion (w, x, y, z) of a Gaussian.
fn quaternion(row: &[u8; ROW]) -> [f32; 4] {
    [row[28], row[29], row[30], row[31]].map(|v| (f32::from(v) - 128.0) / 128.0)
}

/// Position and standard deviations of a Gaussian.
fn floats(row: &[u8; ROW]) -> [f32; 6] {
    let words = row.as_chunks::<4>().0;
    std::array::from_fn(|i| f32::from_le_bytes(words[i]))
}
