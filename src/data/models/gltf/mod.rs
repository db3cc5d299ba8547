//! glTF 2.0 with `KHR_gaussian_splatting` (Khronos, ratified). Binary files (`.glb`) are read and written, text
//! (`.gltf`, with its buffers embedded or in files beside it) is only read.
//!
//! glTF has y up; the other formats use the coordinates of the dataset, mostly with y down. As in splat-transform, a
//! half turn about z converts one into the other.

mod accessors;
mod layout;
mod nodes;
mod read;
mod write;

use super::{Format, Match, Reader};
use write::GlbWriter;

const BINARY: Format = Format {
    name: "glb",
    extension: "glb",
    summary: "glTF with KHR_gaussian_splatting, uncompressed",
    reader: Some(Reader {
        recognise: |file| Ok(Match::strong_if(file.start.starts_with(layout::MAGIC))),
        read: |file| read::read_binary(file.path, file.input, file.length),
        main_file: None,
    }),
    writer: Some(|| Box::new(GlbWriter::default())),
    // PLY holds the same values in fewer bytes.
    compress_rank: None,
};

const TEXT: Format = Format {
    name: "gltf",
    extension: "gltf",
    summary: "glTF with KHR_gaussian_splatting as text",
    reader: Some(Reader {
        // Other formats are JSON too; every glTF has an asset.
        recognise: |file| {
            Ok(Match::weak_if(file.json()?.is_some_and(|text| text.contains("\"asset\""))))
        },
        read: |file| read::read_text(file.path, file.json()?.unwrap_or_default()),
        main_file: None,
    }),
    writer: None,
    compress_rank: None,
};

inventory::submit! { BINARY }
inventory::submit! { TEXT }

#[cfg(test)]
mod tests;
