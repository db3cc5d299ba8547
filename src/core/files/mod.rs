//! Files: those of others are opened with care, and what is written is complete or not there at all.

mod atomic;
pub mod disk;
mod error;
mod read;

pub use atomic::{
    RUN_FOLDER_DEPTH, TEMPORARY, WriteError, is_temporary, remove_incomplete, write_atomically,
    write_atomically_from,
};
pub use error::OutputError;
pub use read::{MAX_OPTIONS, NOT_UTF8, lines, mistaken, most_unpacked, one_line, open, read_text};
