//! The compressed splat PLY of PlayCanvas, which SuperSplat, splat-transform, Spark and others open: 16 bytes per
//! Gaussian, and one byte per spherical-harmonic coefficient above band 0.

mod layout;
mod read;
mod write;

use super::ply::layout::START;
use super::{Format, Match, Reader};
use write::CompressedPlyWriter;

const FORMAT: Format = Format {
    name: "compressed-ply",
    extension: "compressed.ply",
    summary: "PLY of PlayCanvas: 16 bytes per Gaussian, and one per coefficient of colour",
    reader: Some(Reader {
        recognise: |file| {
            let is_ply = file.unmarked_start().starts_with(START);
            let is_compressed = is_ply && read::is_compressed(file.path)?;
            Ok(Match::strong_if(is_compressed))
        },
        read: |file| read::read(file.path),
        main_file: None,
    }),
    writer: Some(|| Box::new(CompressedPlyWriter::default())),
    compress_rank: Some(2),
};

inventory::submit! { FORMAT }
