//! Collects the Gaussians that a reader decodes, and repairs or drops unusable ones.

use std::path::Path;

use super::quantise::{FLAT, quantised_logit};
use crate::error::LoadError;
use densify_core::gaussians::{Gaussians, sh_coefficients};

/// Largest fraction of Gaussians that may be unusable.
const MAX_BAD_ROWS: f64 = 0.01;
/// Squared length below which a quaternion counts as zero: 1e-6 of a unit quaternion.
const ZERO_QUATERNION: f32 = 1e-12;

/// A model read from a file, with a count of the repairs.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct SplatFile {
    /// The Gaussians, in the file's order and coordinates; bit for bit where the format stores f32.
    pub gaussians: Gaussians,
    /// Number of Gaussians dropped because a value was not finite, or all were 0.
    pub dropped: usize,
    /// Number of Gaussians whose zero quaternion was replaced with the identity.
    pub repaired: usize,
    /// Notes for the user, one sentence each, on how the file was interpreted and what was ignored.
    pub notes: Vec<String>,
}

/// One decoded Gaussian.
#[derive(Debug, Clone, Copy)]
pub(super) struct Row<'a> {
    pub(super) mean: [f32; 3],
    pub(super) log_scale: [f32; 3],
    /// (w, x, y, z).
    pub(super) quat: [f32; 4],
    pub(super) opacity_logit: f32,
    /// Coefficient-major, RGB last. Shape: `[(degree + 1)², 3]`.
    pub(super) sh: &'a [f32],
}

/// The Gaussians of a model that is being read.
#[derive(Debug)]
pub(super) struct Rows {
    file: SplatFile,
    total: usize,
}

impl Rows {
    pub(super) fn new(sh_degree: u8) -> Self {
        let gaussians = Gaussians { sh_degree, ..Gaussians::default() };
        let file = SplatFile { gaussians, ..SplatFile::default() };
        Self { file, total: 0 }
    }

    /// Adds a Gaussian if its values are finite. A row of zeros is no Gaussian, but what an interrupted export leaves
    /// (splat-transform, pull request 288). Infinite values that some programs write on purpose become finite
    /// first: the log-scale of a flat Gaussian, and the opacity logit of a transparent or opaque one.
    pub(super) fn push(&mut self, row: Row<'_>) {
        let SplatFile { gaussians, dropped, repaired, .. } = &mut self.file;
        let row = Row {
            log_scale: row.log_scale.map(|log| if log == f32::NEG_INFINITY { FLAT } else { log }),
            opacity_logit: match row.opacity_logit {
                f32::INFINITY => quantised_logit(1.0),
                f32::NEG_INFINITY => quantised_logit(0.0),
                other => other,
            },
            ..row
        };
        assert_eq!(row.sh.len(), 3 * sh_coefficients(gaussians.sh_degree), "coefficients of a row");
        self.total += 1;
        let others = row.mean.iter().chain(&row.log_scale).chain(&row.quat).chain(row.sh);
        let mut values = others.chain([&row.opacity_logit]);
        let is_finite = values.clone().all(|value| value.is_finite());
        if !is_finite || values.all(|&value| value == 0.0) {
            *dropped += 1;
            return;
        }
        gaussians.means.push(row.mean);
        gaussians.log_scales.push(row.log_scale);
        gaussians.opacity_logits.push(row.opacity_logit);
        gaussians.sh.extend_from_slice(row.sh);
        let is_zero = row.quat.iter().map(|v| v * v).sum::<f32>() < ZERO_QUATERNION;
        *repaired += usize::from(is_zero);
        gaussians.quats.push(if is_zero { [1.0, 0.0, 0.0, 0.0] } else { row.quat });
    }

    /// The model, or an error if too many Gaussians were unusable.
    pub(super) fn finish(self, path: &Path) -> Result<SplatFile, LoadError> {
        let (dropped, total) = (self.file.dropped, self.total);
        if dropped as f64 > MAX_BAD_ROWS * total as f64 {
            return Err(LoadError::Data(format!(
                "{}: {dropped} of {total} Gaussians have a value that is not finite, or only zeros, more than 1 %; the \
                 file is damaged: export it again",
                path.display()
            )));
        }
        Ok(self.file)
    }
}
