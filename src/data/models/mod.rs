//! Models of Gaussian splats as files: a registry of formats, each with its reader, its writer, or both.
//!
//! A format is one folder here: `layout.rs` holds the constants that both directions share, `read.rs` and `write.rs`
//! the two directions, and `mod.rs` the registered [`Format`]. A new format is one such folder, one `mod` line below,
//! and a folder of example files in `tests/fuzz/corpus` with the format's name. Everything else finds formats through
//! the registry: [`read_model`], the command line, `densify compress`, the memory ledger and the fuzz targets.

mod compressed_ply;
mod gltf;
mod ply;
mod sog;
mod splat;
mod spz;

mod changes;
mod coordinates;
mod lists;
mod quantise;
mod recognise;
mod rows;
mod siblings;
mod sidecar;
mod similarity;
mod spatial_order;
mod statement;
mod unpack;
mod write;
mod zip;

use std::path::Path;

use densify_policies::parameters::nearest;
#[doc(hidden)]
pub use inventory;

pub use changes::Changes;
pub use coordinates::{
    Coarseness, Coordinates, Frame, is_finer_than_f32, local_origin, offset_text, round_origin,
};
pub(crate) use lists::is_streamed;
pub(crate) use ply::layout::OFFSET as PLY_OFFSET;
pub use recognise::{Match, ModelFile, Reader, is_model_folder, main_file, read_model};
pub use rows::SplatFile;
pub use sidecar::{remove_sidecar, sidecar_path, write_sidecar};
pub(crate) use sog::folder_in_archive;
pub use write::{ModelWriter, Shape, fitting_format, is_unfit};

/// The format that training writes.
pub const PLY: &Format = &ply::FORMAT;

/// A format of models. Registered with `inventory::submit!`.
#[derive(Debug, Clone, Copy)]
pub struct Format {
    /// Name on the command line, and of the folder with its fuzz corpus.
    pub name: &'static str,
    /// Extension of its files, without the leading dot.
    pub extension: &'static str,
    /// Description for `densify export --help`, in one line.
    pub summary: &'static str,
    /// How files are recognised and read; `None` if the format is only written, or another entry reads it.
    pub reader: Option<Reader>,
    /// Makes the writer of one file; `None` if the format is only read.
    pub writer: Option<fn() -> Box<dyn ModelWriter>>,
    /// Rank among the formats that `densify compress --format any` tries, the most exact first. `None` excludes a
    /// format, because another one holds the same values in fewer bytes or has more readers.
    pub compress_rank: Option<u8>,
}

inventory::collect!(Format);

/// The error for a name or an extension that belongs to no format that densify writes.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{0}; choose one of: {names}", names = names(&export_formats()))]
pub struct FormatError(String);

fn names(formats: &[&Format]) -> String {
    formats.iter().map(|format| format.name).collect::<Vec<_>>().join(", ")
}

/// All formats, sorted by name.
pub fn formats() -> Vec<&'static Format> {
    let mut formats: Vec<&Format> = inventory::iter::<Format>.into_iter().collect();
    formats.sort_by_key(|format| format.name);
    formats
}

/// The formats that densify writes, sorted by name.
pub fn export_formats() -> Vec<&'static Format> {
    formats().into_iter().filter(|format| format.writer.is_some()).collect()
}

/// The formats that `densify compress --format any` tries, the most exact first.
pub fn compress_formats() -> Vec<&'static Format> {
    let mut formats = export_formats();
    formats.retain(|format| format.compress_rank.is_some());
    formats.sort_by_key(|format| format.compress_rank);
    formats
}

/// The writable format with this name.
///
/// # Errors
/// When there is none; the message suggests the format with the nearest name.
pub fn find(name: &str) -> Result<&'static Format, FormatError> {
    let formats = export_formats();
    formats.iter().find(|format| format.name == name).copied().ok_or_else(|| {
        let nearest = nearest(name, formats.iter().map(|format| format.name));
        let hint = nearest.map_or_else(String::new, |name| format!(" (did you mean `{name}`?)"));
        FormatError(format!("there is no format `{name}`{hint}"))
    })
}

/// The writable format with the extension of `path`; the longest extension wins (`a.b` over `b`).
///
/// # Errors
/// When there is none.
pub fn find_by_extension(path: &Path) -> Result<&'static Format, FormatError> {
    let file = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
    let lower = file.to_lowercase();
    let has_extension = |format: &&Format| {
        lower.strip_suffix(format.extension).is_some_and(|stem| stem.ends_with('.'))
    };
    let candidates = export_formats().into_iter().filter(has_extension);
    let longest = candidates.max_by_key(|format| format.extension.len());
    longest.ok_or_else(|| FormatError(format!("no format has the extension of {file}")))
}

#[cfg(test)]
pub(crate) mod tests;
