//! SPZ (Niantic), a quantised and compressed format. Versions 2 to 4 are read; version 3, which every reader accepts,
//! is written by default, and version 4 by choice.
//!
//! Coordinates are converted if the file states their axes. Most files do not; their coordinates are used as stored, as
//! in splat-transform.

mod containers;
mod extensions;
mod layout;
pub(super) mod read;
mod write;

use super::{Format, Match, Reader};
use write::SpzWriter;

/// Version 3.
const FORMAT: Format = Format {
    name: "spz",
    extension: "spz",
    summary: "SPZ version 3 of Niantic: quantised and compressed",
    reader: Some(Reader {
        recognise: |file| {
            let is_plain = file.start.starts_with(&layout::MAGIC.to_le_bytes());
            Ok(Match::strong_if(is_plain || file.start.starts_with(&layout::GZIP)))
        },
        read: |file| read::read(file.path, file.input, file.length),
        main_file: None,
    }),
    writer: Some(|| Box::new(SpzWriter::default())),
    compress_rank: Some(3),
};

/// Version 4. Its extension `.v4.spz` ends in that of version 3, the default.
const VERSION_4: Format = Format {
    name: "spz-v4",
    extension: "v4.spz",
    summary: "SPZ version 4: the same values in zstd frames, which some readers do not support",
    // The reader of `spz` reads all versions.
    reader: None,
    writer: Some(|| Box::new(SpzWriter::version_4())),
    compress_rank: None,
};

inventory::submit! { FORMAT }
inventory::submit! { VERSION_4 }

/// Version 3 with fixed steps of coefficients, however large the error of colours.
const VARIANTS: [Format; 3] = [
    Format { writer: Some(|| Box::new(SpzWriter::with_step(3))), ..FORMAT },
    Format { writer: Some(|| Box::new(SpzWriter::with_step(9))), ..FORMAT },
    Format { writer: Some(|| Box::new(SpzWriter::with_step(17))), ..FORMAT },
];
