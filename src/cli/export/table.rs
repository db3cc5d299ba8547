//! The table of `densify export`: the size of each format, and how closely it reproduces the model.

use std::fmt::Write as _;
use std::path::Path;

use densify_core::files::FileError;
use densify_core::numbers::{grouped, percent};
use densify_data::models::PLY;
use densify_run::failure::Failure;

/// A format that was written.
pub(super) struct Line {
    name: &'static str,
    bytes: u64,
    psnr: Option<f64>,
}

impl Line {
    pub(super) fn of(name: &'static str, path: &Path, psnr: Option<f64>) -> Result<Self, Failure> {
        let bytes = path.metadata().map_err(FileError::io("read", path))?.len();
        Ok(Self { name, bytes, psnr })
    }
}

/// The table as text, one line per format.
pub(super) fn table(lines: &[Line], rows: usize) -> String {
    let of_ply = lines.iter().find(|line| line.name == PLY.name).map(|line| line.bytes);
    let width = lines.iter().map(|line| line.name.len()).max().unwrap_or(0).max("format".len());
    let mut text = format!("\n{:width$}  {:>15}  {:>12}", "format", "bytes", "per Gaussian");
    let columns =
        [of_ply.map(|_| "of the PLY"), lines.iter().find_map(|l| l.psnr).map(|_| "PSNR [dB]")];
    for column in columns.into_iter().flatten() {
        let _ = write!(text, "  {column:>10}");
    }
    for Line { name, bytes, psnr } in lines {
        let each = *bytes as f64 / rows.max(1) as f64;
        let shown = grouped(usize::try_from(*bytes).unwrap_or(usize::MAX));
        let _ = write!(text, "\n{name:width$}  {shown:>15}  {each:>12.1}");
        if let Some(ply) = of_ply {
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
