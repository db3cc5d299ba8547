//! Reads `.splat` (antimatter15): 32 bytes per Gaussian and no header.
//!
//! Position and standard deviations in f32, then red, green, blue and opacity, then the quaternion (w, x, y, z) as
//! 128 + 128·q, all in a byte each. Colour is the same from everywhere.

use std::io::Read;
use std::path::Path;

use super::SplatFile;
use super::model::{Row, Rows, log_of_scale, quantised_logit};
use super::unfold;
use crate::dataset::DatasetError;
use densify_core::gaussians::rgb_to_dc;

/// Bytes of a row.
const ROW: usize = 32;
/// Largest position or standard deviation of a file that is taken for one in this format.
const PLAUSIBLE: f32 = 1e9;

/// Whether a file that begins so and has this length looks like one in this format, which has no mark of its own.
pub(super) fn is_splat(start: &[u8], length: u64) -> bool {
    let rows = start.as_chunks::<ROW>().0;
    let plausible = |row: &[u8; ROW]| {
        let [x, y, z, scales @ ..] = floats(row);
        // A unit quaternion, which neither zeros are nor the head of another format.
        let length = quaternion(row).map(|v| v * v).iter().sum::<f32>();
        (0.5..1.5).contains(&length)
            && [x, y, z].iter().all(|v| v.abs() < PLAUSIBLE)
            && scales.iter().all(|v| (0.0..PLAUSIBLE).contains(v))
    };
    length.is_multiple_of(ROW as u64) && !rows.is_empty() && rows.iter().all(plausible)
}

/// Reads a file, row by row.
///
/// # Errors
/// When it is unreadable, or more than 1 % of its rows are not finite.
pub(super) fn read(path: &Path, mut input: impl Read) -> Result<SplatFile, DatasetError> {
    let mut rows = Rows::new(0);
    let mut bytes = Vec::new();
    loop {
        bytes.clear();
        let found = (&mut input).take((ROW << 12) as u64).read_to_end(&mut bytes);
        found.map_err(|source| unfold::fault(path, "rows", source))?;
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

/// (w, x, y, z) of a row.
fn quaternion(row: &[u8; ROW]) -> [f32; 4] {
    [row[28], row[29], row[30], row[31]].map(|v| (f32::from(v) - 128.0) / 128.0)
}

/// The first six numbers of a row.
fn floats(row: &[u8; ROW]) -> [f32; 6] {
    let words = row.as_chunks::<4>().0;
    std::array::from_fn(|i| f32::from_le_bytes(words[i]))
}
