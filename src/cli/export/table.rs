//! The table of `densify export`: the size of each format, and how closely it reproduces the model.

use std::fmt::Write as _;

use densify_core::numbers::{grouped, percent};
use densify_data::models::PLY;

/// A file that was written.
pub(super) struct WrittenFile {
    /// Name of its format.
    pub(super) format: &'static str,
    /// Its size `[bytes]`.
    pub(super) bytes: u64,
    /// PSNR of its renderings against those of the model `[dB]`; infinite if they are equal.
    pub(super) psnr: Option<f64>,
}

/// The table for files of a model of `rows` Gaussians, one line per format.
pub(super) fn format(files: &[WrittenFile], rows: usize) -> String {
    let ply_bytes = files.iter().find(|file| file.format == PLY.name).map(|file| file.bytes);
    let width = files.iter().map(|file| file.format.len()).max().unwrap_or(0).max("format".len());
    let mut text = format!("\n{:width$}  {:>15}  {:>12}", "format", "bytes", "per Gaussian");
    let has_psnr = files.iter().any(|file| file.psnr.is_some());
    let columns = [ply_bytes.map(|_| "of the PLY"), has_psnr.then_some("PSNR [dB]")];
    for column in columns.into_iter().flatten() {
        let _ = write!(text, "  {column:>10}");
    }
    for WrittenFile { format, bytes, psnr } in files {
        let each = *bytes as f64 / rows.max(1) as f64;
        let shown = grouped(usize::try_from(*bytes).unwrap_or(usize::MAX));
        let _ = write!(text, "\n{format:width$}  {shown:>15}  {each:>12.1}");
        if let Some(ply) = ply_bytes {
            let _ = write!(text, "  {:>10}", percent(*bytes as f64 / ply as f64));
        }
        match psnr {
            None => {}
            Some(psnr) if psnr.is_infinite() => text += "        same",
            Some(psnr) => _ = write!(text, "  {psnr:>10.2}"),
        }
    }
    text
}
