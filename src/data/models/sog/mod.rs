//! SOG version 2 (PlayCanvas): a model as lossless images with one pixel per Gaussian, in a ZIP archive or in a folder
//! with `meta.json`.
//!
//! The writer fits codebooks and palette to the model, weighting Gaussians by how much of the image they cover.

mod codebook;
mod layout;
mod lossless;
mod palette;
mod picture;
mod read;
mod write;

use super::{Format, Match, Reader};
pub(crate) use read::folder_in_archive;
use write::SogWriter;

const FORMAT: Format = Format {
    name: "sog",
    extension: "sog",
    summary: "SOG version 2 of PlayCanvas: quantised pictures in an archive",
    reader: Some(Reader {
        recognise: |file| {
            let is_archive = file.start.starts_with(b"PK\x03\x04");
            Ok(Match::strong_if(is_archive || file.json()?.is_some_and(read::is_meta)))
        },
        read: read::read,
        main_file: Some(layout::META),
    }),
    writer: Some(|| Box::new(SogWriter::default())),
    compress_rank: Some(1),
};

inventory::submit! { FORMAT }

/// Variants that have one entry of the palette for every 1, 2, 4, 8, 16 and 64 Gaussians.
const VARIANTS: [Format; 6] = [
    Format { writer: Some(|| Box::new(SogWriter::sharing(1))), ..FORMAT },
    Format { writer: Some(|| Box::new(SogWriter::sharing(2))), ..FORMAT },
    Format { writer: Some(|| Box::new(SogWriter::sharing(4))), ..FORMAT },
    Format { writer: Some(|| Box::new(SogWriter::sharing(8))), ..FORMAT },
    Format { writer: Some(|| Box::new(SogWriter::sharing(16))), ..FORMAT },
    Format { writer: Some(|| Box::new(SogWriter::sharing(64))), ..FORMAT },
];
