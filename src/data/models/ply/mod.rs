//! Splat PLY, binary little endian, in the layout of the original 3DGS trainer (Kerbl et al. 2023, `save_ply`). The
//! reader accepts every encoding and order of properties.

pub(super) mod activation;
pub(super) mod layout;
mod read;
pub(super) mod unread;
mod write;

use super::{Format, Match, Reader};
use write::PlyWriter;

pub(super) const FORMAT: Format = Format {
    name: "ply",
    extension: "ply",
    summary: "uncompressed splat PLY with the properties of the original 3DGS trainer",
    reader: Some(Reader {
        // Compressed PLY starts in the same way.
        recognise: |file| Ok(Match::weak_if(file.unmarked_start().starts_with(layout::START))),
        read: |file| read::read(file.path),
        main_file: None,
    }),
    writer: Some(|| Box::new(PlyWriter::default())),
    compress_rank: Some(0),
};

inventory::submit! { FORMAT }

#[cfg(test)]
#[allow(clippy::float_cmp, reason = "results are exact")]
mod tests;
