//! Models as files: a registry of formats, each with a writer that takes the model in pieces.
//!
//! A new format is one file in this folder, which implements [`ModelWriter`] and registers a
//! [`Format`] as `ply.rs` does, and its `mod` line below. The command line, the trainer and the
//! memory ledger know formats only through this module.

mod compressed_ply;
mod glb;
mod order;
mod ply;
mod sog;
mod spz;

use std::io::{self, Write};
use std::ops::Range;
use std::path::Path;

use densify_policies::parameters::nearest;
#[doc(hidden)]
pub use inventory;

use densify_core::files::{FileError, WriteError, write_atomically_from};
use densify_core::gaussians::Gaussians;
use densify_core::pieces::pieces;

/// The format that training exports to.
pub const PLY: &Format = &ply::FORMAT;

/// Size of a model.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Shape {
    /// Number of Gaussians.
    pub rows: usize,
    /// Spherical-harmonic degree, 0..=3.
    pub sh_degree: u8,
}

/// Writes one model to one file: [`begin`](Self::begin), then [`rows`](Self::rows) for each piece
/// in order, then [`finish`](Self::finish).
pub trait ModelWriter {
    /// Most memory that the writer takes at any time beside the piece it is given `[bytes]`. Part
    /// of what a run promises, so it must hold for every model of this shape.
    fn held_bytes(&self, shape: Shape) -> u64;

    /// Whether rows that lie near each other in space should come one after the other, as what the format packs
    /// together is to be alike. Rows then change their order in the file.
    fn is_for_neighbours(&self) -> bool {
        false
    }

    /// Whether a file holds less of a number than an `f32` does, so that what is read back differs.
    fn rounds(&self) -> bool {
        true
    }

    /// The same format with other shares of bytes for accuracy, the most accurate first; empty where there are none.
    fn forms(&self) -> &'static [Format] {
        &[]
    }

    /// Writes what comes before the rows.
    ///
    /// # Errors
    /// Those of `out`, and [`io::ErrorKind::InvalidInput`] where the format cannot hold the model.
    fn begin(&mut self, shape: Shape, out: &mut dyn Write) -> io::Result<()>;

    /// Takes the next rows: some thousand at a time, in the dataset's own coordinates.
    ///
    /// # Errors
    /// As [`begin`](Self::begin).
    fn rows(&mut self, rows: &Gaussians, out: &mut dyn Write) -> io::Result<()>;

    /// Writes what is still held and what comes after the rows.
    ///
    /// # Errors
    /// As [`begin`](Self::begin).
    fn finish(&mut self, out: &mut dyn Write) -> io::Result<()>;
}

/// A format that models are exported to. Registered with `inventory::submit!`.
#[derive(Debug, Clone, Copy)]
pub struct Format {
    /// Its name on the command line.
    pub name: &'static str,
    /// Extension of its files, without the leading dot.
    pub extension: &'static str,
    /// What it is, in one line.
    pub summary: &'static str,
    /// Makes the writer of one file.
    pub writer: fn() -> Box<dyn ModelWriter>,
}

inventory::collect!(Format);

/// Why no format can be chosen.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{0}; choose one of: {names}", names = names())]
pub struct FormatError(String);

fn names() -> String {
    formats().iter().map(|format| format.name).collect::<Vec<_>>().join(", ")
}

/// All formats, sorted by name.
#[must_use]
pub fn formats() -> Vec<&'static Format> {
    let mut formats: Vec<&Format> = inventory::iter::<Format>.into_iter().collect();
    formats.sort_by_key(|format| format.name);
    formats
}

/// The format of this name.
///
/// # Errors
/// When there is none; names the nearest.
pub fn find(name: &str) -> Result<&'static Format, FormatError> {
    let found = formats().into_iter().find(|format| format.name == name);
    found.ok_or_else(|| {
        let nearest = nearest(name, formats().iter().map(|format| format.name));
        let like = nearest.map_or_else(String::new, |name| format!(" (did you mean `{name}`?)"));
        FormatError(format!("there is no format `{name}`{like}"))
    })
}

/// The format with the extension of `path`; the longest extension wins (`a.b` over `b`).
///
/// # Errors
/// When there is none.
pub fn find_by_extension(path: &Path) -> Result<&'static Format, FormatError> {
    let file = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
    let lower = file.to_lowercase();
    let fits = |format: &&Format| {
        lower.strip_suffix(format.extension).is_some_and(|stem| stem.ends_with('.'))
    };
    let found = formats().into_iter().filter(fits).max_by_key(|format| format.extension.len());
    found.ok_or_else(|| FormatError(format!("the name {file} has the extension of no format")))
}

/// Whether an error of a writer says that its format has no room for the model, rather than the disk none for the file.
#[must_use]
pub fn is_unfit(error: &io::Error) -> bool {
    error.raw_os_error().is_none() && error.kind() == io::ErrorKind::InvalidInput
}

impl Format {
    /// Most memory that writing a model takes beside the piece at hand `[bytes]`.
    #[must_use]
    pub fn held_bytes(&self, shape: Shape) -> u64 {
        (self.writer)().held_bytes(shape)
    }

    /// Writes a model that is in memory as a whole, in the order that suits the format.
    ///
    /// # Errors
    /// Those of [`ModelWriter`].
    pub fn write(&self, model: &Gaussians, out: &mut dyn Write) -> io::Result<()> {
        let mut writer = (self.writer)();
        writer.begin(Shape { rows: model.len(), sh_degree: model.sh_degree }, out)?;
        match writer.is_for_neighbours() {
            false => writer.rows(model, out)?,
            true => {
                let order = order::along_a_curve(model);
                for piece in pieces(model.len()) {
                    writer.rows(&model.gather(&order[piece]), out)?;
                }
            }
        }
        writer.finish(out)
    }

    /// Writes a model to a file that appears only when it is complete. `rows` is asked for one
    /// piece after the other, as the model may be most of what there is memory for.
    ///
    /// # Errors
    /// Those of `rows`, [`ModelWriter`] and [`write_atomically_from`].
    pub fn write_file<E: From<FileError>>(
        &self,
        path: &Path,
        shape: Shape,
        mut rows: impl FnMut(Range<usize>) -> Result<Gaussians, E>,
    ) -> Result<(), E> {
        write_atomically_from(path, |out| {
            let mut writer = (self.writer)();
            writer.begin(shape, out)?;
            for piece in pieces(shape.rows) {
                writer.rows(&rows(piece).map_err(WriteError::Source)?, out)?;
            }
            Ok(writer.finish(out)?)
        })
    }
}

/// Formats that quantise keep logarithms of scales within this: infinite ones would leave no room for others.
const MAX_LOG_SCALE: f32 = 20.0;

/// The index of a quaternion's largest component and, in order, the three others, where it has length 1 and that
/// component is positive.
fn smallest_three(quat: [f32; 4]) -> (usize, [f32; 3]) {
    let largest = (1..4).fold(0, |most, i| if quat[i].abs() > quat[most].abs() { i } else { most });
    let length = quat.iter().map(|v| v * v).sum::<f32>().sqrt().max(f32::MIN_POSITIVE);
    let unit = 1.0f32.copysign(quat[largest]) / length;
    let mut others = (0..4).filter(|&i| i != largest).map(|i| quat[i] * unit);
    (largest, std::array::from_fn(|_| others.next().unwrap_or_default()))
}

#[cfg(test)]
pub(crate) mod tests;
