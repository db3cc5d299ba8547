//! `.splat` (antimatter15), read only.

mod read;

use super::{Format, Match, Reader};

const FORMAT: Format = Format {
    name: "splat",
    extension: "splat",
    summary: "32 bytes per Gaussian, colours without spherical harmonics",
    reader: Some(Reader {
        // The format has no magic number.
        recognise: |file| Ok(Match::weak_if(read::is_plausible(&file.start, file.length))),
        read: |file| read::read(file.path, file.input),
        main_file: None,
    }),
    writer: None,
    compress_rank: None,
};

inventory::submit! { FORMAT }
