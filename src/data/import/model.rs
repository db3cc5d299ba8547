//! A model of any format: how it is recognised, and the rows that every reader gathers.

use std::fmt::Display;
use std::fs::File;
use std::io::{BufReader, Read, Seek};
use std::path::Path;

use crate::dataset::DatasetError;
use densify_core::files;
use densify_core::gaussians::{Gaussians, logit, sh_coefficients};

/// Fraction of the rows that may be unusable.
const MAX_BAD_ROWS: f64 = 0.01;
/// Logarithm of a flat Gaussian's standard deviation, which is −∞: what a compressed PLY has for it.
const FLAT: f32 = -20.0;
/// Opacities stay this far from 0 and 1, whose logits are infinite; other readers take the same.
const MARGIN: f32 = 1e-6;
/// Squared length below which a quaternion counts as zero: 1e-6 of a unit quaternion.
const ZERO_QUATERNION: f32 = 1e-12;

/// A model read from a file, and what was wrong with the file.
#[derive(Debug, Clone, PartialEq)]
pub struct SplatFile {
    /// The rows, in the file's order and coordinates; of a format in f32, bit for bit.
    pub gaussians: Gaussians,
    /// Rows dropped because a value was not finite.
    pub dropped: usize,
    /// Rows whose zero quaternion was replaced by the identity.
    pub repaired: usize,
}

/// The file contradicts its format in this place.
pub(super) fn malformed(path: &Path, field: impl Display, problem: impl Display) -> DatasetError {
    DatasetError::malformed(path, field, problem, "export the file again")
}

/// Reads a model in any format, recognised by its content: splat PLY, plain or compressed, SPZ, SOG (a file, or a
/// folder with `meta.json`), glTF with `KHR_gaussian_splatting`, `.splat`. Files in a frame of their own (glTF) come
/// in that of the other formats.
///
/// # Errors
/// When the file is unreadable, of none of these formats, contradicts its format, or more than 1 % of its rows are
/// not finite.
pub fn read_model(path: &Path) -> Result<SplatFile, DatasetError> {
    if path.is_dir() {
        let meta = path.join("meta.json");
        if !meta.is_file() {
            return Err(DatasetError(format!(
                "{} is a folder without meta.json, which a SOG folder has; name a file of Gaussian splats",
                path.display()
            )));
        }
        return read_model(&meta);
    }
    let mut file = files::open(path).map_err(DatasetError::io(path))?;
    let mut start = Vec::new();
    (&mut file).take(64).read_to_end(&mut start).map_err(DatasetError::io(path))?;
    file.rewind().map_err(DatasetError::io(path))?;
    if let Some(problem) = files::wrong_kind(&start) {
        return Err(DatasetError(format!("{}: the file: {problem}", path.display())));
    }
    if start.starts_with(b"ply") {
        return ply(path);
    }
    let length = file.metadata().map_err(DatasetError::io(path))?.len();
    other(path, &start, BufReader::with_capacity(1 << 16, file), length)
}

/// A PLY file of either kind.
fn ply(path: &Path) -> Result<SplatFile, DatasetError> {
    match super::ply::is_packed(path)? {
        true => super::ply::read_packed(path),
        false => super::ply::read_splats(path),
    }
}

/// A format other than PLY.
fn other(
    path: &Path,
    start: &[u8],
    input: BufReader<File>,
    length: u64,
) -> Result<SplatFile, DatasetError> {
    use super::{gltf, sog, splat, spz};
    match start {
        [0x1f, 0x8b, ..] | [b'N', b'G', b'S', b'P', ..] => spz::read(path, input, length),
        [b'P', b'K', 3, 4, ..] => sog::read_zip(path, input, length),
        [b'g', b'l', b'T', b'F', ..] => gltf::read_binary(path, input, length),
        _ if without_mark(start).trim_ascii_start().starts_with(b"{") => {
            // Both are JSON: one lists images, the other has an asset.
            let text = files::read_text(path, gltf::MAX_JSON).map_err(DatasetError::io(path))?;
            match sog::is_meta(&text) {
                true => sog::read_folder(path, &text),
                false => gltf::read_text(path, &text),
            }
        }
        _ if splat::is_splat(start, length) => splat::read(path, input),
        _ => Err(unrecognised(path)),
    }
}

/// The start of a text, without the byte-order mark that some editors put before it.
fn without_mark(start: &[u8]) -> &[u8] {
    start.strip_prefix("\u{feff}".as_bytes()).unwrap_or(start)
}

fn unrecognised(path: &Path) -> DatasetError {
    DatasetError(format!(
        "{} is no format of Gaussian splats that densify reads: not PLY, SPZ, SOG, glTF or .splat; convert it, e.g. \
         with splat-transform or SuperSplat",
        path.display()
    ))
}

/// A row as a reader finds it.
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

/// The rows of a model that is being read.
#[derive(Debug)]
pub(super) struct Rows {
    file: SplatFile,
    total: usize,
}

impl Rows {
    pub(super) fn new(sh_degree: u8) -> Self {
        let gaussians = Gaussians { sh_degree, ..Gaussians::default() };
        Self { file: SplatFile { gaussians, dropped: 0, repaired: 0 }, total: 0 }
    }

    /// Takes a row if its values are finite, once those have a number that some programs write as infinite: the size of
    /// a flat Gaussian, and the opacity of a transparent or an opaque one.
    pub(super) fn push(&mut self, row: Row<'_>) {
        let SplatFile { gaussians, dropped, repaired } = &mut self.file;
        let row = Row {
            log_scale: row.log_scale.map(|log| if log == f32::NEG_INFINITY { FLAT } else { log }),
            opacity_logit: match row.opacity_logit {
                f32::INFINITY => quantised_logit(1.0),
                f32::NEG_INFINITY => quantised_logit(0.0),
                finite => finite,
            },
            ..row
        };
        assert_eq!(row.sh.len(), 3 * sh_coefficients(gaussians.sh_degree), "coefficients of a row");
        self.total += 1;
        let others = row.mean.iter().chain(&row.log_scale).chain(&row.quat).chain(row.sh);
        if !row.opacity_logit.is_finite() || others.into_iter().any(|value| !value.is_finite()) {
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

    /// The model, unless too much of it is unusable.
    pub(super) fn finish(self, path: &Path) -> Result<SplatFile, DatasetError> {
        let (dropped, total) = (self.file.dropped, self.total);
        if dropped as f64 > MAX_BAD_ROWS * total as f64 {
            return Err(DatasetError(format!(
                "{}: {dropped} of {total} rows are not finite, more than 1 %; the file is damaged: export it again",
                path.display()
            )));
        }
        Ok(self.file)
    }
}

/// The unit quaternion of three components in their order and the place of the fourth, the largest.
pub(super) fn from_smallest_three(largest: usize, others: [f32; 3]) -> [f32; 4] {
    let rest = (1.0 - others.iter().map(|v| v * v).sum::<f32>()).max(0.0).sqrt();
    let mut next = others.into_iter();
    std::array::from_fn(|i| if i == largest { rest } else { next.next().unwrap_or(0.0) })
}

/// Logit of a quantised opacity in `[0, 1]`.
pub(super) fn quantised_logit(opacity: f32) -> f32 {
    logit(opacity.clamp(MARGIN, 1.0 - MARGIN))
}

/// Logarithm of a standard deviation; that of a flat Gaussian is finite.
pub(super) fn log_of_scale(scale: f32) -> f32 {
    if scale == 0.0 { FLAT } else { scale.ln() }
}
